"""Read .npy and .npz files from memory. Nothing is unpickled."""

import io
import math
import struct
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_service.errors import PayloadTooLarge

Array = NDArray[Any]

NPZ_ARRAYS = ("points", "normals", "colors", "segment_ids", "view_ids")
DIRECTORY_END, DIRECTORY_END_64 = b"PK\5\6", b"PK\6\7"  # of a zip file
MAX_DIRECTORY = 65536  # bytes
NPZ_FIX = (
    "Send what numpy.savez(file, points=points) writes; beside points may stand "
    "normals, colors, segment_ids and view_ids."
)


def read_npy(data: bytes, max_points: int, field: str = "cloud") -> Array:
    """Read an .npy file.

    Args:
        data: The file's bytes.
        max_points: Most points accepted, where a row, or a pixel, is one point.
        field: What the file is in the request.

    Returns:
        The array in it, of whatever shape and dtype, in native byte order.

    Raises:
        InvalidRequest: The file is truncated, or no .npy file of numbers.
        PayloadTooLarge: More than `max_points` points.
    """
    stream = io.BytesIO(data)
    fix = f"Send what numpy.save(file, {'points' if field == 'cloud' else field}) writes" + (
        ", points of shape (N, 3)." if field == "cloud" else "."
    )
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran_order, dtype = read_header(stream)
    except Exception:  # numpy's header parser fails on foreign bytes in a dozen ways
        raise InvalidRequest(field, f"{len(data)} bytes that are no .npy file", fix) from None
    if any(size < 0 for size in shape):
        raise InvalidRequest(field, f"shape {shape}", fix)
    if dtype.hasobject or dtype.itemsize == 0:
        raise InvalidRequest(field, f"dtype {dtype}", "Send an array of numbers.")
    expected = math.prod(shape) * dtype.itemsize
    found = len(data) - stream.tell()
    if found != expected:
        raise InvalidRequest(
            field,
            f"{found} bytes of data where the .npy header, shape {shape}, promises {expected}",
            "Send the whole file.",
        )
    check_count(math.prod(shape[:-1] if shape[-1:] == (3,) else shape[:2]), max_points, field)
    array = np.frombuffer(data, dtype=dtype, offset=stream.tell())
    array = array.reshape(shape, order="F" if fortran_order else "C")
    return array.astype(dtype.newbyteorder("="), copy=False)


def read_npz(data: bytes, max_points: int) -> dict[str, Array]:
    """Read the arrays of an .npz file, which are those of NPZ_ARRAYS, or points alone.

    Raises:
        InvalidRequest: The file is truncated, no .npz file, or has other arrays.
        PayloadTooLarge: More than `max_points` points.
    """
    try:
        _check_directory(data)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if "points" not in members and len(members) == 1:
                members = {"points": next(iter(members.values()))}
            foreign = sorted(members.keys() - set(NPZ_ARRAYS))
            if "points" not in members or foreign:
                found = ", ".join(foreign[:5]) or "no array points"
                raise InvalidRequest("cloud", f"an .npz file with {found}", NPZ_FIX)
            contents = {
                name: _unpacked(archive, info, max_points) for name, info in members.items()
            }
    except (InvalidRequest, PayloadTooLarge):
        raise
    except Exception:  # as does zipfile
        value = f"{len(data)} bytes that are no whole .npz file"
        raise InvalidRequest("cloud", value, NPZ_FIX) from None
    return {
        name: read_npy(content, max_points, "cloud" if name == "points" else name)
        for name, content in contents.items()
    }


def _check_directory(data: bytes) -> None:
    """Raise ValueError for a directory of more members than any cloud has; all are read at once."""
    ends = {data.rfind(DIRECTORY_END), data.find(DIRECTORY_END, len(data) - 22)} - {-1}
    for end in ends:  # zipfile takes either
        (size,) = struct.unpack_from("<L", data, end + 12)
        if size > MAX_DIRECTORY or data[end - 20 : end - 16] == DIRECTORY_END_64:
            raise ValueError(f"a directory of {size} bytes, or one for files beyond 4 GB")


def _unpacked(archive: zipfile.ZipFile, info: zipfile.ZipInfo, max_points: int) -> bytes:
    # Six doubles a point and a header: more than any cloud of max_points needs.
    if info.file_size > 48 * max_points + 65536:
        raise PayloadTooLarge(
            "cloud",
            f"an array of {info.file_size} bytes once unpacked",
            f"Send at most {max_points} points.",
        )
    with archive.open(info) as member:
        # Bounded: without a size it unpacks all, however much more than promised that is.
        return member.read(info.file_size)


def check_count(count: int, max_points: int, field: str = "cloud") -> None:
    """Raise PayloadTooLarge for more than `max_points` points."""
    if count > max_points:
        fix = f"Send at most {max_points} points, e.g. downsampled."
        raise PayloadTooLarge(field, f"{count} points", fix)
