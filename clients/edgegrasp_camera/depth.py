"""From depth images of cameras to a cloud."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import FARTHEST, Finite, Strict, numeric
from edgegrasp_model.scene.cloud import CloudInput

Float64 = NDArray[np.float64]
Position = tuple[float, float, float]  # metres

MILLIMETRE = 0.001  # metres for one unit of whole numbers
FOCAL_LENGTHS = 0.1, 20.0  # of the image's width or height: seen under 157 and 3 degrees
OFF_CENTRE = 0.15  # share of the width or height that a principal point hardly lies off the middle
OBLONG = 1.5  # one focal length divided by the other; none is that of a pixel

FocalLength = Annotated[float, Field(gt=0.0, le=FARTHEST), numeric]
PoseRow = tuple[Finite, Finite, Finite, Finite]


def _by_name(value: object) -> object:
    """Intrinsics by name, of four numbers or of a matrix."""
    match value:
        case (
            [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
            | [fx, 0, cx, 0, fy, cy, 0, 0, 1]
            | [fx, fy, cx, cy]
        ):
            return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        case list():
            raise ValueError("must be fx, fy, cx, cy or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return value


def _rigid(pose: tuple[PoseRow, ...]) -> tuple[PoseRow, ...]:
    matrix = np.array(pose)
    rotation = matrix[:3, :3]
    turned = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not turned or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError("must be a rotation and a translation, row-major, with last row 0 0 0 1")
    return pose


class Intrinsics(Strict):
    """A pinhole camera without distortion; the centre of the top left pixel is (0, 0)."""

    fx: FocalLength = Field(description="pixels")
    fy: FocalLength = Field(description="pixels")
    cx: Finite = Field(description="pixels")
    cy: Finite = Field(description="pixels")


class CameraView(Strict):
    """How a camera saw an image of depths. Camera frame: x right, y down, z forward."""

    intrinsics: Annotated[
        Intrinsics,
        BeforeValidator(
            _by_name, json_schema_input_type=Intrinsics | list[float] | list[list[float]]
        ),
    ] = Field(description="by name, or fx, fy, cx, cy, or the 3 x 3 matrix")
    T_cloud_camera: Annotated[tuple[PoseRow, PoseRow, PoseRow, PoseRow], AfterValidator(_rigid)] = (
        Field(
            default=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
            description="maps camera coordinates to cloud coordinates, metres",
        )
    )
    depth_scale: Annotated[float, Field(gt=0.0, le=1.0), numeric] | None = Field(
        default=None,
        description="metres for one unit of depth; null: 0.001 of whole numbers, 1 of floats",
    )


def fuse_depth_images(
    depths: Sequence[NDArray[Any]], views: Sequence[CameraView]
) -> tuple[CloudInput, list[Position]]:
    """Turn depth images into one cloud.

    Args:
        depths: (H, W) or (H, W, 1) each, uint16 or floats; 0 or NaN where there is no reading.
        views: The camera of each.

    Returns:
        A cloud whose rows are the pixels, one image after the other, with NaN where a pixel has no
        reading: (H, W, 3) for one image; for several (1, N, 3), which is no image, and the view of
        each point; what is doubtful about its cameras is in its warnings. And the position of each
        camera.

    Raises:
        InvalidRequest: An array is no image of depths, or cannot be that of its camera; names
            `depth_images.N`.
    """
    clouds: list[NDArray[np.float32]] = []
    doubts: list[str] = []
    for row, (depth, view) in enumerate(zip(depths, views, strict=True)):
        metres = _metres(depth, view.depth_scale, f"depth_images.{row}.depth")
        doubts += _doubts(view.intrinsics, metres.shape, f"depth_images.{row}.intrinsics")
        clouds.append(_points_of_pixels(metres, view))
    cameras = [(x, y, z) for (*_, x), (*_, y), (*_, z), _ in (v.T_cloud_camera for v in views)]
    if len(views) == 1:
        return CloudInput(clouds[0], warnings=tuple(doubts)), cameras
    points = np.concatenate([cloud.reshape(1, -1, 3) for cloud in clouds], axis=1)
    view_ids = np.repeat(np.arange(len(clouds)), [cloud.size // 3 for cloud in clouds])
    return CloudInput(points, view_ids=view_ids, warnings=tuple(doubts)), cameras


def _metres(depth: NDArray[Any], scale: float | None, field: str) -> Float64:
    """(H, W), NaN where there is no reading."""
    if depth.shape[2:] == (1,):
        depth = depth[..., 0]
    whole = depth.dtype == np.uint16
    if depth.ndim != 2 or 0 in depth.shape or not (whole or depth.dtype.kind == "f"):
        value = f"shape {depth.shape}, dtype {depth.dtype}"
        fix = "Send an image (H, W) of 16-bit whole numbers or of floats."
        raise InvalidRequest(field, value, fix)
    metres = depth.astype(np.float64) * (scale or (MILLIMETRE if whole else 1.0))
    if (metres < 0).any():
        worst = float(np.nanmin(metres))
        raise InvalidRequest(field, f"{worst:g} m", "Send 0 or NaN where there is no reading.")
    metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    return metres


def _doubts(camera: Intrinsics, shape: tuple[int, ...], field: str) -> Iterator[str]:
    """What is doubtful about intrinsics for an image (H, W), in words.

    Raises:
        InvalidRequest: They cannot belong to an image of that size.
    """
    height, width = shape
    image = f"an image of {width} x {height} pixels"
    fix = "Send those of this very image: where it was scaled, scaled with it. Do not crop it."
    axes = (("x", width, camera.fx, camera.cx), ("y", height, camera.fy, camera.cy))
    for axis, size, focal, centre in axes:
        if not -0.5 <= centre <= size - 0.5:
            raise InvalidRequest(f"{field}.c{axis}", f"{centre:g}, outside of {image}", fix)
        if not FOCAL_LENGTHS[0] <= focal / size <= FOCAL_LENGTHS[1]:
            raise InvalidRequest(f"{field}.f{axis}", f"{focal:g} for {image}", fix)
        if abs(centre - (size - 1) / 2) > OFF_CENTRE * size:
            yield f"{field}: c{axis} {centre:g} lies far from the middle of {image}: is it theirs?"
    if not 1 / OBLONG <= camera.fx / camera.fy <= OBLONG:
        value = f"fx {camera.fx:g} and fy {camera.fy:g}"
        raise InvalidRequest(field, value, "Send fx, fy, cx, cy in this order, in pixels.")


def _points_of_pixels(depth: Float64, view: CameraView) -> NDArray[np.float32]:
    """(H, W, 3) in the cloud's frame."""
    row, column = np.indices(depth.shape)
    camera = view.intrinsics
    pose = np.array(view.T_cloud_camera)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused as a point
        x = (column - camera.cx) / camera.fx * depth
        y = (row - camera.cy) / camera.fy * depth
        points = np.stack([x, y, depth], axis=-1) @ pose[:3, :3].T + pose[:3, 3]
        in_cloud: NDArray[np.float32] = points.astype(np.float32)
    return in_cloud
