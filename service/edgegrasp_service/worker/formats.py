"""Read point cloud files from memory: .npy, .npz, .ply, .pcd and .xyz.

The bytes are a stranger's. Nothing is unpickled, and no count in a header is trusted before it is
compared with the bytes at hand: a short file cannot make a worker allocate a large array.
"""

import io
import math
import re
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest, brief
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.errors import DecoderMissing, PayloadTooLarge, UnsupportedMediaType

Array = NDArray[Any]
Records = NDArray[np.void]

MAX_HEADER = 65536  # bytes of a PLY or PCD header; each line takes 50 times its size to read
MAX_UNPACKED = 256 * 2**20  # bytes; compressed data may claim a hundred times its own
MAX_WORD = 48  # characters of a number written as text; %.40f fits


def read_file(file_format: str, data: bytes, max_points: int) -> CloudInput:
    """Read a point cloud file.

    Args:
        file_format: One of FILE_FORMATS.
        data: The file's bytes.
        max_points: Most points accepted.

    Returns:
        The arrays in the file, of whatever shape and dtype, in native byte order; points (N, 3)
        for ply and xyz, (N, 3) or (H, W, 3) for pcd.

    Raises:
        InvalidRequest: The file is truncated, or no file of that format.
        PayloadTooLarge: More than `max_points` points.
        DecoderMissing: The reader of this format is not installed.
        UnsupportedMediaType: No such format.
    """
    if file_format not in _READERS:
        known = ", ".join(FILE_FORMATS)
        raise UnsupportedMediaType("format", repr(file_format), f"Send one of: {known}.")
    return _READERS[file_format](data, max_points)


def too_many(count: int, max_points: int, field: str = "cloud") -> PayloadTooLarge:
    """The error for more than `max_points` points."""
    fix = f"Send at most {max_points} points, e.g. downsampled."
    return PayloadTooLarge(field, f"{count} points", fix)


# .npy and .npz

NPZ_ARRAYS = ("points", "normals", "colors", "segment_ids", "view_ids")
NPZ_FIX = (
    "Send what numpy.savez(file, points=points) writes; beside points may stand "
    "normals, colors, segment_ids and view_ids."
)
MAX_AXES = 8
MAX_DIRECTORY = 65536  # bytes
DIRECTORY_END, DIRECTORY_END_64 = b"PK\5\6", b"PK\6\7"  # of a zip file


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
    sizes_are_counts = all(type(size) is int and size >= 0 for size in shape)
    if not sizes_are_counts or len(shape) > MAX_AXES:
        raise InvalidRequest(field, f"shape {brief(shape)}", fix)
    if dtype.hasobject or dtype.itemsize == 0 or dtype.subdtype is not None:
        raise InvalidRequest(field, f"dtype {str(dtype)[:60]}", "Send an array of numbers.")
    # NumPy cannot make an array of such a shape, even where one of its sizes is 0.
    if math.prod(max(size, 1) for size in shape) * dtype.itemsize >= 2**63:
        raise InvalidRequest(field, f"shape {brief(shape)}", fix)
    expected = math.prod(shape) * dtype.itemsize
    found = len(data) - stream.tell()
    if found != expected:
        raise InvalidRequest(
            field,
            f"{found} bytes of data where the .npy header, shape {shape}, promises {expected}",
            "Send the whole file.",
        )
    count = math.prod(shape[:-1] if shape[-1:] == (3,) else shape[:2])
    if count > max_points:
        raise too_many(count, max_points, field)
    array = np.frombuffer(data, dtype=dtype, offset=stream.tell())
    array = array.reshape(shape, order="F" if fortran_order else "C")
    return array.astype(dtype.newbyteorder("="), copy=False)


def _read_npz(data: bytes, max_points: int) -> CloudInput:
    """Read the arrays of an .npz file: those of NPZ_ARRAYS, or points alone under any name."""
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
                name: _unzipped(archive, info, max_points) for name, info in members.items()
            }
    except (InvalidRequest, PayloadTooLarge, MemoryError):
        raise
    except Exception:  # zipfile, too, fails in a dozen ways
        value = f"{len(data)} bytes that are no whole .npz file"
        raise InvalidRequest("cloud", value, NPZ_FIX) from None
    arrays = {
        name: read_npy(content, max_points, "cloud" if name == "points" else name)
        for name, content in contents.items()
    }
    return CloudInput(**arrays)


def _check_directory(data: bytes) -> None:
    """Raise ValueError for a directory of more members than a cloud has; zipfile reads all."""
    ends = {data.rfind(DIRECTORY_END), data.find(DIRECTORY_END, len(data) - 22)} - {-1}
    for end in ends:  # zipfile takes either
        (size,) = struct.unpack_from("<L", data, end + 12)
        if size > MAX_DIRECTORY or data[end - 20 : end - 16] == DIRECTORY_END_64:
            raise ValueError(f"a directory of {size} bytes, or one for files beyond 4 GB")


def _unzipped(archive: zipfile.ZipFile, info: zipfile.ZipInfo, max_points: int) -> bytes:
    # Six doubles a point and a header: more than any cloud of max_points needs.
    if info.file_size > 48 * max_points + 65536:
        raise PayloadTooLarge(
            "cloud",
            f"an array of {info.file_size} bytes once unpacked",
            f"Send at most {max_points} points.",
        )
    with archive.open(info) as member:
        # Without a size, read() unpacks everything, even where that is more than promised.
        return member.read(info.file_size)


# .ply
# Open3D reads PLY files too, but gives back uninitialised memory for the missing rows of a
# truncated one and merely prints a warning.

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_BYTE_ORDERS: dict[str, Literal["<", ">"]] = {
    "binary_little_endian": "<",
    "binary_big_endian": ">",
}
PLY_HEADER_END = re.compile(rb"^end_header[ \t\r]*(?:\n|\Z)", re.MULTILINE)
PLY_FIX = "Send a whole PLY file with vertices of float x, y, z."


def _read_ply(data: bytes, max_points: int) -> CloudInput:
    """Read x, y, z of the vertices, and nx, ny, nz and red, green, blue where there are any."""
    end = PLY_HEADER_END.search(data[:MAX_HEADER])
    header = b"" if end is None else data[: end.start()]
    lines = [line.split() for line in header.decode("latin-1").splitlines()]
    if end is None or lines[:1] != [["ply"]]:
        raise _no_ply(f"{len(data)} bytes that are no whole PLY file")
    encoding = next((line[1] for line in lines if line[0:1] == ["format"] and len(line) > 1), "")
    count, record = _ply_vertices(lines)
    if count > max_points:
        raise too_many(count, max_points)
    body = data[end.end() :]
    if encoding in PLY_BYTE_ORDERS:
        order = PLY_BYTE_ORDERS[encoding]
        rows = _read_binary_records(body, record.newbyteorder(order), count, "PLY")
    elif encoding == "ascii":
        rows = _read_ascii_records(body, record, count, "PLY")
    else:
        raise _no_ply(f"a PLY file of format {encoding[:40]!r}")
    return CloudInput(
        points=stack_fields(rows, ("x", "y", "z")),
        normals=stack_fields(rows, ("nx", "ny", "nz")),
        colors=stack_fields(rows, ("red", "green", "blue")),
    )


def _ply_vertices(lines: list[list[str]]) -> tuple[int, np.dtype[Any]]:
    """How many vertices a header promises, and the layout of one."""
    elements = [line for line in lines if line[0:1] == ["element"]]
    if not elements or len(elements[0]) != 3 or elements[0][1] != "vertex":
        raise _no_ply("a PLY file whose first element is no vertex")
    if not elements[0][2].isdecimal() or len(elements[0][2]) > 18:
        raise _no_ply(f"{elements[0][2][:40]!r} vertices")
    start = lines.index(elements[0]) + 1
    stop = lines.index(elements[1], start) if len(elements) > 1 else len(lines)
    fields: dict[str, str] = {}
    for line in lines[start:stop]:
        if line[0:1] != ["property"]:
            continue
        if len(line) != 3 or line[1] not in PLY_TYPES or line[2] in fields:
            raise _no_ply(f"the vertex property {' '.join(line)[:60]!r}")
        fields[line[2]] = PLY_TYPES[line[1]]
    if not {"x", "y", "z"} <= fields.keys():
        raise _no_ply(f"vertices with {', '.join(fields)[:60] or 'no properties'}")
    return int(elements[0][2]), np.dtype(list(fields.items()))


def _no_ply(value: str) -> InvalidRequest:
    return InvalidRequest("cloud", value, PLY_FIX)


# .pcd

PCD_SCALARS = {
    "F4": "<f4", "F8": "<f8",
    "I1": "<i1", "I2": "<i2", "I4": "<i4", "I8": "<i8",
    "U1": "<u1", "U2": "<u2", "U4": "<u4", "U8": "<u8",
}  # fmt: skip
PCL_NORMALS = ("normal_x", "normal_y", "normal_z")
PCL_COLORS = ("rgb", "rgba")  # packed in 4 bytes
PCD_FIX = "Send a whole PCD file with the fields x, y and z."


def _read_pcd(data: bytes, max_points: int) -> CloudInput:
    """Read x, y, z of the points, and normal_x, normal_y, normal_z and rgb where there are any."""
    header, body = _split_pcd(data)
    count, record = _pcd_layout(header)
    if count > max_points:
        raise too_many(count, max_points)
    encoding = " ".join(header["DATA"])
    if encoding == "binary_compressed":
        return _organised(_read_compressed_pcd(data, body, count, record), header)
    if encoding == "binary":
        rows = _read_binary_records(body, record, count, "PCD")
    elif encoding == "ascii":
        rows = _read_ascii_records(body, record, count, "PCD")
    else:
        raise _no_pcd(f"a PCD file with DATA {encoding[:40]!r}")
    return _organised(cloud_of_pcl_fields(rows), header)


def cloud_of_pcl_fields(rows: Records) -> CloudInput:
    """A cloud of points whose fields are named as PCL and ROS name them.

    Args:
        rows: (N,) or (H, W) with fields x, y, z; normal_x, normal_y, normal_z and rgb or rgba
            where there are any.
    """
    colors = None
    for name in PCL_COLORS:
        if name in (rows.dtype.names or ()) and rows.dtype[name].itemsize == 4:
            # 0x00RRGGBB, kept in a float32 or uint32
            packed = np.ascontiguousarray(rows[name]).view(np.uint32)
            colors = np.stack([packed >> shift & 255 for shift in (16, 8, 0)], axis=-1)
            colors = colors.astype(np.uint8)
            break
    return CloudInput(
        points=stack_fields(rows, ("x", "y", "z")),
        normals=stack_fields(rows, PCL_NORMALS),
        colors=colors,
    )


def _organised(cloud: CloudInput, header: dict[str, list[str]]) -> CloudInput:
    """The cloud with its points in rows and columns, if the header promises several rows."""
    sizes = [header.get(name, ["1"])[:1] or ["1"] for name in ("HEIGHT", "WIDTH")]
    points = np.asarray(cloud.points)
    if not all(size[0].isdecimal() and len(size[0]) < 10 for size in sizes):
        return cloud
    height, width = (int(size[0]) for size in sizes)
    if height < 2 or height * width != len(points):
        return cloud
    return replace(cloud, points=points.reshape(height, width, 3))


def _split_pcd(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The words after each keyword, up to and with the DATA line, and what follows it."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start, MAX_HEADER)
        if end < 0:
            raise _no_pcd(f"{len(data)} bytes that are no whole PCD file")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header, data[start:]


def _pcd_layout(header: dict[str, list[str]]) -> tuple[int, np.dtype[Any]]:
    """How many points a header promises, and the layout of one."""
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    kinds = list(zip(header.get("TYPE", []), header.get("SIZE", []), counts, strict=False))
    points = header.get("POINTS", [""])[:1] or [""]
    if any(names.count(axis) != 1 for axis in "xyz") or len(kinds) != len(names):
        raise _no_pcd(f"a PCD file with the fields {', '.join(names)[:60] or 'none'}")
    if not points[0].isdecimal() or len(points[0]) > 18:
        raise _no_pcd(f"a PCD file with POINTS {points[0][:40]!r}")
    fields: list[tuple[str, str]] = []
    for column, (name, (kind, size, repeat)) in enumerate(zip(names, kinds, strict=True)):
        is_count = repeat.isdecimal() and len(repeat) <= 4 and 1 <= int(repeat) <= 1000
        if kind + size not in PCD_SCALARS or not is_count:
            raise _no_pcd(f"a PCD field of TYPE {kind[:8]}, SIZE {size[:8]}, COUNT {repeat[:8]}")
        # Fields that are not read may share a name, or hold several numbers.
        known = name in ("x", "y", "z", *PCL_NORMALS, *PCL_COLORS) and names.count(name) == 1
        known = known and (repeat == "1" or name in "xyz")
        labels = [name] if known else [f"{column}.{part}" for part in range(int(repeat))]
        fields += [(label, PCD_SCALARS[kind + size]) for label in labels]
    return int(points[0]), np.dtype(fields)


def _read_compressed_pcd(data: bytes, body: bytes, count: int, record: np.dtype[Any]) -> CloudInput:
    """Have Open3D unpack a file, once its sizes are known to be true and small enough."""
    sizes = struct.unpack_from("<II", body) if len(body) >= 8 else (0, 0)
    if len(body) - 8 < sizes[0] or sizes[1] != count * record.itemsize:
        raise _no_pcd(f"{len(body)} bytes of compressed data, which are not all of a PCD file")
    if sizes[1] > MAX_UNPACKED:
        value = f"a PCD file of {sizes[1]} bytes once unpacked"
        fix = f"Send at most {MAX_UNPACKED} bytes, or fields x, y and z alone."
        raise PayloadTooLarge("cloud", value, fix)
    try:
        import open3d
    except ImportError as error:
        raise DecoderMissing(
            "cloud",
            f"a compressed PCD file, which Open3D reads, and it does not load ({error})",
            "Send an uncompressed PCD file, or install Open3D and its libraries on the server.",
        ) from None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.pcd"
        path.write_bytes(data)
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            cloud = open3d.io.read_point_cloud(path)
    if len(cloud.points) != count:
        value = f"a PCD file of {len(cloud.points)} points where its header promises {count}"
        raise _no_pcd(value)
    return CloudInput(
        points=np.asarray(cloud.points),
        normals=np.asarray(cloud.normals) if cloud.has_normals() else None,
        colors=np.asarray(cloud.colors) if cloud.has_colors() else None,
    )


def _no_pcd(value: str) -> InvalidRequest:
    return InvalidRequest("cloud", value, PCD_FIX)


# .xyz

XYZ_FIX = "Send lines of three numbers: x y z in metres. Normals and colours go into a .ply file."


def _read_xyz(data: bytes, max_points: int) -> CloudInput:
    """Read x, y, z of each line; empty lines and those that start with # are skipped."""
    numbers: list[bytes] = []
    for row, line in enumerate(data.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith(b"#"):
            continue
        if len(words) != 3:
            value = f"line {row} with {len(words)} words in an .xyz file"
            raise InvalidRequest("cloud", value, XYZ_FIX)
        numbers += words
    if len(numbers) // 3 > max_points:
        raise too_many(len(numbers) // 3, max_points)
    if not numbers:
        raise InvalidRequest("cloud", f"{len(data)} bytes without a line of an .xyz file", XYZ_FIX)
    return CloudInput(_numbers_from_words(numbers, ".xyz").reshape(-1, 3))


# Rows of PLY and PCD files: fixed records, in binary or as text.


def _read_binary_records(body: bytes, record: np.dtype[Any], count: int, kind: str) -> Records:
    """Read `count` records; raises InvalidRequest where the body is too short for them."""
    expected = count * record.itemsize
    if len(body) < expected:
        value = f"{len(body)} bytes of data where the {kind} header promises {expected}"
        raise InvalidRequest("cloud", value, "Send the whole file.")
    return np.frombuffer(body, dtype=record, count=count).astype(record.newbyteorder("="))


def _read_ascii_records(body: bytes, record: np.dtype[Any], count: int, kind: str) -> Records:
    """Read `count` records of whitespace-separated numbers; raises InvalidRequest."""
    names = record.names or ()
    expected = count * len(names)
    if expected > len(body):  # each number takes a byte at least
        value = f"{len(body)} bytes of data where the {kind} header promises {count} rows"
        raise InvalidRequest("cloud", value, "Send the whole file.")
    words = body.split(None, expected)[:expected]
    if len(words) < expected:
        value = f"{len(words)} numbers where the {kind} header promises {expected}"
        raise InvalidRequest("cloud", value, "Send the whole file.")
    table = _numbers_from_words(words, kind).reshape(count, len(names))
    rows = np.empty(count, dtype=record)
    with np.errstate(all="ignore"):
        for column, name in enumerate(names):
            rows[name] = table[:, column]
    return rows


def _numbers_from_words(words: list[bytes], kind: str) -> NDArray[np.float64]:
    """Numbers written as text, in a flat array; raises InvalidRequest."""
    longest = max(map(len, words), default=1)  # NumPy gives every element the room of the longest
    if longest > MAX_WORD:
        value = f"a word of {longest} characters in a {kind} file"
        raise InvalidRequest("cloud", value, f"Send numbers of {MAX_WORD} characters at most.")
    try:
        return np.array(words, dtype=f"S{longest}").astype(np.float64)
    except ValueError:
        value = f"text among the numbers of a {kind} file"
        raise InvalidRequest("cloud", value, "Send numbers only.") from None


def stack_fields(rows: Records, names: tuple[str, ...]) -> Array | None:
    """Fields of the rows side by side; None where one of them is missing."""
    if not set(names) <= set(rows.dtype.names or ()):
        return None
    return np.stack([rows[name] for name in names], axis=-1)


_READERS: dict[str, Callable[[bytes, int], CloudInput]] = {
    "npy": lambda data, max_points: CloudInput(read_npy(data, max_points)),
    "npz": _read_npz,
    "ply": _read_ply,
    "pcd": _read_pcd,
    "xyz": _read_xyz,
}

FILE_FORMATS = tuple(_READERS)
