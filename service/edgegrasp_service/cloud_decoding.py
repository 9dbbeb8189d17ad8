"""Turn what arrived on the wire into an array of points; whether it suits is the detector's part.

Nothing is unpickled, and no count in a header is trusted before it is compared with the bytes at
hand: a short body cannot make the server allocate a large array.
"""

import io
import math
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_service.errors import PayloadTooLarge, UnsupportedMediaType
from edgegrasp_service.pcd_file import read_pcd
from edgegrasp_service.ply_file import read_ply

Array = NDArray[Any]


def decode_packed(data: bytes, max_points: int) -> Array:
    """Read packed little-endian float32 x, y, z.

    Returns:
        (N, 3) float32, metres.

    Raises:
        InvalidRequest: The bytes are no whole number of points.
        PayloadTooLarge: More than `max_points` points.
    """
    if len(data) % 12:
        raise InvalidRequest(
            "points",
            f"{len(data)} bytes, which are no whole number of points",
            "Send 12 bytes a point: little-endian float32 x, y, z.",
        )
    _check_count(len(data) // 12, max_points)
    return np.frombuffer(data, dtype="<f4").reshape(-1, 3)


def decode_list(points: object, max_points: int) -> Array:
    """Read the lists of a JSON body.

    Returns:
        The same numbers as float64, of the shape they came in.

    Raises:
        InvalidRequest: No list, rows of different lengths, or something other than numbers.
        PayloadTooLarge: More than `max_points` points.
    """
    if not isinstance(points, list):
        raise InvalidRequest("points", _brief(points), "Send a list of [x, y, z] in metres.")
    _check_count(len(points), max_points)
    if not points:
        return np.empty((0, 3))
    try:
        array = np.array(points)
    except ValueError:
        raise InvalidRequest(
            "points", "rows of different lengths", "Send [x, y, z] rows."
        ) from None
    if array.dtype.kind not in "iuf":
        value = next((row for row in points if not _is_numbers(row)), points[0])
        raise InvalidRequest("points", _brief(value), "Send numbers only: [x, y, z] in metres.")
    return array.astype(np.float64)


def decode_file(file_format: str, data: bytes, max_points: int) -> Array:
    """Read a point cloud file.

    Args:
        file_format: One of FILE_FORMATS.
        data: The file's bytes.
        max_points: Most points accepted.

    Returns:
        The array in the file for npy and npz, of whatever shape and dtype; (N, 3) for ply and pcd.

    Raises:
        InvalidRequest: The file is truncated, or no file of that format.
        PayloadTooLarge: More than `max_points` points.
        DecoderMissing: The reader of this format is not installed.
        UnsupportedMediaType: No such format.
    """
    if file_format not in _DECODERS:
        known = ", ".join(FILE_FORMATS)
        raise UnsupportedMediaType("format", repr(file_format), f"Send one of: {known}.")
    return _DECODERS[file_format](data, max_points)


def _decode_npy(data: bytes, max_points: int) -> Array:
    stream = io.BytesIO(data)
    fix = "Send what numpy.save(file, points) writes, points of shape (N, 3)."
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran_order, dtype = read_header(stream)
    except Exception:  # numpy's header parser fails on foreign bytes in a dozen ways
        raise InvalidRequest("cloud", f"{len(data)} bytes that are no .npy file", fix) from None
    if any(size < 0 for size in shape):
        raise InvalidRequest("cloud", f"shape {shape}", fix)
    if dtype.hasobject or dtype.itemsize == 0:
        raise InvalidRequest("cloud", f"dtype {dtype}", "Send float32 or float64 metres.")
    expected = math.prod(shape) * dtype.itemsize
    found = len(data) - stream.tell()
    if found != expected:
        raise InvalidRequest(
            "cloud",
            f"{found} bytes of data where the .npy header, shape {shape}, promises {expected}",
            "Send the whole file.",
        )
    _check_count(shape[0] if shape else 1, max_points)
    array = np.frombuffer(data, dtype=dtype, offset=stream.tell())
    array = array.reshape(shape, order="F" if fortran_order else "C")
    return array.astype(dtype.newbyteorder("="), copy=False)


def _decode_npz(data: bytes, max_points: int) -> Array:
    fix = "Send what numpy.savez(file, points=points) writes."
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {member.filename: member for member in archive.infolist()}
            name = "points.npy" if "points.npy" in members else next(iter(members), "")
            if name != "points.npy" and len(members) != 1:
                found = ", ".join(sorted(members)[:5]) or "nothing"
                raise InvalidRequest("cloud", f"an .npz file with {found}", fix)
            # Six doubles a point and a header: more than any cloud of max_points needs.
            if members[name].file_size > 48 * max_points + 65536:
                raise PayloadTooLarge(
                    "cloud",
                    f"an array of {members[name].file_size} bytes once unpacked",
                    f"Send at most {max_points} points.",
                )
            with archive.open(members[name]) as member:
                # Bounded: without a size it unpacks all, however much more than promised that is.
                content = member.read(members[name].file_size)
    except (InvalidRequest, PayloadTooLarge):
        raise
    except Exception:  # as does zipfile
        value = f"{len(data)} bytes that are no whole .npz file"
        raise InvalidRequest("cloud", value, fix) from None
    return _decode_npy(content, max_points)


def _decode_ply(data: bytes, max_points: int) -> Array:
    return read_ply(data, lambda count: _check_count(count, max_points))


def _decode_pcd(data: bytes, max_points: int) -> Array:
    return read_pcd(data, lambda count: _check_count(count, max_points))


_DECODERS: dict[str, Callable[[bytes, int], Array]] = {
    "npy": _decode_npy,
    "npz": _decode_npz,
    "ply": _decode_ply,
    "pcd": _decode_pcd,
}

FILE_FORMATS = tuple(_DECODERS)


def _check_count(count: int, max_points: int) -> None:
    if count > max_points:
        raise PayloadTooLarge(
            "cloud", f"{count} points", f"Send at most {max_points} points, e.g. downsampled."
        )


def _is_numbers(row: object) -> bool:
    return isinstance(row, list) and all(type(value) in (int, float) for value in row)


def _brief(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
