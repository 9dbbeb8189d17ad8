"""Turn depth images into one cloud."""

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import MAX_VIEWS, Finite, Strict
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.npy_file import check_count
from edgegrasp_service.sent_arrays import array_from_lists
from edgegrasp_service.sent_fields import Bytes, parse_fields

FIELD = "depth_images"
ENCODINGS = {"32FC1": ("<f4", 1.0), "64FC1": ("<f8", 1.0), "16UC1": ("<u2", 0.001)}

Pixels = Annotated[int, Field(ge=1, le=65536)]
Row = tuple[Finite, Finite, Finite, Finite]


def _rigid(pose: tuple[Row, Row, Row, Row]) -> tuple[Row, Row, Row, Row]:
    matrix = np.array(pose)
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        turned = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not turned or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError("must be a rotation and a translation, row-major, with last row 0 0 0 1")
    return pose


Pose = Annotated[tuple[Row, Row, Row, Row], AfterValidator(_rigid)]


class Depth(Strict):
    """An image of depths, row by row from the top left pixel; 0 or NaN: no reading."""

    height: Pixels
    width: Pixels
    encoding: str = Field(description="32FC1 or 64FC1, metres; 16UC1, millimetres")
    data: Bytes = Field(description="packed little-endian pixels, as base64 in JSON")


class Intrinsics(Strict):
    """A pinhole camera without distortion; the centre of the top left pixel is (0, 0)."""

    fx: Annotated[Finite, Field(gt=0.0)] = Field(description="pixels")
    fy: Annotated[Finite, Field(gt=0.0)] = Field(description="pixels")
    cx: Finite = Field(description="pixels")
    cy: Finite = Field(description="pixels")


class DepthImage(Strict):
    """What a camera saw. Camera frame: x right, y down, z forward."""

    depth: Any = Field(description="rows of metres, or an object as Depth")
    intrinsics: Intrinsics
    T_cloud_camera: Pose = Field(description="maps camera coordinates to cloud coordinates, metres")


def fuse_depth_images(
    images: object, max_points: int
) -> tuple[CloudInput, list[tuple[float, float, float]]]:
    """Turn views into one cloud.

    Args:
        images: A list of DepthImage, as plain values.
        max_points: Most pixels accepted, of all images together.

    Returns:
        A cloud whose rows are the pixels, one image after the other, with NaN where a pixel has no
        reading: (H, W, 3) for one image, (1, N, 3) and the view of each for several. And the
        position of each camera, metres.

    Raises:
        InvalidRequest: A field is missing, unknown or wrong.
        PayloadTooLarge: More than `max_points` pixels.
    """
    views = _parsed(images)
    depths, pixels = [], 0
    for row, view in enumerate(views):
        depths.append(_depth(view.depth, f"{FIELD}.{row}.depth"))
        pixels += depths[-1].size
        check_count(pixels, max_points, FIELD)
    clouds = [_points(depth, view) for depth, view in zip(depths, views, strict=True)]
    positions = [_position(view) for view in views]
    if len(views) == 1:
        return CloudInput(clouds[0]), positions
    points = np.concatenate([cloud.reshape(1, -1, 3) for cloud in clouds], axis=1)
    view_ids = np.repeat(np.arange(len(clouds)), [depth.size for depth in depths])
    return CloudInput(points, view_ids=view_ids), positions


def _parsed(images: object) -> tuple[DepthImage, ...]:
    if not isinstance(images, list) or not 1 <= len(images) <= MAX_VIEWS:
        count = f"{len(images)} images" if isinstance(images, list) else repr(images)[:80]
        raise InvalidRequest(FIELD, count, f"Send a list of 1 to {MAX_VIEWS} images.")
    return tuple(
        parse_fields(DepthImage, image, f"{FIELD}.{row}") for row, image in enumerate(images)
    )


def _position(view: DepthImage) -> tuple[float, float, float]:
    (*_, x), (*_, y), (*_, z), _ = view.T_cloud_camera
    return x, y, z


def _depth(depth: object, field: str) -> NDArray[np.float64]:
    """(H, W) metres, NaN where there is no reading."""
    if isinstance(depth, list):
        array = array_from_lists(field, [_nan_for_none(row) for row in depth])
        if array.ndim != 2 or 0 in array.shape:
            raise InvalidRequest(field, f"shape {array.shape}", "Send rows of one length.")
        metres = array.astype(np.float64)
    else:
        metres = _unpacked(depth, field)
    if (metres < 0).any():
        worst = float(np.nanmin(metres))
        raise InvalidRequest(field, f"{worst:g} m", "Send 0 or NaN where there is no reading.")
    metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    return metres


def _unpacked(depth: object, field: str) -> NDArray[np.float64]:
    image = parse_fields(Depth, depth, field)
    if image.encoding not in ENCODINGS:
        fix = f"Send one of: {', '.join(ENCODINGS)}."
        raise InvalidRequest(f"{field}.encoding", repr(image.encoding)[:80], fix)
    dtype, metres = ENCODINGS[image.encoding]
    expected = image.height * image.width * np.dtype(dtype).itemsize
    if len(image.data) != expected:
        value = f"{len(image.data)} bytes where height, width and encoding ask for {expected}"
        raise InvalidRequest(f"{field}.data", value, "Send the whole image.")
    pixels = np.frombuffer(image.data, dtype).reshape(image.height, image.width)
    return pixels.astype(np.float64) * metres


def _nan_for_none(row: object) -> object:
    return [np.nan if value is None else value for value in row] if isinstance(row, list) else row


def _points(depth: NDArray[np.float64], view: DepthImage) -> NDArray[np.float32]:
    """(H, W, 3) in the cloud's frame."""
    row, column = np.indices(depth.shape)
    camera = view.intrinsics
    pose = np.array(view.T_cloud_camera)
    with np.errstate(over="ignore", invalid="ignore"):  # what is no point is refused as such
        x = (column - camera.cx) / camera.fx * depth
        y = (row - camera.cy) / camera.fy * depth
        points = np.stack([x, y, depth], axis=-1) @ pose[:3, :3].T + pose[:3, 3]
        in_cloud: NDArray[np.float32] = points.astype(np.float32)
    return in_cloud
