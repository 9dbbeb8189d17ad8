"""Read the points of a PCD file from memory; Open3D unpacks `binary_compressed` ones."""

import struct
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.errors import DecoderMissing, PayloadTooLarge
from edgegrasp_service.point_records import (
    columns,
    read_ascii_records,
    read_binary_records,
    unpacked_colors,
)

SCALARS = {
    "F4": "<f4", "F8": "<f8",
    "I1": "<i1", "I2": "<i2", "I4": "<i4", "I8": "<i8",
    "U1": "<u1", "U2": "<u2", "U4": "<u4", "U8": "<u8",
}  # fmt: skip
MAX_HEADER = 65536  # bytes; a line costs 50 times its own
MAX_UNPACKED = 256 * 2**20  # bytes; compressed data may claim a hundred times its own
NORMALS = ("normal_x", "normal_y", "normal_z")
COLORS = ("rgb", "rgba")  # packed in 4 bytes
FIX = "Send a whole PCD file with the fields x, y and z."


def read_pcd(data: bytes, check_count: Callable[[int], None]) -> CloudInput:
    """Read x, y, z of the points, and normal_x, normal_y, normal_z and rgb where there are any.

    Args:
        data: The file's bytes.
        check_count: Called with the promised number of points before any is read.

    Returns:
        Arrays (N, 3), or points (H, W, 3) where the file is organised; points of the type the
        file declares.

    Raises:
        InvalidRequest: The file is truncated, or no PCD file.
        DecoderMissing: The file is compressed, and Open3D is not installed.
    """
    header, body = _split_header(data)
    count, record = _layout(header)
    check_count(count)
    encoding = " ".join(header["DATA"])
    if encoding == "binary_compressed":
        return _organised(_read_compressed(data, body, count, record), header)
    if encoding == "binary":
        rows = read_binary_records(body, record, count, "PCD")
    elif encoding == "ascii":
        rows = read_ascii_records(body, record, count, "PCD")
    else:
        raise _invalid(f"a PCD file with DATA {encoding[:40]!r}")
    packed = next((rows[name] for name in COLORS if name in (record.names or ())), None)
    cloud = CloudInput(
        points=columns(rows, ("x", "y", "z")),
        normals=columns(rows, NORMALS),
        colors=unpacked_colors(packed) if packed is not None and packed.itemsize == 4 else None,
    )
    return _organised(cloud, header)


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


def _split_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The words after each keyword, up to and with the DATA line, and what follows it."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start, MAX_HEADER)
        if end < 0:
            raise _invalid(f"{len(data)} bytes that are no whole PCD file")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header, data[start:]


def _layout(header: dict[str, list[str]]) -> tuple[int, np.dtype[Any]]:
    """How many points a header promises, and the layout of one."""
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    kinds = list(zip(header.get("TYPE", []), header.get("SIZE", []), counts, strict=False))
    points = header.get("POINTS", [""])[:1] or [""]
    if any(names.count(axis) != 1 for axis in "xyz") or len(kinds) != len(names):
        raise _invalid(f"a PCD file with the fields {', '.join(names)[:60] or 'none'}")
    if not points[0].isdecimal() or len(points[0]) > 18:
        raise _invalid(f"a PCD file with POINTS {points[0][:40]!r}")
    fields: list[tuple[str, str]] = []
    for column, (name, (kind, size, repeat)) in enumerate(zip(names, kinds, strict=True)):
        if kind + size not in SCALARS or not repeat.isdecimal() or not 1 <= int(repeat) <= 1000:
            raise _invalid(f"a PCD field of TYPE {kind[:8]}, SIZE {size[:8]}, COUNT {repeat[:8]}")
        # Fields that are not read may share a name, or hold several numbers.
        known = name in ("x", "y", "z", *NORMALS, *COLORS) and names.count(name) == 1
        known = known and (repeat == "1" or name in "xyz")
        labels = [name] if known else [f"{column}.{part}" for part in range(int(repeat))]
        fields += [(label, SCALARS[kind + size]) for label in labels]
    return int(points[0]), np.dtype(fields)


def _read_compressed(data: bytes, body: bytes, count: int, record: np.dtype[Any]) -> CloudInput:
    sizes = struct.unpack_from("<II", body) if len(body) >= 8 else (0, 0)
    if len(body) - 8 < sizes[0] or sizes[1] != count * record.itemsize:
        raise _invalid(f"{len(body)} bytes of compressed data, which are not all of a PCD file")
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
        raise _invalid(value)
    return CloudInput(
        points=np.asarray(cloud.points),
        normals=np.asarray(cloud.normals) if cloud.has_normals() else None,
        colors=np.asarray(cloud.colors) if cloud.has_colors() else None,
    )


def _invalid(value: str) -> InvalidRequest:
    return InvalidRequest("cloud", value, FIX)
