"""What a caller may ask of one detection; the same names on every transport."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    StrictBool,
    Tag,
    ValidationError,
    model_validator,
)

from edgegrasp_model.directions import ApproachDirection, Cone
from edgegrasp_model.errors import InvalidRequest, brief
from edgegrasp_model.gripper import GripperGeometry
from edgegrasp_model.option_types import (
    Direction,
    Integer,
    Number,
    Strict,
    Vector,
    numeric,
    ordered,
)
from edgegrasp_model.regions import Box, OrientedBox, Region
from edgegrasp_model.support import RansacPlane, SupportPlane

__all__ = [
    "ApproachDirection",
    "Box",
    "Collision",
    "Cone",
    "DetectOptions",
    "GripperGeometry",
    "OrientedBox",
    "RansacPlane",
    "Region",
    "SupportPlane",
    "Suppression",
    "Workspace",
    "parse_options",
]

MAX_APPROACH_POINTS = 256
MAX_CANDIDATES = 16_000
MAX_VIEWS = 64

CollisionMode = Literal["avoid", "penalise", "ignore"]


class Workspace(Strict):
    """An axis-aligned box in the cloud's frame; points outside are dropped first."""

    min: Vector = Field(description="lower corner, metres")
    max: Vector = Field(description="upper corner, metres")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        ordered(self.min, self.max)
        return self


class Suppression(Strict):
    """Drop a grasp near a better one: nearer than both distances."""

    translation: Number = Field(default=0.01, ge=0.0, le=1.0, description="metres between TCPs")
    rotation: Number = Field(
        default=0.5,
        ge=0.0,
        le=3.2,
        description="radians between hands, the 180 degree flip about the approach ignored",
    )


class Collision(Strict):
    """What the hand must not meet, and on which way: cloud, support plane and obstacles."""

    mode: CollisionMode = Field(
        default="avoid",
        description="grasps whose hand collides: left out, their scores worth half in the "
        "ranking, or not looked for",
    )
    margin: Number = Field(
        default=0.0,
        ge=0.0,
        le=0.1,
        description="metres kept free around the hand: its boxes are grown by this on every side",
    )
    opening: Annotated[float, Field(gt=0.0, le=1.0), numeric] | None = Field(
        default=None,
        description="metres between the fingers on the way in; null: the gripper's maximum",
    )
    approach_length: Number = Field(
        default=0.05, ge=0.0, le=1.0, description="metres of straight way in along the approach"
    )
    retreat_length: Number = Field(
        default=0.0, ge=0.0, le=1.0, description="metres of straight way out"
    )
    retreat_direction: Literal["back", "up"] = Field(
        default="back", description="way out: back along the approach, or along up"
    )
    obstacles: tuple[Annotated[Box | OrientedBox, Field(discriminator="kind")], ...] = Field(
        default=(), max_length=64, description="solid boxes beside the cloud"
    )


def _mode_as_object(value: object) -> object:
    return {"mode": value} if isinstance(value, str) else value


def _one_of_one(value: object) -> object:
    """A list of one vector is that vector, so that both are the same request."""
    if isinstance(value, (list, tuple)) and len(value) == 1 and isinstance(value[0], (list, tuple)):
        return value[0]
    return value


def _viewpoints(value: object) -> str:
    several = isinstance(value, (list, tuple)) and value and isinstance(value[0], (list, tuple))
    return "several" if several else "one"


def _support_kind(value: object) -> str | None:
    """`plane` where no kind is named."""
    if isinstance(value, Mapping):
        kind = value.get("kind", "plane")
        return kind if isinstance(kind, str) else None
    return getattr(value, "kind", None)


def _gripper_form(value: object) -> str:
    return "name" if isinstance(value, str) else "inline"


class DetectOptions(Strict):
    """Options of one detection; the defaults suit a tabletop scene seen by one camera."""

    model: str = Field(default="", description="weights to use; empty: the server's default")
    gripper: (
        Annotated[
            Annotated[str, Tag("name")] | Annotated[GripperGeometry, Tag("inline")],
            Discriminator(_gripper_form),
        ]
        | None
    ) = Field(
        default=None,
        description="name of a gripper, or a gripper; null: the one the weights were trained for",
    )
    num_approach_points: Integer = Field(
        default=32, ge=1, le=MAX_APPROACH_POINTS, description="approach points sampled"
    )
    num_candidates: Integer = Field(
        default=2000, ge=1, le=MAX_CANDIDATES, description="candidates scored at most"
    )
    sampling: Literal["farthest", "uniform"] = Field(
        default="farthest", description="how approach points are sampled"
    )
    seed: Integer = Field(default=0, ge=0, lt=2**63, description="seed of every random choice")
    viewpoint: (
        Annotated[
            Annotated[Vector, Tag("one")]
            | Annotated[
                tuple[Vector, ...], Field(min_length=2, max_length=MAX_VIEWS), Tag("several")
            ],
            Discriminator(_viewpoints),
            BeforeValidator(_one_of_one),
        ]
        | None
    ) = Field(
        default=None,
        description="camera position, metres; orients the normals. Several positions: "
        "`view_ids` beside the cloud says which one saw each point",
    )
    up: Direction = Field(
        default=(0.0, 0.0, 1.0), description="direction away from gravity; any length but zero"
    )
    support: (
        Annotated[
            Annotated[SupportPlane, Tag("plane")] | Annotated[RansacPlane, Tag("ransac")],
            Discriminator(_support_kind),
        ]
        | None
    ) = Field(
        default=None, description="plane the objects rest on; no part of the hand goes below it"
    )
    workspace: Workspace | None = Field(default=None, description="points outside are dropped")
    approach_region: Region | None = Field(
        default=None, description="where approach points may lie; null: everywhere"
    )
    contact_region: Region | None = Field(
        default=None, description="where contact points may lie; null: everywhere"
    )
    approach_direction: ApproachDirection | None = Field(
        default=None, description="ways the hand may move; null: not from below"
    )
    collision: Annotated[
        Collision,
        BeforeValidator(_mode_as_object, json_schema_input_type=CollisionMode | Collision),
    ] = Field(default=Collision(), description="what the hand must not meet; a bare mode will do")
    min_score: Number = Field(default=0.0, ge=0.0, le=1.0, description="lowest score returned")
    top_k: Integer = Field(
        default=50, ge=1, le=MAX_CANDIDATES, description="grasps returned at most"
    )
    suppression: Suppression | None = Field(
        default=Suppression(), description="non-maximum suppression; null: none"
    )
    order: Literal["score", "highest", "clearance"] = Field(
        default="score",
        description="what comes first: the score; the highest TCP along up among scores of 0.9 "
        "and more, then the others by score; or the clearance",
    )
    debug: StrictBool = Field(
        default=False, description="whether to return the processed cloud and every candidate"
    )


def parse_options(fields: object) -> DetectOptions:
    """Build options from decoded JSON.

    Raises:
        InvalidRequest: A field is unknown, of the wrong type or out of range.
    """
    try:
        return DetectOptions.model_validate(fields)
    except ValidationError as error:
        raise invalid_options(error, fields) from None


def invalid_options(
    error: ValidationError, fields: object, prefix: str = "options"
) -> InvalidRequest:
    """Say the first thing wrong in a validation error as field, value and fix."""
    first = error.errors(include_url=False)[0]
    named = first["type"] in ("missing", "extra_forbidden")
    field = ".".join([prefix, *_path(first["loc"], fields, named)])
    if first["type"] == "extra_forbidden":
        known = "" if "." in field.removeprefix(prefix + ".") else _known_options()
        return InvalidRequest(field, "an unknown field", f"Remove it{known}.")
    value = "nothing" if first["type"] == "missing" else brief(first["input"])
    fix = first["msg"].removeprefix("Value error, ")
    if first["type"] == "union_tag_invalid":
        fix = f"Set its kind to one of {first['ctx']['expected_tags']}"
    if first["type"] == "union_tag_not_found":
        fix = "Send an object that names its kind"
    return InvalidRequest(field, value, f"{fix[:1].upper()}{fix[1:]}.")


def _known_options() -> str:
    return f"; the options are: {', '.join(DetectOptions.model_fields)}"


def _path(location: Sequence[str | int], fields: object, named: bool) -> list[str]:
    """A location in the request, without the names that pydantic gives to members of unions.

    Where `named`, the last part is a field that the request lacks or should not have.
    """
    path: list[str] = []
    here: Any = fields
    for place, part in enumerate(location):
        if isinstance(part, int):
            here = here[part] if isinstance(here, (list, tuple)) and part < len(here) else None
        elif isinstance(here, Mapping) and part in here:
            here = here[part]
        elif not (named and place == len(location) - 1):
            continue
        path.append(str(part))
    return path
