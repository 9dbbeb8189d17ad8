"""Clouds as files and as PointCloud2, and images, written plainly: what readers are tested with."""

import io
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured
from PIL import Image

from edgegrasp_camera.clouds import POINT_TYPES

CODES = {kind: code for code, kind in POINT_TYPES.items()}
ENCODINGS = {"<f8": "64FC1", "<f4": "32FC1", "<u2": "16UC1"}
PLY = {"binary_little_endian": "<", "binary_big_endian": ">"}


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(compressed: bool = True, **arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)
    return stream.getvalue()


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "png")
    return stream.getvalue()


def ply(points: np.ndarray, encoding: str = "binary_little_endian") -> bytes:
    """Points (N, 3) float32 with black colours, and one face."""
    fields = {"x": "f4", "red": "u1", "y": "f4", "z": "f4", "green": "u1", "blue": "u1"}
    order = PLY.get(encoding, "<")
    rows = np.zeros(len(points), [(name, order + kind) for name, kind in fields.items()])
    rows["x"], rows["y"], rows["z"] = points.T
    header = f"ply\nformat {encoding} 1.0\ncomment none\nelement vertex {len(points)}\n"
    for name, kind in fields.items():
        header += f"property {'float' if kind == 'f4' else 'uchar'} {name}\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    if encoding == "ascii":
        lines = [" ".join(repr(value.item()) for value in row) for row in rows]
        return (header + "\n".join(lines) + "\n3 0 1 2\n").encode()
    return header.encode() + rows.tobytes() + b"\3" + struct.pack("<3i", 0, 1, 2)


def pcd(points: np.ndarray, encoding: str = "binary", promised: int = -1, height: int = 1) -> bytes:
    """Points (N, 3) float32 with two numbers and a black colour each."""
    count = promised if promised >= 0 else len(points)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z n rgb\nSIZE 4 4 4 4 4\nTYPE F F F F U\n"
        f"COUNT 1 1 1 2 1\nWIDTH {count // height}\nHEIGHT {height}\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {encoding}\n"
    ).encode()
    if encoding == "ascii":
        lines = [f"{x!r} {y!r} {z!r} 0 0 0\n" for x, y, z in points.astype(float).tolist()]
        return header + "".join(lines).encode()
    rows = np.pad(points.astype("<f4"), ((0, 0), (0, 3)))
    if encoding == "binary":
        return header + rows.tobytes()
    plain = np.ascontiguousarray(rows.T).tobytes()
    packed = lzf_literals(plain)
    return header + struct.pack("<II", len(packed), len(plain)) + packed


def lzf_literals(plain: bytes) -> bytes:
    """LZF without a back reference: runs of up to 32 bytes, each after its length less one."""
    runs = (plain[start : start + 32] for start in range(0, len(plain), 32))
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def xyz(points: np.ndarray) -> bytes:
    rows = [f"{x!r} {y!r}\t{z!r}" for x, y, z in points.astype(float).tolist()]
    return ("# x y z\n\n" + "\n".join(rows) + "\n").encode()


def point_cloud2(points: np.ndarray, padding: int = 0, big: bool = False) -> dict[str, Any]:
    """The fields of a sensor_msgs/PointCloud2, with bytes after every row of points.

    Points are (N, 3) or (H, W, 3), or a structured array (H, W) of whatever fields.
    """
    rows = points
    if rows.dtype.names is None:
        kind = [(axis, rows.dtype) for axis in "xyz"]
        rows = np.atleast_2d(unstructured_to_structured(rows, np.dtype(kind)))
    record = rows.dtype.newbyteorder(">" if big else "<")
    fields = [
        {
            "name": name,
            "offset": int(record.fields[name][1]),
            "datatype": CODES[rows.dtype[name].base.str[1:]],
            "count": int(np.prod(rows.dtype[name].shape, dtype=int)),
        }
        for name in record.names
    ]
    height, width = rows.shape
    size = {"height": height, "width": width, "point_step": record.itemsize}
    data = b"".join(row.astype(record).tobytes() + bytes(padding) for row in rows)
    layout = {"is_bigendian": big, "row_step": width * record.itemsize + padding, "data": data}
    return size | {"fields": fields} | layout


def ros_message(points: np.ndarray, **changes: Any) -> SimpleNamespace:
    """A message as ROS has it, of points as in `point_cloud2`."""
    layout = point_cloud2(points)
    fields = [SimpleNamespace(**field) for field in layout["fields"]]
    layout |= {"fields": fields, "is_dense": True, "header": None}
    return SimpleNamespace(**layout | changes)


def depth_image(depth: np.ndarray, /, *camera: float, **changes: Any) -> dict[str, Any]:
    """One of `depth_images`, of depths (H, W) in the type of an encoding and fx, fy, cx, cy."""
    pixels = {"height": depth.shape[0], "width": depth.shape[1], "data": depth.tobytes()}
    return {
        "depth": pixels | {"encoding": ENCODINGS[depth.dtype.str]},
        "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), camera, strict=True)),
        "T_cloud_camera": np.eye(4).tolist(),
    } | changes


def block_obj(x: float, y: float, z: float) -> str:
    """An OBJ file of a block from the origin to a corner."""
    quads = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    corners = [f"v {a} {b} {c}\n" for a in (0, x) for b in (0, y) for c in (0, z)]
    return "".join([*corners, *(f"f {quad}\n" for quad in quads)])
