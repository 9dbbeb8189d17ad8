"""Read the vertices of a PLY file from memory.

Open3D reads PLY files too, but gives back uninitialised memory for the missing rows of a truncated
one and merely prints a warning.
"""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.point_records import columns, read_ascii_records, read_binary_records

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS: dict[str, Literal["<", ">"]] = {"binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER = 65536  # bytes; a line costs 50 times its own
FIX = "Send a whole PLY file with vertices of float x, y, z."


def read_ply(data: bytes, check_count: Callable[[int], None]) -> CloudInput:
    """Read x, y, z of the vertices, and nx, ny, nz and red, green, blue where there are any.

    Args:
        data: The file's bytes.
        check_count: Called with the promised number of vertices before any is read.

    Returns:
        Arrays (N, 3) of the types the file declares.

    Raises:
        InvalidRequest: The file is truncated, or no PLY file with vertices.
    """
    header, end, _ = data[:MAX_HEADER].partition(b"end_header")
    body = data[len(header) + len(end) :]
    lines = [line.split() for line in header.decode("latin-1").splitlines()]
    if not end or lines[:1] != [["ply"]]:
        raise _invalid(f"{len(data)} bytes that are no whole PLY file")
    encoding = next((line[1] for line in lines if line[0:1] == ["format"] and len(line) > 1), "")
    count, record = _vertex_records(lines)
    check_count(count)
    _, _, body = body.partition(b"\n")
    if encoding in BYTE_ORDERS:
        rows = read_binary_records(body, record.newbyteorder(BYTE_ORDERS[encoding]), count, "PLY")
    elif encoding == "ascii":
        rows = read_ascii_records(body, record, count, "PLY")
    else:
        raise _invalid(f"a PLY file of format {encoding[:40]!r}")
    return CloudInput(
        points=columns(rows, ("x", "y", "z")),
        normals=columns(rows, ("nx", "ny", "nz")),
        colors=columns(rows, ("red", "green", "blue")),
    )


def _vertex_records(lines: list[list[str]]) -> tuple[int, np.dtype[Any]]:
    """How many vertices a header promises, and the layout of one."""
    elements = [line for line in lines if line[0:1] == ["element"]]
    if not elements or len(elements[0]) != 3 or elements[0][1] != "vertex":
        raise _invalid("a PLY file whose first element is no vertex")
    if not elements[0][2].isdecimal() or len(elements[0][2]) > 18:
        raise _invalid(f"{elements[0][2][:40]!r} vertices")
    start = lines.index(elements[0]) + 1
    stop = lines.index(elements[1], start) if len(elements) > 1 else len(lines)
    fields: dict[str, str] = {}
    for line in lines[start:stop]:
        if line[0:1] != ["property"]:
            continue
        if len(line) != 3 or line[1] not in TYPES or line[2] in fields:
            raise _invalid(f"the vertex property {' '.join(line)[:60]!r}")
        fields[line[2]] = TYPES[line[1]]
    if not {"x", "y", "z"} <= fields.keys():
        raise _invalid(f"vertices with {', '.join(fields)[:60] or 'no properties'}")
    return int(elements[0][2]), np.dtype(list(fields.items()))


def _invalid(value: str) -> InvalidRequest:
    return InvalidRequest("cloud", value, FIX)
