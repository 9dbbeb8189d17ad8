"""What a caller may ask of one detection; the same names on every transport."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from edgegrasp_model.errors import InvalidRequest

Vector = Annotated[
    tuple[
        Annotated[float, Field(allow_inf_nan=False)],
        Annotated[float, Field(allow_inf_nan=False)],
        Annotated[float, Field(allow_inf_nan=False)],
    ],
    Field(description="x, y, z in the cloud's frame"),
]

MAX_APPROACH_POINTS = 256
MAX_CANDIDATES = 16_000


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Workspace(_Strict):
    """An axis-aligned box in the cloud's frame; points outside are dropped first."""

    min: Vector = Field(description="lower corner, metres")
    max: Vector = Field(description="upper corner, metres")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not all(low < high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError("every coordinate of min must be below that of max")
        return self


class SupportPlane(_Strict):
    """The plane objects rest on: the points x with normal . x = offset; the normal points up."""

    normal: Vector = Field(description="unit normal, away from the table")
    offset: float = Field(allow_inf_nan=False, description="normal . x of its points, metres")

    @model_validator(mode="after")
    def _unit(self) -> Self:
        if abs(float(np.linalg.norm(self.normal)) - 1.0) > 1e-3:
            raise ValueError("normal must have length 1")
        return self


class Suppression(_Strict):
    """Drop a grasp near a better one: nearer than both distances."""

    translation: float = Field(default=0.01, ge=0.0, le=1.0, description="metres between TCPs")
    rotation: float = Field(
        default=0.5,
        ge=0.0,
        le=3.2,
        description="radians between hands, the 180 degree flip about the approach ignored",
    )


class DetectOptions(_Strict):
    """Options of one detection; the defaults suit a tabletop scene seen by one camera."""

    model: str = Field(default="", description="weights to use; empty: the server's default")
    num_approach_points: int = Field(
        default=32, ge=1, le=MAX_APPROACH_POINTS, description="approach points sampled"
    )
    num_candidates: int = Field(
        default=2000, ge=1, le=MAX_CANDIDATES, description="candidates scored at most"
    )
    sampling: Literal["farthest", "uniform"] = Field(
        default="farthest", description="how approach points are sampled"
    )
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of the sampling")
    viewpoint: Vector | None = Field(
        default=None, description="camera position, metres; orients the normals"
    )
    up: Vector = Field(default=(0.0, 0.0, 1.0), description="direction away from gravity")
    support: SupportPlane | None = Field(
        default=None, description="plane the objects rest on; no part of the hand goes below it"
    )
    workspace: Workspace | None = Field(default=None, description="points outside are dropped")
    collision: Literal["avoid", "penalise", "ignore"] = Field(
        default="avoid",
        description="grasps whose hand meets the cloud: left out, ranked last, or not looked for",
    )
    min_score: float = Field(default=0.0, ge=0.0, le=1.0, description="lowest score returned")
    top_k: int = Field(default=50, ge=1, le=MAX_CANDIDATES, description="grasps returned at most")
    suppression: Suppression | None = Field(
        default=Suppression(), description="non-maximum suppression; null: none"
    )

    @model_validator(mode="after")
    def _up_is_a_direction(self) -> Self:
        if float(np.linalg.norm(self.up)) < 1e-6:
            raise ValueError("up must not be the zero vector")
        return self


def parse_options(fields: object) -> DetectOptions:
    """Build options from decoded JSON.

    Raises:
        InvalidRequest: A field is unknown, of the wrong type or out of range.
    """
    try:
        return DetectOptions.model_validate(fields)
    except ValidationError as error:
        raise invalid_options(error) from None


def invalid_options(error: ValidationError, prefix: str = "options") -> InvalidRequest:
    """Say the first thing wrong in a validation error as field, value and fix."""
    first = error.errors(include_url=False)[0]
    field = ".".join([prefix, *(str(part) for part in first["loc"])])
    if first["type"] == "extra_forbidden":
        known = ", ".join(DetectOptions.model_fields)
        return InvalidRequest(field, "an unknown field", f"Remove it; the options are: {known}.")
    value = repr(first["input"])
    value = value if len(value) <= 80 else value[:77] + "..."
    return InvalidRequest(field, value, f"{first['msg']}.")
