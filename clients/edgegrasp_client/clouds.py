"""Clouds as a caller has them, and as the wire takes them."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from typing_extensions import NotRequired, TypedDict

from edgegrasp_camera.arrays import Array, Float32
from edgegrasp_camera.clouds import PointCloud2
from edgegrasp_camera.depth import intrinsics_of
from edgegrasp_camera.files import FILE_FORMATS
from edgegrasp_client.errors import invalid

DEPTH_ENCODINGS = {"float32": "32FC1", "float64": "64FC1", "uint16": "16UC1"}


class Intrinsics(TypedDict):
    """A pinhole camera without distortion, pixels. The centre of the top left pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float


class DepthImage(TypedDict):
    """What a camera saw. Camera frame: x right, y down, z forward."""

    # (H, W), 0 or NaN where there is no reading: metres as float32 or float64, millimetres as
    # uint16. Or the path of a file that holds it: .npy, or .png of 16 bits.
    depth: Array | str | PathLike[str]
    # Or fx, fy, cx, cy; or the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
    intrinsics: Intrinsics | Sequence[float] | Array
    # (4, 4) camera to cloud, metres; left out: the cloud's frame is the camera's.
    T_cloud_camera: NotRequired[Array | Sequence[Sequence[float]]]
    # Metres that one unit of the depth is worth; left out: 0.001 of whole numbers, 1 of floats.
    depth_scale: NotRequired[float]


Cloud = Array | str | PathLike[str] | PointCloud2


@dataclass(frozen=True)
class CloudFile:
    """A point cloud file."""

    format: str  # one of FILE_FORMATS
    data: bytes


def float32_points(cloud: Cloud) -> Float32 | None:
    """The cloud as (N, 3) float32 if it is an array of N points; None if it is not."""
    if not isinstance(cloud, np.ndarray) or cloud.dtype not in (np.float32, np.float64):
        return None
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        return None
    with np.errstate(over="ignore"):  # the server refuses infinity
        return np.ascontiguousarray(cloud, dtype=np.float32)


def cloud_file(cloud: Cloud) -> CloudFile:
    """The cloud as a file; an array of a wrong shape is sent as it is, for the server to refuse.

    Raises:
        InvalidRequestError: It is neither an array of numbers nor a readable file of a known
            format.
    """
    if isinstance(cloud, np.ndarray):
        points = float32_points(cloud)
        try:
            return CloudFile("npy", npy_bytes(cloud if points is None else points))
        except ValueError:
            fix = "Send float32 or float64 metres."
            raise invalid("cloud", f"dtype {cloud.dtype}", fix) from None
    if not isinstance(cloud, str | PathLike):
        fix = "Give an (N, 3) array in metres, a file's path, or a PointCloud2."
        raise invalid("cloud", f"a {type(cloud).__name__}", fix)
    path = Path(cloud)
    file_format = path.suffix[1:].lower()
    if file_format not in FILE_FORMATS:
        fix = f"Give one of: {', '.join(FILE_FORMATS)}; a depth image as one of depth_images."
        raise invalid("cloud", repr(path.name), fix)
    try:
        return CloudFile(file_format, path.read_bytes())
    except OSError as error:
        raise invalid("cloud", f"{path} ({error.strerror})", "Give a readable file.") from None


def npy_bytes(array: Array) -> bytes:
    """An array as an .npy file; raises ValueError for one of objects."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def is_point_cloud2(cloud: object) -> TypeGuard[PointCloud2]:
    """Whether an object has the attributes of sensor_msgs/PointCloud2."""
    return all(hasattr(cloud, name) for name in PointCloud2.__annotations__)


def point_cloud2_fields(cloud: PointCloud2) -> dict[str, Any]:
    """The fields of edgegrasp.v1.PointCloud2; `data` as bytes."""
    data = cloud.data
    if not isinstance(data, bytes):
        data = np.asarray(data, dtype=np.uint8).tobytes()
    return {
        "height": int(cloud.height),
        "width": int(cloud.width),
        "fields": [
            {
                "name": str(field.name),
                "offset": int(field.offset),
                "datatype": int(field.datatype),
                "count": int(field.count),
            }
            for field in cloud.fields
        ],
        "is_bigendian": bool(cloud.is_bigendian),
        "point_step": int(cloud.point_step),
        "row_step": int(cloud.row_step),
        "data": data,
    }


def depth_image_fields(image: DepthImage, number: int) -> dict[str, Any]:
    """The fields of edgegrasp.v1.DepthImage; `data` as bytes, the pose as a (4, 4) list.

    Args:
        image: The image.
        number: Which of the images it is, for errors.

    Raises:
        InvalidRequestError: A field is missing, unknown, or of a wrong type or shape.
    """
    path = f"depth_images.{number}"
    needed, known = DepthImage.__required_keys__, DepthImage.__annotations__
    if not isinstance(image, Mapping) or not needed <= set(image) <= set(known):
        found = ", ".join(map(str, image)) if isinstance(image, Mapping) else type(image).__name__
        fix = "Give a mapping with depth and intrinsics, T_cloud_camera and depth_scale or not."
        raise invalid(path, found[:80], fix)
    pose = np.asarray(image.get("T_cloud_camera", np.eye(4)))
    if pose.shape != (4, 4) or pose.dtype.kind not in "iuf":
        value = f"shape {pose.shape}, dtype {pose.dtype}"
        raise invalid(f"{path}.T_cloud_camera", value, "Give a 4 x 4 matrix.")
    scale = {name: image[name] for name in ("depth_scale",) if name in image}
    return {
        "depth": _depth_fields(image["depth"], f"{path}.depth"),
        "intrinsics": _intrinsics_fields(image["intrinsics"], f"{path}.intrinsics"),
        "T_cloud_camera": pose.astype(np.float64).tolist(),
        **scale,
    }


def _intrinsics_fields(intrinsics: object, path: str) -> dict[str, float]:
    """fx, fy, cx and cy of a mapping, of four numbers or of a matrix (3, 3) or (9,)."""
    try:
        numbers = intrinsics_of(intrinsics)._asdict()
        return {name: float(number) for name, number in numbers.items()}
    except (TypeError, ValueError):
        pass
    fix = "Give fx, fy, cx, cy in pixels, or the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."
    raise invalid(path, repr(intrinsics)[:80], fix)


def _depth_fields(depth: object, path: str) -> dict[str, Any]:
    """The fields of edgegrasp.v1.Depth; a .png file is sent as it is."""
    fix = f"Give an (H, W) array of {', '.join(DEPTH_ENCODINGS)}, or a .png or .npy file of one."
    if isinstance(depth, str | PathLike):
        file = Path(depth)
        try:
            if file.suffix.lower() == ".png":
                return {"encoding": "png", "data": file.read_bytes()}
            depth = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise invalid(path, f"{file} ({error})", fix) from None
    if not isinstance(depth, np.ndarray):
        raise invalid(path, f"a {type(depth).__name__}", fix)
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.dtype.name not in DEPTH_ENCODINGS:
        raise invalid(path, f"shape {depth.shape}, dtype {depth.dtype}", fix)
    little_endian = depth.dtype.newbyteorder("<")
    return {
        "height": depth.shape[0],
        "width": depth.shape[1],
        "encoding": DEPTH_ENCODINGS[depth.dtype.name],
        "data": np.ascontiguousarray(depth, dtype=little_endian).tobytes(),
    }
