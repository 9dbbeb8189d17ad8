"""Regions of the cloud: unions of shapes, of rows and of segments."""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StrictBool, model_validator
from scipy.spatial.transform import Rotation

from edgegrasp_model.cloud import Float32, Voxels
from edgegrasp_model.cloud_input import CheckedCloud
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.option_types import (
    Finite,
    Quaternion,
    Row,
    Strict,
    UnitVector,
    Vector,
    numeric,
    ordered,
)

MAX_SHAPES = 64
MAX_ROWS = 5_000_000

HELD_SHARE = 0.5  # of a voxel's points, from which rows hold the voxel

Bools = NDArray[np.bool_]
Length = Annotated[float, Field(gt=0.0, le=1000.0), numeric]


class Box(Strict):
    """An axis-aligned box in the cloud's frame."""

    kind: Literal["box"] = "box"
    min: Vector = Field(description="lower corner, metres")
    max: Vector = Field(description="upper corner, metres")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        ordered(self.min, self.max)
        return self


class OrientedBox(Strict):
    """A box in any orientation."""

    kind: Literal["oriented_box"] = "oriented_box"
    center: Vector = Field(description="its middle, metres")
    half_extents: tuple[Length, Length, Length] = Field(
        description="half its lengths along its own axes, metres"
    )
    quaternion: Quaternion = Field(
        default=(0.0, 0.0, 0.0, 1.0),
        description="x, y, z, w: turns the box's axes into the cloud's (T_cloud_box)",
    )


class Sphere(Strict):
    """A ball."""

    kind: Literal["sphere"] = "sphere"
    center: Vector = Field(description="its middle, metres")
    radius: Length = Field(description="metres")


class HalfSpace(Strict):
    """Everything on one side of a plane: the points x with normal . x >= offset."""

    kind: Literal["half_space"] = "half_space"
    normal: UnitVector = Field(description="unit, into the region")
    offset: Finite = Field(description="normal . x on the plane, metres")


class Indices(Strict):
    """Points by their row in the cloud as it was sent."""

    kind: Literal["indices"] = "indices"
    indices: tuple[Row, ...] = Field(
        max_length=MAX_ROWS, description="rows of the cloud as sent; row-major where organised"
    )


class Mask(Strict):
    """Points by one truth value for each row of the cloud as it was sent."""

    kind: Literal["mask"] = "mask"
    mask: tuple[StrictBool, ...] = Field(
        max_length=MAX_ROWS, description="as many values as the cloud has rows"
    )


class Segments(Strict):
    """Points by the segment they belong to: `segment_ids`, sent beside the cloud."""

    kind: Literal["segments"] = "segments"
    ids: tuple[Annotated[int, Field(strict=True, ge=-(2**31), lt=2**31)], ...] = Field(
        min_length=1, max_length=4096, description="values of segment_ids"
    )


Rows = Indices | Mask | Segments
Shape = Annotated[Box | OrientedBox | Sphere | HalfSpace | Rows, Field(discriminator="kind")]


class Region(Strict):
    """What lies in any of `include` and in none of `exclude`.

    Shapes see each voxel of the processed cloud as its mean point. Rows (indices, mask, segments)
    hold a voxel where they hold at least half of the points in it.
    """

    include: tuple[Shape, ...] = Field(
        default=(), max_length=MAX_SHAPES, description="union of shapes; empty: everywhere"
    )
    exclude: tuple[Shape, ...] = Field(
        default=(), max_length=MAX_SHAPES, description="union of shapes taken away"
    )


def check_region(region: Region | None, cloud: CheckedCloud, field: str) -> None:
    """Check that the rows a region speaks of exist.

    Args:
        region: None: nothing to check.
        cloud: The cloud as sent.
        field: Name of the region in the request, for the error.

    Raises:
        InvalidRequest: An index or a mask does not suit the cloud, or it came without segments.
    """
    for part in ("include", "exclude") if region is not None else ():
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


def inside_region(
    region: Region | None, points: Float32, voxels: Voxels, cloud: CheckedCloud
) -> Bools:
    """Which voxels of the processed cloud a region holds.

    Args:
        region: None: everywhere.
        points: (V, 3) the voxels' mean points, cloud frame.
        voxels: Which of the cloud's points are in each.
        cloud: The points in `voxels`, of the cloud as sent.

    Returns:
        (V,)
    """
    if region is None:
        return np.ones(len(points), dtype=bool)

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
            return np.asarray(shape.mask, dtype=bool)[cloud.row]
        case Segments():
            assert cloud.segment_ids is not None
            return np.isin(cloud.segment_ids, shape.ids)
