"""Read point cloud files from memory: .npy, .npz, .ply, .pcd and .xyz; and .png images.

The bytes are untrusted. Nothing is unpickled, and counts in headers are compared with the bytes
present, so a short file cannot make a worker allocate a large array.
"""

import io
import math
import re
import struct
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

from edgegrasp_camera import EdgeGraspError, InvalidRequest, PayloadTooLarge, UnsupportedMediaType
from edgegrasp_camera.arrays import Array, Float64
from edgegrasp_camera.clouds import PCL_FIELDS, CloudInput, Records, cloud_from_records, too_many
from edgegrasp_camera.depth import DepthView, fuse_depth_images, to_intrinsics

MAX_HEADER = 65536  # bytes of a PLY or PCD header; each line takes 50 times its size to read
MAX_NPY_HEADER = 1024  # bytes; deeply nested brackets would exhaust the memory of Python's parser
MAX_CHUNKS = 4096  # chunks of a PNG file, of any size
MAX_LINE = 65536  # maximum bytes of a line of numbers; reading it takes 15 times its size
MAX_UNPACKED = 256 * 2**20  # bytes; compressed data may claim a hundred times its own size
MAX_MEMBERS = 64  # of an .npz file, which has 5 arrays at most
ZIP_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others can take unlimited memory
OBJECT_ADDRESS = re.compile(r" at 0x[0-9a-f]+")  # an object's address, in a library's message

FIXES = {
    "npy": "Send what numpy.save(file, points) writes, points of shape (N, 3).",
    "npz": "Send what numpy.savez(file, points=points) writes, or depth and intrinsics; optional "
    "arrays are rgb, or normals, colors, segment_ids and view_ids.",
    "ply": "Send a whole PLY file with vertices of float x, y, z.",
    "pcd": "Send a whole PCD file with the fields x, y and z.",
    "xyz": "Send lines of three numbers: x y z in metres. Use .ply for normals and colours.",
}
FILE_FORMATS = tuple(FIXES)
NPZ_CLOUD = {"points", "normals", "colors", "segment_ids", "view_ids"}
NPZ_IMAGE = {"depth", "intrinsics"}  # the cloud is in the camera frame


def read_file(file_format: str, data: bytes, max_points: int) -> CloudInput:
    """Read a point cloud file: its arrays, of any shape and dtype, in native byte order.

    Points are (N, 3) for ply and xyz, (N, 3) or (H, W, 3) for pcd.

    Raises:
        InvalidRequest: The file is truncated, or not a file of that format.
        PayloadTooLarge: More than `max_points` points.
        UnsupportedMediaType: The format is unknown.
    """
    if file_format not in _READERS:
        fix = f"Send one of: {', '.join(FILE_FORMATS)}; a depth image as `depth` with `intrinsics`."
        raise UnsupportedMediaType("format", repr(file_format), fix)
    with _reading("cloud", file_format, len(data), FIXES[file_format]):
        return _READERS[file_format](data, max_points)


def pixels(file: Path) -> Array:
    """The values of an image file, .png or .npy: (H, W), or (H, W, C) of several channels."""
    if (kind := file.suffix.lower()) not in (".png", ".npy"):
        raise UnsupportedMediaType(file.name, repr(file.suffix), "Give a .png or .npy file.")
    read = read_png if kind == ".png" else read_npy
    return read(file.read_bytes(), sys.maxsize, file.name)


@contextmanager
def _reading(field: str, file_format: str, size: int, fix: str) -> Iterator[None]:
    """Turns every exception of a reader into InvalidRequest."""
    try:
        yield
    except (EdgeGraspError, MemoryError):
        raise
    except Exception as error:
        fault = OBJECT_ADDRESS.sub("", str(error).partition(";")[0])[:100] or type(error).__name__
        value = f"{size} bytes that are not a complete .{file_format} file ({fault})"
        raise InvalidRequest(field, value, fix) from None


# .npy and .npz


def read_npy(data: bytes, max_points: int, field: str = "cloud") -> Array:
    """Read the array of an .npy file, of any shape and dtype, in native byte order.

    A row or a pixel counts as one point; `field` is the name of the file in the request.

    Raises:
        InvalidRequest: The file is truncated, or not a .npy file of numbers.
        PayloadTooLarge: More than `max_points` points.
    """
    fix = FIXES["npy"] if field == "cloud" else f"Send what numpy.save(file, {field}) writes."
    with _reading(field, "npy", len(data), fix):
        stream = io.BytesIO(data)
        read = np.lib.format.read_array_header_1_0
        if np.lib.format.read_magic(stream) != (1, 0):
            read = np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read(stream, max_header_size=MAX_NPY_HEADER)
        if not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError(f"shape {shape}")
        found, expected = len(data) - stream.tell(), math.prod(shape) * dtype.itemsize
        if found != expected:
            raise ValueError(f"{found} bytes of data where its shape {shape} promises {expected}")
        array = np.frombuffer(data, dtype, offset=stream.tell())  # raises for dtype object
        array = array.reshape(shape, order="F" if fortran_order else "C")
    count = math.prod(shape[:-1] if shape[-1:] == (3,) else shape[:2])
    if count > max_points:
        raise too_many(count, max_points, field)
    return array.astype(dtype.newbyteorder("="), copy=False)


def _read_npz(data: bytes, max_points: int) -> CloudInput:
    """Read points or a depth image with its per-point arrays, or points alone under any name."""
    if data.count(b"PK\1\2") > MAX_MEMBERS:  # zipfile reads the whole directory
        raise ValueError(f"more than {MAX_MEMBERS} arrays")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        if "points" not in members and len(members) == 1:
            members = {"points": next(iter(members.values()))}
        known = {*NPZ_IMAGE, "rgb"} if members.keys() >= NPZ_IMAGE else {*NPZ_CLOUD, "rgb"}
        if not members.keys() & {"points", *(known & NPZ_IMAGE)}:
            raise ValueError(f"with {', '.join(sorted(members)[:5])}, and no array points")
        arrays: dict[str, Any] = {}
        for name, info in members.items():
            if name in known:
                field = "cloud" if name == "points" else name
                arrays[name] = read_npy(_unzipped(archive, info, max_points), max_points, field)
    rgb, unread = arrays.pop("rgb", None), sorted(members.keys() - known)
    said = (f"arrays of the file that are not read: {', '.join(unread[:5])}.",) if unread else ()
    if "depth" in arrays:
        try:
            view = DepthView(to_intrinsics(np.ravel(arrays["intrinsics"])))
        except ValueError as error:
            value = f"{arrays['intrinsics'].size} numbers that {error}"
            raise InvalidRequest("cloud.intrinsics", value, FIXES["npz"]) from None
        cloud = fuse_depth_images([arrays["depth"]], [view])
    else:
        cloud = CloudInput(**arrays)
    if rgb is not None and cloud.colors is None and rgb.shape == np.asarray(cloud.points).shape:
        cloud = replace(cloud, colors=rgb)
    return replace(cloud, warnings=(*cloud.warnings, *said))


def _unzipped(archive: zipfile.ZipFile, info: zipfile.ZipInfo, max_points: int) -> bytes:
    if info.compress_type not in ZIP_METHODS:
        raise ValueError("compressed by a method that numpy does not use")
    # Six doubles per point and a header: more than any cloud of max_points needs.
    if info.file_size > 48 * max_points + 65536:
        value = f"an array of {info.file_size} bytes once unpacked"
        raise PayloadTooLarge("cloud", value, f"Send at most {max_points} points.")
    with archive.open(info) as member:
        # Without a size, read() would unpack everything, even beyond the promised size.
        return member.read(info.file_size)


# .png


def read_png(data: bytes, max_points: int, field: str) -> Array:
    """Read an image: (H, W) bool, uint8 or uint16, or (H, W, C) uint8 of C channels.

    Raises:
        InvalidRequest: The file is truncated, or not a PNG.
        PayloadTooLarge: More than `max_points` pixels.
    """
    from PIL import Image  # not in the base install

    fix = "Send a whole PNG file, of 16-bit greyscale for depths."
    with _reading(field, "png", len(data), fix), warnings.catch_warnings():
        warnings.simplefilter("error")  # warning of a huge image
        start = 8
        for _ in range(MAX_CHUNKS):
            start += 12 + int.from_bytes(data[start : start + 4], "big")
        if start < len(data):
            raise ValueError(f"more than {MAX_CHUNKS} chunks")
        image = Image.open(io.BytesIO(data), formats=["PNG"])
        if image.width * image.height > max_points:
            raise too_many(image.width * image.height, max_points, field)
        return np.array(image)


# Records of numbers, in binary or as text: the points of PLY and PCD files and of PointCloud2


def _read_header(data: bytes, last: re.Pattern[bytes]) -> tuple[list[list[str]], re.Match[bytes]]:
    """The words of the header's lines, and the match of its last line."""
    end = last.search(data[:MAX_HEADER])
    if end is None:
        raise ValueError("no header")
    return [line.split() for line in data[: end.start()].decode("latin-1").split("\n")], end


def _record(fields: Iterable[tuple[str, str, int]], order: str) -> np.dtype[Any]:
    """The dtype of a point from name, type and count of each field; "": a skipped field."""
    layout = [
        (name if name and count == 1 else f"{column}", order + kind, (count,) if count != 1 else ())
        for column, (name, kind, count) in enumerate(fields)
    ]
    record = np.dtype(layout)
    if not {"x", "y", "z"} <= {*(record.names or ())}:
        raise ValueError("points or vertices without x, y, z")
    return record


def _read_records(
    body: bytes, record: np.dtype[Any], count: int, max_points: int, encoding: str
) -> Records:
    """Read `count` records, after checking that the body contains as many."""
    if count > max_points:
        raise too_many(count, max_points)
    if encoding == "binary_compressed":
        return _read_compressed_records(body, record, count)
    text = encoding == "ascii"
    columns = sum(math.prod(record[name].shape) for name in record.names or ())
    if count < 1 or count * (columns if text else record.itemsize) > len(body):
        raise ValueError(f"{len(body)} bytes of data where the header promises {count} rows")
    if not text:
        return np.frombuffer(body, record, count).astype(record.newbyteorder("="))
    if columns > MAX_LINE:
        raise ValueError(f"rows of {columns} numbers")
    table = _read_text(body, usecols=range(columns), max_rows=count, comments=None)
    if len(table) < count:
        raise ValueError(f"{len(table)} rows where the header promises {count}")
    with np.errstate(all="ignore"):
        return unstructured_to_structured(table, record, casting="unsafe")


def _read_text(data: bytes, **options: Any) -> Float64:
    for start in range(0, len(data) - MAX_LINE, MAX_LINE):
        if data.find(b"\n", start, start + MAX_LINE) < 0:
            raise ValueError(f"a line of more than {MAX_LINE} characters")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warning of no data; the caller counts rows
        return np.loadtxt(io.BytesIO(data), ndmin=2, encoding="latin-1", **options)


# .ply

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_FIELDS = {name: name for name in ("x", "y", "z", "red", "green", "blue")}
PLY_FIELDS |= {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_HEADER_END = re.compile(rb"^end_header[ \t\r]*\n", re.MULTILINE)


def _read_ply(data: bytes, max_points: int) -> CloudInput:
    """Read x, y, z of the vertices, and nx, ny, nz and red, green, blue if present."""
    lines, end = _read_header(data, PLY_HEADER_END)
    encoding = next((line[1] for line in lines if line[:1] == ["format"]), "")
    elements = [row for row, line in enumerate(lines) if line[:1] == ["element"]]
    if not elements or encoding not in PLY_ORDERS or lines[elements[0]][1] != "vertex":
        raise ValueError("an unknown format, or a first element other than vertex")
    properties = lines[elements[0] + 1 : [*elements, None][1]]
    fields = [line[1:] for line in properties if line[:1] == ["property"]]
    if any(len(field) != 2 or field[0] not in PLY_TYPES for field in fields):
        raise ValueError("a vertex property that is not a single number")
    layout = [(PLY_FIELDS.get(name, ""), PLY_TYPES[kind], 1) for kind, name in fields]
    record = _record(layout, PLY_ORDERS[encoding])
    count, body = int(lines[elements[0]][2]), data[end.end() :]
    return cloud_from_records(_read_records(body, record, count, max_points, encoding))


# .pcd

MAX_VIEWPOINT_DISTANCE = 1e7  # metres of a VIEWPOINT from the origin
PCD_TYPES = {"F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"}
PCD_HEADER_END = re.compile(rb"^DATA[ \t]+(ascii|binary|binary_compressed)[ \t\r]*\n", re.MULTILINE)


def _read_pcd(data: bytes, max_points: int) -> CloudInput:
    """Read x, y, z of the points, and normals, rgb and the viewpoint if present."""
    lines, end = _read_header(data, PCD_HEADER_END)
    header = {words[0]: words[1:] for words in lines if words}
    names = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(names))
    kinds = [kind + size for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    if not PCD_TYPES.issuperset(kinds):
        raise ValueError(f"fields of TYPE and SIZE {', '.join(kinds)}")
    fields = [
        (name if name in PCL_FIELDS else "", kind.lower(), int(count))
        for name, kind, count in zip(names, kinds, counts, strict=True)
    ]
    record, count, body = _record(fields, "<"), int(header["POINTS"][0]), data[end.end() :]
    cloud = cloud_from_records(_read_records(body, record, count, max_points, end[1].decode()))
    place = tuple(map(float, header.get("VIEWPOINT", [])[:3]))  # of the camera
    if any(place):  # zeros: unknown
        if len(place) < 3 or not all(abs(one) <= MAX_VIEWPOINT_DISTANCE for one in place):
            raise ValueError(f"VIEWPOINT {' '.join(map(str, place))}")
        cloud = replace(cloud, viewpoint=place)
    height, width = (int(header.get(name, ["1"])[0]) for name in ("HEIGHT", "WIDTH"))
    if height < 2 or height * width != count:
        return cloud
    return replace(cloud, points=np.asarray(cloud.points).reshape(height, width, 3))


def _read_compressed_records(body: bytes, record: np.dtype[Any], count: int) -> Records:
    """Read `count` records that are compressed field by field: all x, then all y, and so on."""
    packed, unpacked = struct.unpack_from("<II", body)
    if len(body) - 8 < packed or unpacked != count * record.itemsize:
        raise ValueError(f"{len(body)} bytes of compressed data where more are promised")
    if unpacked > MAX_UNPACKED:
        fix = f"Send at most {MAX_UNPACKED} bytes, or fields x, y and z alone."
        raise PayloadTooLarge("cloud", f"a PCD file of {unpacked} bytes once unpacked", fix)
    columns, start = _unpack_lzf(body[8 : 8 + packed], unpacked), 0
    rows = np.empty(count, record.newbyteorder("="))
    for name in record.names or ():
        one, shape = record[name].base, (count, *record[name].shape)
        rows[name] = np.frombuffer(columns, one, math.prod(shape), start).reshape(shape)
        start += count * record[name].itemsize
    return rows


def _unpack_lzf(packed: bytes, size: int) -> bytearray:
    """Decompress LZF: literal runs and back references; raises ValueError or IndexError.

    A byte n below 32 is followed by n + 1 literal bytes. Others hold 3 bits of length, where 7
    means that another byte is added, and 13 bits of distance, the lowest 8 in the last byte.
    """
    plain, place = bytearray(), 0
    while place < len(packed) and len(plain) <= size:
        control, place = packed[place], place + 1
        if control < 32:
            plain += packed[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length, place = length + packed[place], place + 1
        length, distance = length + 2, ((control & 31) << 8 | packed[place]) + 1
        place += 1
        start = len(plain) - distance
        if start < 0:
            raise ValueError("compressed data that refers to bytes before its start")
        copied = plain[start : start + length]
        plain += (copied * (length // distance + 1))[:length]  # the copy may overlap its own output
    if len(plain) != size or place != len(packed):
        raise ValueError(f"{len(plain)} bytes of compressed data where {size} are promised")
    return plain


# .xyz


def _read_xyz(data: bytes, max_points: int) -> CloudInput:
    """Read x, y, z of each line; empty lines and those that start with # are skipped."""
    points = _read_text(data)
    if not points.size:
        raise ValueError("no line of numbers")
    if points.shape[1] != 3:
        raise ValueError(f"{points.shape[1]} numbers in a line")
    if len(points) > max_points:
        raise too_many(len(points), max_points)
    return CloudInput(points)


_READERS: dict[str, Callable[[bytes, int], CloudInput]] = {
    "npy": lambda data, max_points: CloudInput(read_npy(data, max_points)),
    "npz": _read_npz,
    "ply": _read_ply,
    "pcd": _read_pcd,
    "xyz": _read_xyz,
}
