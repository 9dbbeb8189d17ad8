"""Which points of a cloud lie in the regions of a request."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import (
    Box,
    HalfSpace,
    Indices,
    Mask,
    OrientedBox,
    Region,
    Rows,
    Segments,
    Shape,
    Sphere,
)
from edgegrasp_model.scene.cloud import CheckedCloud, Float32, Voxels

Bools = NDArray[np.bool_]

HELD_SHARE = 0.5  # of a voxel's points, from which rows hold the voxel


def check_region(region: Region, cloud: CheckedCloud, field: str) -> None:
    """Check that the rows a region speaks of exist.

    Args:
        region: Its shapes, some of which may name rows.
        cloud: The cloud as sent.
        field: Name of the region in the request, for the error.

    Raises:
        InvalidRequest: An index or a mask does not suit the cloud, or it came without segments.
    """
    for part in ("include", "exclude"):
        for place, shape in enumerate(getattr(region, part)):
            here, rows = f"options.{field}.{part}.{place}", cloud.rows_sent
            if isinstance(shape, Indices) and max(shape.indices, default=0) >= rows:
                value = f"row {max(shape.indices)} of a cloud of {rows} rows"
                raise InvalidRequest(f"{here}.indices", value, f"Send rows from 0 to {rows - 1}.")
            if isinstance(shape, Mask) and len(shape.mask) != rows:
                value = f"{len(shape.mask)} values for a cloud of {rows} rows"
                raise InvalidRequest(f"{here}.mask", value, "Send one value for each row.")
            if isinstance(shape, Segments) and cloud.segment_ids is None:
                fix = f"Send one id for each point beside the cloud: {here} asks for segments."
                raise InvalidRequest("segment_ids", "nothing", fix)


def has_rows(region: Region | None) -> bool:
    """Whether a region names rows of the cloud."""
    return region is not None and any(isinstance(shape, Rows) for shape in region.include)


def inside_region(region: Region, points: Float32, voxels: Voxels, cloud: CheckedCloud) -> Bools:
    """Which voxels of the processed cloud a region holds.

    Args:
        region: Unions of shapes.
        points: (V, 3) the voxels' mean points, cloud frame.
        voxels: Which of the cloud's points are in each.
        cloud: The points in `voxels`, of the cloud as sent.

    Returns:
        (V,)
    """

    def in_any(shapes: tuple[Shape, ...]) -> Bools:
        found = np.zeros(len(points), dtype=bool)
        for shape in shapes:
            if isinstance(shape, Rows):
                found |= voxels.share(_in_rows(shape, cloud)) >= HELD_SHARE
            else:
                found |= inside_shape(shape, points)
        return found

    wanted = in_any(region.include) if region.include else np.ones(len(points), dtype=bool)
    return wanted & ~in_any(region.exclude)


def inside_shape(shape: Box | OrientedBox | Sphere | HalfSpace, points: Float32) -> Bools:
    """Which points (V, 3), in the frame of the shape's own numbers, lie in it.  # (V,)."""
    match shape:
        case Box():
            inside = (points >= np.asarray(shape.min)) & (points <= np.asarray(shape.max))
            return np.asarray(inside.all(axis=1))
        case OrientedBox():
            turn = Rotation.from_quat(shape.quaternion).as_matrix()
            within = np.abs((points - np.asarray(shape.center)) @ turn)
            return np.asarray((within <= np.asarray(shape.half_extents)).all(axis=1))
        case Sphere():
            apart = np.linalg.norm(points - np.asarray(shape.center), axis=1)
            return np.asarray(apart <= shape.radius)
        case HalfSpace():
            return np.asarray(points @ np.asarray(shape.normal) >= shape.offset)


def _in_rows(shape: Rows, cloud: CheckedCloud) -> Bools:
    """Which points of the cloud a list of rows, a mask or segments hold.  # (N,)."""
    match shape:
        case Indices():
            return np.isin(cloud.row, np.asarray(shape.indices, dtype=np.int64))
        case Mask():
            return np.frombuffer(shape.mask, dtype=bool)[cloud.row]
        case Segments():
            assert cloud.segment_ids is not None
            return np.isin(cloud.segment_ids, shape.ids)
