"""The plane that objects rest on: given, or found in the cloud."""

from typing import Annotated, Literal

from pydantic import Field

from edgegrasp_model.option_types import Finite, Strict, UnitVector


class SupportPlane(Strict):
    """The plane objects rest on: the points x with normal . x = offset; the normal points up."""

    kind: Literal["plane"] = "plane"
    normal: UnitVector = Field(description="unit normal, away from the table")
    offset: Finite = Field(description="normal . x of its points, metres")


class RansacPlane(Strict):
    """Look for the plane in the cloud: the one of most points among those near the level.

    Found by RANSAC from the request's seed, within the workspace. Its points are removed before
    anything else; the plane stays as an obstacle. None found: a warning, and no support plane.
    """

    kind: Literal["ransac"] = "ransac"
    distance: Annotated[float, Field(gt=0.0, le=0.1)] = Field(
        default=0.005, description="metres from the plane within which points belong to it"
    )
    max_tilt: Annotated[float, Field(ge=0.0, le=3.2)] = Field(
        default=0.35, description="radians between its normal and up; from 1.58 on: any plane"
    )
    min_share: Annotated[float, Field(gt=0.0, le=1.0)] = Field(
        default=0.1, description="share of the cloud's points it must hold"
    )
