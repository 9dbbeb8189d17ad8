"""Directions in which the hand may move toward the object."""

import math
from collections.abc import Callable
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from edgegrasp_model.option_types import Direction, Strict, numeric

TOP_DOWN_ANGLE = math.radians(30)  # between the hand's way and straight down
SIDE_ANGLE = math.radians(30)  # between the hand's way and the horizontal
MIN_APPROACH_UP = -0.1  # where nothing is asked for: cosine of the outward approach and up


class Cone(Strict):
    """Directions within an angle of one."""

    direction: Direction = Field(
        description="the way the hand moves toward the object, +z of the hand; any length but zero"
    )
    max_angle: Annotated[float, Field(ge=0.0, le=math.pi), numeric] = Field(
        description="radians between it and the hand's way"
    )


class ApproachDirection(Strict):
    """Directions in which the hand may move: those in any cone or in the preset.

    `top-down` is within 30 degrees of straight down, `side` within 30 degrees of the horizontal,
    both by `up`. Where no approach direction is asked for, every hand is allowed that does not
    come from more than 6 degrees below the horizontal.
    """

    cones: tuple[Cone, ...] = Field(default=(), max_length=64, description="any of these")
    preset: Literal["top-down", "side"] | None = Field(
        default=None, description="or this, relative to up"
    )

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if not self.cones and self.preset is None:
            raise ValueError("give at least one cone or a preset, or leave approach_direction out")
        return self


def allowed_ways(
    way: NDArray[np.floating],
    constraint: ApproachDirection | None,
    up: ArrayLike,
    in_frame: Callable[[ArrayLike], NDArray[np.floating]] = np.asarray,
) -> NDArray[np.bool_]:
    """Which ways the hand may move.

    Args:
        way: (E, 3) unit, the directions in which hands move; their +z.
        constraint: What was asked for.
        up: (3,) unit, in the frame of `way`.
        in_frame: Takes the constraint's directions to the frame of `way`.

    Returns:
        (E,)
    """
    rise = way @ np.asarray(up)
    if constraint is None:
        return np.asarray(-rise > MIN_APPROACH_UP)
    allowed = np.zeros(len(way), dtype=bool)
    for cone in constraint.cones:
        axis = in_frame(cone.direction)
        allowed |= way @ (axis / np.linalg.norm(axis)) >= math.cos(cone.max_angle)
    if constraint.preset == "top-down":
        allowed |= -rise >= math.cos(TOP_DOWN_ANGLE)
    if constraint.preset == "side":
        allowed |= np.abs(rise) <= math.sin(SIDE_ANGLE)
    return allowed
