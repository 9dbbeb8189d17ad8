"""Regions of the cloud: unions of shapes, of rows and of segments."""

from typing import Annotated, Literal, Self

from pydantic import Field, StrictBool, model_validator

from edgegrasp_model.option_types import (
    Finite,
    Quaternion,
    Row,
    Strict,
    UnitVector,
    Vector,
    ordered,
)

MAX_SHAPES = 64
MAX_ROWS = 5_000_000

Length = Annotated[float, Field(gt=0.0, le=1000.0)]


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


Shape = Annotated[
    Box | OrientedBox | Sphere | HalfSpace | Indices | Mask | Segments, Field(discriminator="kind")
]


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
