"""Options of a request; what is left out, or None, takes the server's default.

Generated from the server's own definition by `make proto`; do not edit.
"""

from collections.abc import Sequence
from typing import Any, Literal

from numpy.typing import NDArray
from typing_extensions import NotRequired, TypedDict

Vector = Sequence[float] | NDArray[Any]  # x, y, z in the cloud's frame


class HandPart(TypedDict):
    """Boxes of the hand or of one finger, hand frame."""

    # [min corner, max corner] each
    boxes: Sequence[Sequence[Vector]]


class Linkage(TypedDict):
    """A linkage that carries each finger along an arc: its tips come forward as it closes."""

    # length of the link that carries a finger, metres
    radius: float
    # outward part (y) of that link in the open gripper, metres
    reach: float


class GripperGeometry(TypedDict):
    """A parallel-jaw gripper; the fields of a gripper file. z toward the object, y closing."""

    # shown in results
    name: NotRequired[str]
    # metres between the open fingers' inner faces
    max_opening: float
    # fingertips of the open gripper, metres along z
    tip_z: float
    # where contacts are put, metres along z; between palm and fingertips
    contact_z: float
    # origin of the TCP frame, metres along z
    tcp_z: float
    # the hand without its fingers
    hand: HandPart
    # one finger, its inner face at y = 0; mirrored
    finger: HandPart
    # how the fingers swing; None: they close in a straight line
    swing: NotRequired[Linkage | None]


class SupportPlane(TypedDict):
    """The plane objects rest on: the points x with normal . x = offset; the normal points up."""

    kind: NotRequired[Literal["plane"]]
    # unit normal, away from the table
    normal: Vector
    # normal . x of its points, metres
    offset: float
    # share by which a camera's depths may be wrong: each view is scaled about its viewpoint by up
    # to this until the plane that it sees lies in place; 0: not at all
    max_depth_error: NotRequired[float]


class RansacPlane(TypedDict):
    """Look for the plane in the cloud: the largest of those near the level."""

    kind: Literal["ransac"]
    # metres from the plane within which points belong to it at least
    distance: NotRequired[float]
    # radians between its normal and up; a quarter turn: any plane
    max_tilt: NotRequired[float]
    # share of the seen surface it must hold
    min_share: NotRequired[float]


class AutoPlane(TypedDict):
    """Find the support plane: that of the points recognised as a support near objects."""

    kind: Literal["auto"]


class ObjectChoice(TypedDict, total=False):
    """Some of the objects that are found, by their numbers in an answer to the same cloud."""

    # numbers of objects; empty: all
    include: Sequence[int] | NDArray[Any]
    # numbers of objects that are left out
    exclude: Sequence[int] | NDArray[Any]


class Workspace(TypedDict):
    """An axis-aligned box in the cloud's frame, where grasps may be."""

    # lower corner, metres
    min: Vector
    # upper corner, metres
    max: Vector


class Box(TypedDict):
    """An axis-aligned box in the cloud's frame."""

    kind: Literal["box"]
    # lower corner, metres
    min: Vector
    # upper corner, metres
    max: Vector


class HalfSpace(TypedDict):
    """Everything on one side of a plane: the points x with normal . x >= offset."""

    kind: Literal["half_space"]
    # unit, into the region
    normal: Vector
    # normal . x on the plane, metres
    offset: float


class Indices(TypedDict):
    """Points by their row in the cloud as it was sent."""

    kind: Literal["indices"]
    # rows of the cloud as sent; row-major where organised
    indices: Sequence[int] | NDArray[Any]


class Mask(TypedDict):
    """Points by one truth value for each row of the cloud as it was sent."""

    kind: Literal["mask"]
    # as many values as the cloud has rows; in JSON also base64 of a byte for each
    mask: Sequence[bool] | NDArray[Any]


class OrientedBox(TypedDict):
    """A box in any orientation."""

    kind: Literal["oriented_box"]
    # its middle, metres
    center: Vector
    # half its lengths along its own axes, metres
    half_extents: Vector
    # x, y, z, w: turns the box's axes into the cloud's (T_cloud_box)
    quaternion: NotRequired[Vector]


class Segments(TypedDict):
    """Points by the segment they belong to: `segment_ids`, sent beside the cloud."""

    kind: Literal["segments"]
    # values of segment_ids
    ids: Sequence[int] | NDArray[Any]


class Sphere(TypedDict):
    """A ball."""

    kind: Literal["sphere"]
    # its middle, metres
    center: Vector
    # metres
    radius: float


Shape = Box | OrientedBox | Sphere | HalfSpace | Indices | Mask | Segments


class Region(TypedDict, total=False):
    """What lies in any of `include` and in none of `exclude`."""

    # union of shapes; empty: everywhere
    include: Sequence[Shape]
    # union of shapes taken away
    exclude: Sequence[Shape]


class Cone(TypedDict):
    """Directions within an angle of one."""

    # the way the hand moves toward the object, +z of the hand; any length but zero
    direction: Vector
    # radians between it and the hand's way
    max_angle: float


class ApproachDirection(TypedDict, total=False):
    """Directions in which the hand may move: those in any cone or in the preset."""

    # any of these
    cones: Sequence[Cone]
    # or this, relative to up
    preset: Literal["top-down", "side"] | None


Obstacle = Box | OrientedBox


class Collision(TypedDict, total=False):
    """What the hand must not meet, and on which way: cloud, support plane and obstacles."""

    # grasps whose hand collides: left out, their scores worth half in the ranking, or not looked
    # for
    mode: Literal["avoid", "penalise", "ignore"]
    # metres kept free around the hand: its boxes are grown by this on every side
    margin: float
    # metres between the fingers on the way in; None: the gripper's maximum
    opening: float | None
    # metres of straight way in along the approach
    approach_length: float
    # metres of straight way out
    retreat_length: float
    # way out: back along the approach, or along up
    retreat_direction: Literal["back", "up"]
    # solid boxes beside the cloud
    obstacles: Sequence[Obstacle]


class RobotArm(TypedDict):
    """The arm that is to execute a grasp: each grasp is answered with how the arm gets there."""

    # one of the server's robots
    name: str
    # where the cloud's frame is in the arm's base frame: a 4 x 4 matrix, row by row
    T_base_cloud: Sequence[float]
    # the arm's joints now, radians or metres, in the order of the robot file
    joints: Sequence[float]
    # reach: joints before and at each grasp; motion: a timed trajectory too
    plan: NotRequired[Literal["reach", "motion"]]


class Suppression(TypedDict, total=False):
    """Drop a grasp near a better one: nearer than both distances."""

    # metres between TCPs
    translation: float
    # radians between hands, the 180 degree flip about the approach ignored
    rotation: float


class DetectOptions(TypedDict, total=False):
    """Options of one detection; the defaults suit a tabletop scene seen by one camera."""

    # weights to use; empty: the server's default
    model: str
    # name of a gripper, or a gripper; None: the one the weights were trained for
    gripper: str | GripperGeometry | None
    # approach points sampled, spread over the objects; None: as many as they need
    num_approach_points: int | None
    # candidates scored at most
    num_candidates: int
    # how approach points are sampled
    sampling: Literal["farthest", "uniform"]
    # seed of every random choice
    seed: int
    # camera position, metres; orients the normals. Several positions: `view_ids` beside the cloud
    # says which one saw each point
    viewpoint: Vector | Sequence[Vector] | None
    # direction away from gravity; any length but zero; None: the support plane's normal, else +z
    up: Vector | None
    # plane the objects rest on; no part of the hand goes below it; a bare kind will do; None: none
    support: Literal["auto", "ransac", "none"] | SupportPlane | RansacPlane | AutoPlane | None
    # what grasps are for: the objects that are recognised, some of them by number, or everything;
    # all the rest is an obstacle. Where segment_ids are sent, they are the objects, 0 and less none
    objects: Literal["auto", "off"] | ObjectChoice
    # pixel of the image; grasps are for the object that is seen there
    at: Vector | None
    # position, metres; grasps are for the object next to it, 0.1 m away at most
    near: Vector | None
    # longest side of an object, metres; longer ones are obstacles
    max_object_size: float
    # where grasps may be; points outside stay as obstacles; None: everywhere
    workspace: Workspace | None
    # where approach points may lie; None: everywhere
    approach_region: Region | None
    # where contact points may lie; None: everywhere
    contact_region: Region | None
    # ways the hand may move; None: not from below
    approach_direction: ApproachDirection | None
    # what the hand must not meet; a bare mode will do
    collision: Literal["avoid", "penalise", "ignore"] | Collision
    # the arm that is to execute a grasp; grasps within its reach come first; None: a hand alone
    robot: RobotArm | None
    # lowest score returned; 0: all, however bad
    min_score: float
    # grasps returned at most
    top_k: int
    # non-maximum suppression; None: none
    suppression: Suppression | None
    # what comes first: the score (before others, the best grasp of each object that has one of 0.5
    # and more); the highest TCP along up among scores of 0.9 and more, then the others by score; or
    # the clearance
    order: Literal["score", "highest", "clearance"]
    # whether to return the processed cloud and every candidate
    debug: bool
