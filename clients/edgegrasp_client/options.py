"""Options of a request; what is left out, or None, takes the server's default."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from edgegrasp_client.errors import invalid

Vector = Sequence[float] | NDArray[Any]  # x, y, z in the cloud's frame


class Workspace(TypedDict):
    """An axis-aligned box in the cloud's frame."""

    min: Vector  # lower corner, metres
    max: Vector  # upper corner, metres


class SupportPlane(TypedDict):
    """The points p with normal . p = offset."""

    kind: NotRequired[Literal["plane"]]
    normal: Vector  # unit, away from the table
    offset: float  # metres
    max_depth_error: NotRequired[float]  # share of the depths that what is seen of it may correct


class RansacPlane(TypedDict):
    """Look for the plane in the cloud; its points are removed, the plane stays as an obstacle."""

    kind: Literal["ransac"]
    distance: NotRequired[float]  # metres from the plane within which points belong to it
    max_tilt: NotRequired[float]  # radians between its normal and up
    min_share: NotRequired[float]  # share of the cloud's points it must hold


class Box(TypedDict):
    """An axis-aligned box in the cloud's frame."""

    kind: Literal["box"]
    min: Vector  # lower corner, metres
    max: Vector  # upper corner, metres


class OrientedBox(TypedDict):
    """A box in any orientation."""

    kind: Literal["oriented_box"]
    center: Vector  # its middle, metres
    half_extents: Vector  # half its lengths along its own axes, metres
    quaternion: NotRequired[Vector]  # x, y, z, w: T_cloud_box


class Sphere(TypedDict):
    """A ball."""

    kind: Literal["sphere"]
    center: Vector  # its middle, metres
    radius: float  # metres


class HalfSpace(TypedDict):
    """The points p with normal . p >= offset."""

    kind: Literal["half_space"]
    normal: Vector  # unit, into the region
    offset: float  # metres


class Indices(TypedDict):
    """Points by their row in the cloud as sent."""

    kind: Literal["indices"]
    indices: Sequence[int] | NDArray[Any]


class Mask(TypedDict):
    """Points by one truth value for each row of the cloud as sent."""

    kind: Literal["mask"]
    mask: Sequence[bool] | NDArray[Any]


class Segments(TypedDict):
    """Points by the segment they belong to: `segment_ids` beside the cloud."""

    kind: Literal["segments"]
    ids: Sequence[int] | NDArray[Any]


Shape = Box | OrientedBox | Sphere | HalfSpace | Indices | Mask | Segments


class Region(TypedDict, total=False):
    """What lies in any of `include` and in none of `exclude`."""

    include: Sequence[Shape]  # none: everywhere
    exclude: Sequence[Shape]


class Cone(TypedDict):
    """Directions within an angle of one."""

    direction: Vector  # the way the hand moves toward the object, +z of the hand
    max_angle: float  # radians


class ApproachDirection(TypedDict, total=False):
    """Directions in which the hand may move: those in any cone or in the preset."""

    cones: Sequence[Cone]
    preset: Literal["top-down", "side"] | None  # relative to up


class Collision(TypedDict, total=False):
    """What the hand must not meet, and on which way."""

    mode: Literal["avoid", "penalise", "ignore"]  # left out, worth half, or not looked for
    margin: float  # metres kept free around the hand
    opening: float | None  # metres between the fingers on the way in; None: the maximum
    approach_length: float  # metres of straight way in
    retreat_length: float  # metres of straight way out
    retreat_direction: Literal["back", "up"]
    obstacles: Sequence[Box | OrientedBox]  # beside the cloud


class HandPart(TypedDict):
    """Boxes of the hand or of one finger, hand frame."""

    boxes: Sequence[Sequence[Vector]]  # [min corner, max corner] each, metres


class Linkage(TypedDict):
    """A linkage that carries each finger along an arc."""

    radius: float  # length of the link that carries a finger, metres
    reach: float  # outward part (y) of that link in the open gripper, metres


class GripperGeometry(TypedDict):
    """A parallel-jaw gripper; the fields of a gripper file. z toward the object, y closing."""

    name: NotRequired[str]
    max_opening: float  # metres between the open fingers' inner faces
    tip_z: float  # fingertips, metres along z
    contact_z: float  # where contacts are put, metres along z
    tcp_z: float  # origin of the TCP frame, metres along z
    hand: HandPart
    finger: HandPart  # one finger, its inner face at y = 0
    swing: NotRequired[Linkage | None]  # None: the fingers close in a straight line


class Suppression(TypedDict, total=False):
    """Drops a grasp near a better one: nearer than both distances."""

    translation: float  # metres between TCPs
    rotation: float  # radians between hands


class DetectOptions(TypedDict, total=False):
    """What `detect` and `score` take besides the cloud."""

    model: str  # weights to use; empty: the server's default
    gripper: str | GripperGeometry | None  # None: the one the weights were trained for
    num_approach_points: int  # approach points sampled
    num_candidates: int  # candidates scored at most
    sampling: Literal["farthest", "uniform"]  # of approach points
    seed: int  # same cloud, options and seed, same grasps
    viewpoint: Vector | Sequence[Vector] | None  # camera positions, metres; orient the normals
    up: Vector  # direction away from gravity
    support: SupportPlane | RansacPlane | None  # plane the objects rest on; the hand stays above
    workspace: Workspace | None  # points outside are dropped
    approach_region: Region | None  # where approach points may lie
    contact_region: Region | None  # where contact points may lie
    approach_direction: ApproachDirection | None  # ways the hand may move; None: not from below
    collision: Literal["avoid", "penalise", "ignore"] | Collision  # what the hand must not meet
    min_score: float  # lowest score returned
    top_k: int  # grasps returned at most
    suppression: Suppression | None  # non-maximum suppression; None: none
    order: Literal["score", "highest", "clearance"]  # what comes first
    debug: bool  # whether to return the processed cloud and every candidate


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options with numpy values turned into plain ones, and those left out that are None.

    `suppression` alone has a None of its own: no suppression.

    Raises:
        InvalidRequestError: An option has no such name.
    """
    for name in options:
        if name not in DetectOptions.__annotations__:
            known = ", ".join(DetectOptions.__annotations__)
            raise invalid(
                f"options.{name}", "an unknown field", f"Remove it; the options are: {known}."
            )
    return {
        name: _plain(value)
        for name, value in options.items()
        if value is not None or name == "suppression"
    }


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value
