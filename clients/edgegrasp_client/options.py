"""Options of a request; those left out or None take the server's defaults.

docs/options.md says what each means.
"""

from collections.abc import Sequence
from typing import Any, Literal

from numpy.typing import NDArray
from typing_extensions import NotRequired, TypedDict

Vector = Sequence[float] | NDArray[Any]  # x, y, z in the cloud's frame


class HandPart(TypedDict):
    """Boxes of the hand or of one finger, hand frame."""

    boxes: Sequence[Sequence[Vector]]


class Linkage(TypedDict):
    """A linkage that carries each finger along an arc: its tips come forward as it closes."""

    radius: float
    reach: float


class GripperGeometry(TypedDict):
    """A parallel-jaw gripper; the fields of a gripper file. z toward the object, y closing."""

    name: NotRequired[str]
    max_opening: float
    tip_z: float
    contact_z: float
    tcp_z: float
    hand: HandPart
    finger: HandPart
    swing: NotRequired[Linkage | None]


class SupportPlane(TypedDict):
    """The plane objects rest on: the points x with normal . x = offset; the normal points up."""

    kind: NotRequired[Literal["plane"]]
    normal: Vector
    offset: float
    max_depth_error: NotRequired[float]


class RansacPlane(TypedDict):
    """Look for the plane in the cloud: the largest of those near the level."""

    kind: Literal["ransac"]
    distance: NotRequired[float]
    max_tilt: NotRequired[float]
    min_share: NotRequired[float]


class AutoPlane(TypedDict):
    """Find the support plane: that of the points recognised as a support near objects."""

    kind: Literal["auto"]


class ObjectChoice(TypedDict, total=False):
    """Some of the objects that are found, by their numbers in an answer to the same cloud."""

    include: Sequence[int] | NDArray[Any]
    exclude: Sequence[int] | NDArray[Any]


class Workspace(TypedDict):
    """An axis-aligned box in the cloud's frame, where grasps may be."""

    min: Vector
    max: Vector


class Box(TypedDict):
    """An axis-aligned box in the cloud's frame."""

    kind: Literal["box"]
    min: Vector
    max: Vector


class HalfSpace(TypedDict):
    """Everything on one side of a plane: the points x with normal . x >= offset."""

    kind: Literal["half_space"]
    normal: Vector
    offset: float


class Indices(TypedDict):
    """Points by their row in the cloud as it was sent."""

    kind: Literal["indices"]
    indices: Sequence[int] | NDArray[Any]


class Mask(TypedDict):
    """Points by one truth value for each row of the cloud as it was sent."""

    kind: Literal["mask"]
    mask: Sequence[bool] | NDArray[Any]


class OrientedBox(TypedDict):
    """A box in any orientation."""

    kind: Literal["oriented_box"]
    center: Vector
    half_extents: Vector
    quaternion: NotRequired[Vector]


class Segments(TypedDict):
    """Points by the segment they belong to: `segment_ids`, sent beside the cloud."""

    kind: Literal["segments"]
    ids: Sequence[int] | NDArray[Any]


class Sphere(TypedDict):
    """A ball."""

    kind: Literal["sphere"]
    center: Vector
    radius: float


Shape = Box | OrientedBox | Sphere | HalfSpace | Indices | Mask | Segments


class Region(TypedDict, total=False):
    """What lies in any of `include` and in none of `exclude`."""

    include: Sequence[Shape]
    exclude: Sequence[Shape]


class Cone(TypedDict):
    """Directions within an angle of one."""

    direction: Vector
    max_angle: float


class ApproachDirection(TypedDict, total=False):
    """Directions in which the hand may move: those in any cone or in the preset."""

    cones: Sequence[Cone]
    preset: Literal["top-down", "side"] | None


Obstacle = Box | OrientedBox


class Collision(TypedDict, total=False):
    """What the hand must not meet, and on which way: cloud, support plane and obstacles."""

    mode: Literal["avoid", "penalise", "ignore"]
    margin: float
    opening: float | None
    approach_length: float
    retreat_length: float
    retreat_direction: Literal["back", "up"]
    obstacles: Sequence[Obstacle]


class PlaceRegion(TypedDict):
    """An axis-aligned box in the arm's base frame, on whose bottom an object is put."""

    min: Vector
    max: Vector


class Place(TypedDict, total=False):
    """Where the arm puts the object down: in one pose, or anywhere in a region."""

    T_base_object: Sequence[float] | None
    region: PlaceRegion | None


class RobotArm(TypedDict):
    """The arm that is to execute a grasp: each grasp is answered with how the arm gets there."""

    name: str
    T_base_cloud: Sequence[float]
    joints: Sequence[float]
    plan: NotRequired[Literal["reach", "motion"]]
    place: NotRequired[Place | None]
    avoid_unseen: NotRequired[bool]


class Suppression(TypedDict, total=False):
    """Drop a grasp near a better one: nearer than both distances."""

    translation: float
    rotation: float


class PreviousGrasp(TypedDict):
    """A grasp of an earlier answer."""

    id: int
    T_cloud_hand: Sequence[float]
    object: NotRequired[int | None]


class PreviousObject(TypedDict):
    """An object of an earlier answer."""

    number: int
    surface: Sequence[float]
    confidence: NotRequired[float | None]


class Previous(TypedDict, total=False):
    """What an earlier answer found, which the next one keeps where it is still there."""

    gripper: str
    next_id: int
    grasps: Sequence[PreviousGrasp]
    objects: Sequence[PreviousObject]
    search: bool


class DetectOptions(TypedDict, total=False):
    """Options of one detection; the defaults suit a tabletop scene seen by one camera."""

    model: str
    gripper: str | GripperGeometry | None
    num_approach_points: int | None
    num_candidates: int
    sampling: Literal["farthest", "uniform"]
    seed: int
    viewpoint: Vector | Sequence[Vector] | None
    up: Vector | None
    support: Literal["auto", "ransac", "none"] | SupportPlane | RansacPlane | AutoPlane | None
    objects: Literal["auto", "off"] | ObjectChoice
    at: Vector | None
    near: Vector | None
    max_object_size: float
    workspace: Workspace | None
    approach_region: Region | None
    contact_region: Region | None
    approach_direction: ApproachDirection | None
    collision: Literal["avoid", "penalise", "ignore"] | Collision
    robot: RobotArm | None
    min_score: float
    top_k: int
    suppression: Suppression | None
    order: Literal["score", "highest", "clearance"]
    previous: Previous | None
    debug: bool
