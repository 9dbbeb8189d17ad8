"""Depth images of pinhole cameras: intrinsics, and conversion to points.

Camera frame: x right, y down, z forward; the centre of the top left pixel is (0, 0).
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from edgegrasp_camera import InvalidRequest
from edgegrasp_camera.arrays import Array, Float32, Float64
from edgegrasp_camera.clouds import CloudInput

ENCODINGS = {"32FC1": "<f4", "64FC1": "<f8", "16UC1": "<u2"}  # names from sensor_msgs/Image
MILLIMETRE = 0.001  # metres per unit of integer depths
FOCAL_LENGTH_RANGE = 0.1, 20.0  # shares of the image's size: fields of view of 157 and 3 degrees
MAX_OFF_CENTRE = 0.15  # greatest offset of the principal point, as share of the width or height
MAX_PIXEL_ASPECT = 1.5  # ratio of the focal lengths; no real pixel is that elongated


class Intrinsics(NamedTuple):
    """Intrinsics of a camera without distortion, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


class DepthView(NamedTuple):
    """The camera of a depth image: its intrinsics, pose and depth unit."""

    intrinsics: Intrinsics
    T_cloud_camera: Any = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))  # (4, 4)
    depth_scale: float | None = None  # metres per unit; None: 0.001 for integers, 1 for floats


def to_intrinsics(value: Any) -> Intrinsics:
    """Intrinsics from fx, fy, cx, cy by name or in this order, or from the (3, 3) or (9,) matrix.

    The numbers are not checked.

    Raises:
        ValueError: The value has none of these forms.
    """
    if isinstance(value, Mapping) and {*value} == {*Intrinsics._fields}:
        return Intrinsics(**value)
    match np.asarray(value, dtype=object).tolist():
        case (
            [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
            | [fx, 0, cx, 0, fy, cy, 0, 0, 1]
            | [fx, fy, cx, cy]
        ):
            return Intrinsics(fx, fy, cx, cy)
    raise ValueError("must be fx, fy, cx, cy or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")


def metres(depth: Array, scale: float | None = None, field: str = "depth") -> Float32:
    """Depths of an image (H, W) or (H, W, 1) in metres, (H, W); NaN where there is no reading.

    A missing reading is 0, NaN or infinity. `scale` is metres per unit; None: 0.001 for integers,
    1 for floats. Raises InvalidRequest, which names `field`, if it is not a depth image or has
    negative depths.
    """
    if depth.shape[2:] == (1,):
        depth = depth[..., 0]
    whole = depth.dtype == np.uint16
    if depth.ndim != 2 or 0 in depth.shape or not (whole or depth.dtype.kind == "f"):
        fix = "Send an image (H, W) of uint16 or of floats."
        raise InvalidRequest(field, f"shape {depth.shape}, dtype {depth.dtype}", fix)
    with np.errstate(over="ignore"):  # infinity is a missing reading
        found = np.ma.filled(depth, 0).astype(np.float32)
        found *= scale or (MILLIMETRE if whole else 1.0)
    below = (found < 0) & (found > -np.inf)  # ROS and ZED use -inf for surfaces that are too near
    if below.any():
        worst = float(found[below].min())
        raise InvalidRequest(field, f"{worst:g} m", "Send 0 or NaN where there is no reading.")
    np.copyto(found, np.nan, where=~((found > 0) & (found < np.inf)))
    return found


def unproject(depth: Float32, camera: Intrinsics, T_cloud_camera: Float64 | None = None) -> Float32:
    """The points (H, W, 3) of depths (H, W) in metres; NaN stays NaN.

    They are in the cloud frame of the pose (4, 4); without a pose, in the camera frame.
    """
    pose = np.eye(4) if T_cloud_camera is None else T_cloud_camera
    level = (np.arange(depth.shape[1]) - camera.cx) / camera.fx
    vertical = (np.arange(depth.shape[0]) - camera.cy) / camera.fy
    points = np.empty((*depth.shape, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # overflow is refused later
        for axis, (right, down, forward, origin) in enumerate(pose[:3].tolist()):
            of_row = (down * vertical + forward).astype(np.float32)
            way = of_row[:, None] + (right * level).astype(np.float32)  # for each metre of depth
            way *= depth
            np.add(way, np.float32(origin), out=points[..., axis])
    return points


def fuse_depth_images(depths: Sequence[Array], views: Sequence[Any]) -> CloudInput:
    """Turn depth images into one cloud.

    Args:
        depths: As for `metres`.
        views: The camera of each, with the fields of DepthView.

    Returns:
        A cloud whose rows are the pixels, image after image, NaN without a reading: (H, W, 3) for
        one image, (1, N, 3) with the view of each point for several. Its viewpoint contains the
        cameras' positions, and its warnings any doubts about the cameras.

    Raises:
        InvalidRequest: An array is not a depth image or does not fit its camera; names
            `depth_images.N`.
    """
    clouds: list[Float32] = []
    cameras: list[tuple[float, ...]] = []
    doubts: list[str] = []
    for row, (depth, view) in enumerate(zip(depths, views, strict=True)):
        found = metres(depth, view.depth_scale, f"depth_images.{row}.depth")
        field = f"depth_images.{row}.intrinsics"
        doubts += _intrinsics_warnings(view.intrinsics, found.shape, field)
        pose = np.array(view.T_cloud_camera, dtype=np.float64)
        clouds.append(unproject(found, view.intrinsics, pose))
        cameras.append(tuple(pose[:3, 3].tolist()))
    if all(np.isnan(cloud[..., 2]).all() for cloud in clouds):
        fix = "Send a depth above 0 in at least one pixel."
        raise InvalidRequest("depth_images", "no reading", fix)
    if len({*cameras}) < len(cameras):
        why = "two have the same camera position"
        doubts.append(f"depth_images: {why}: send T_cloud_camera with each.")
    if len(views) == 1:
        return CloudInput(clouds[0], viewpoint=cameras[0], warnings=tuple(doubts))
    together = np.concatenate([cloud.reshape(1, -1, 3) for cloud in clouds], axis=1)
    view_ids = np.repeat(np.arange(len(clouds)), [cloud.size // 3 for cloud in clouds])
    return CloudInput(together, view_ids=view_ids, viewpoint=tuple(cameras), warnings=tuple(doubts))


def _intrinsics_warnings(camera: Intrinsics, shape: tuple[int, ...], field: str) -> Iterator[str]:
    """Warnings of doubtful intrinsics for an image (H, W); raises InvalidRequest if impossible."""
    height, width = shape
    image = f"an image of {width} x {height} pixels"
    fix = "Send the intrinsics of this image; if it was scaled, scale them too. Do not crop it."
    axes = (("x", width, camera.fx, camera.cx), ("y", height, camera.fy, camera.cy))
    for axis, size, focal, centre in axes:
        if not -0.5 <= centre <= size - 0.5:
            raise InvalidRequest(f"{field}.c{axis}", f"{centre:g}, outside of {image}", fix)
        if not FOCAL_LENGTH_RANGE[0] <= focal / size <= FOCAL_LENGTH_RANGE[1]:
            raise InvalidRequest(f"{field}.f{axis}", f"{focal:g} for {image}", fix)
        if abs(centre - (size - 1) / 2) > MAX_OFF_CENTRE * size:
            yield f"{field}: c{axis} {centre:g} is far from the middle of {image}. Is it correct?"
    if not 1 / MAX_PIXEL_ASPECT <= camera.fx / camera.fy <= MAX_PIXEL_ASPECT:
        value = f"fx {camera.fx:g} and fy {camera.fy:g}"
        raise InvalidRequest(field, value, "Send fx, fy, cx, cy in this order, in pixels.")
