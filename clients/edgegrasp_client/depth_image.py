"""Depth images, as the wire takes them."""

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from edgegrasp_client.errors import invalid

ENCODINGS = {"float32": "32FC1", "float64": "64FC1", "uint16": "16UC1"}


class Intrinsics(TypedDict):
    """A pinhole camera without distortion, pixels. The centre of the top left pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float


class DepthImage(TypedDict):
    """What a camera saw. Camera frame: x right, y down, z forward."""

    depth: NDArray[Any]  # (H, W) metres as float32 or float64, millimetres as uint16; 0, NaN: none
    intrinsics: Intrinsics
    T_cloud_camera: NDArray[Any] | Sequence[Sequence[float]]  # (4, 4) camera to cloud, metres


def depth_image_fields(image: DepthImage, row: int) -> dict[str, Any]:
    """An image as the fields of edgegrasp.v1.DepthImage; `data` as bytes, the pose flat.

    Args:
        image: The image.
        row: Which of the images it is, for errors.

    Raises:
        InvalidRequestError: A field is missing, unknown, or of a wrong type or shape.
    """
    path = f"depth_images.{row}"
    names = DepthImage.__required_keys__
    if not isinstance(image, Mapping) or set(image) != names:
        found = ", ".join(map(str, image)) if isinstance(image, Mapping) else type(image).__name__
        raise invalid(path, found[:80], f"Give a mapping with {', '.join(sorted(names))}.")
    intrinsics = image["intrinsics"]
    cameras = Intrinsics.__annotations__
    if not isinstance(intrinsics, Mapping) or set(intrinsics) != set(cameras):
        value = repr(intrinsics)[:80]
        raise invalid(f"{path}.intrinsics", value, f"Give a mapping with {', '.join(cameras)}.")
    depth = image["depth"]
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.name not in ENCODINGS:
        value = (
            f"shape {depth.shape}, dtype {depth.dtype}"
            if isinstance(depth, np.ndarray)
            else f"a {type(depth).__name__}"
        )
        fix = f"Give an (H, W) array of {', '.join(ENCODINGS)}."
        raise invalid(f"{path}.depth", value, fix)
    pose = np.asarray(image["T_cloud_camera"])
    if pose.shape != (4, 4) or pose.dtype.kind not in "iuf":
        value = f"shape {pose.shape}, dtype {pose.dtype}"
        raise invalid(f"{path}.T_cloud_camera", value, "Give a 4 x 4 matrix.")
    little_endian = depth.dtype.newbyteorder("<")
    return {
        "depth": {
            "height": depth.shape[0],
            "width": depth.shape[1],
            "encoding": ENCODINGS[depth.dtype.name],
            "data": np.ascontiguousarray(depth, dtype=little_endian).tobytes(),
        },
        "intrinsics": {name: float(intrinsics[name]) for name in cameras},  # type: ignore[literal-required]
        "T_cloud_camera": pose.astype(np.float64).ravel().tolist(),
    }
