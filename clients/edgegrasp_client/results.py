"""The server's answers as typed values, and their parsers for both transports."""

from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from functools import lru_cache, partial
from types import NoneType
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgegrasp_camera.arrays import Float32, Float64
from edgegrasp_client.errors import GraspClientError

Int32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class ArmTrajectory:
    """A timed motion of an arm: to the pregrasp, straight to the grasp, straight out. T rows.

    With a place, it goes on to above it, straight down, and back. The gripper opens before
    `pregrasp_row`, closes at `grasp_row` and opens at `release_row`; the arm rests at each.
    """

    joint_names: list[str]  # J
    times: Float64  # (T,) seconds from the start
    positions: Float64  # (T, J) radians, metres of sliding joints
    velocities: Float64  # (T, J) per second
    pregrasp_row: int
    grasp_row: int
    release_row: int | None = None  # with a place


@dataclass(frozen=True, eq=False)
class ArmPlan:
    """How an arm gets to a grasp."""

    reachable: bool  # whether it gets there and straight on, and to the place, touching nothing
    pregrasp_joints: Float64 | None  # (J,) where it is reachable
    grasp_joints: Float64 | None  # (J,) where it is reachable
    trajectory: ArmTrajectory | None  # if it was asked for and found in time
    place_joints: Float64 | None = None  # (J,) where it lets go; None without a place
    T_base_place: Annotated[Float64, (4, 4)] | None = None  # (4, 4) the hand there, base frame


@dataclass(frozen=True, eq=False)
class Grasp:
    """One grasp: move to `T_cloud_hand` along `approach_direction`, then close."""

    score: float  # probability that the grasp holds
    T_cloud_hand: Annotated[
        Float32, (4, 4)
    ]  # hand link frame: z out of the palm, y the closing direction
    T_cloud_tcp: Annotated[Float32, (4, 4)]  # tool centre point, same axes
    width: float  # metres to open to before the approach; the maximum if the far side is hidden
    approach_point: Float32  # (3,) p_a, metres, cloud frame
    contact_point: Float32  # (3,) p_c, metres, cloud frame
    approach_direction: Float32  # (3,) unit, the direction the hand moves; +z of the hand
    collision_free: bool  # whether the open hand touches nothing at the grasp and on its way
    clearance: float  # metres from the open hand at the grasp to the nearest surface; <= 0: inside
    object: int | None = None  # number of the object that the contact is on; None: no object
    arm: ArmPlan | None = None  # None: no robot was given, or time ran out
    id: int | None = None  # the same in all answers that follow it; None without `previous`
    far_side_hidden: bool = False  # whether no camera saw where the object ends beside a finger

    def pregrasp(self, distance: float = 0.05) -> Float32:
        """The hand's pose (4, 4) `distance` metres back, where the straight approach begins."""
        return self.retreat(distance)

    def retreat(self, distance: float = 0.1, direction: ArrayLike | None = None) -> Float32:
        """The hand's pose (4, 4) after a straight retreat.

        Args:
            distance: Metres.
            direction: (3,) cloud frame, of any length but zero, such as the detection's `up`;
                None: back along the approach.
        """
        way = -self.approach_direction if direction is None else np.asarray(direction, np.float32)
        pose: Float32 = self.T_cloud_hand.copy()
        pose[:3, 3] += distance * way / np.linalg.norm(way)
        return pose


@dataclass(frozen=True, eq=False)
class FoundSupport:
    """The plane that objects rest on: the points x with normal . x = offset; cloud frame."""

    normal: Float32  # (3,) unit, pointing up from the support
    offset: float  # metres
    residual: float | None  # metres, median distance of its points; None: none of it is seen
    share: float  # of the seen surface that lies in it


@dataclass(frozen=True)
class GripperOutline:
    """The gripper of the grasps, as needed for drawing it; metres along the hand's z."""

    name: str
    palm_z: float  # the palm's surface between the fingers
    tip_z: float  # the fingertips of the open gripper


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """A recognised object; cloud frame, metres."""

    number: int  # as in `Grasp.object`; the segment, where segment_ids were sent
    points: int  # its number of voxels in the processed cloud
    center: Float32  # (3,) of the smallest upright box around them
    half_extents: Float32  # (3,) of that box, along its own axes, the last of which is up
    quaternion: Float32  # (4,) x, y, z, w: rotates the box's axes into the cloud's
    best_score: float | None  # of the grasps returned; None: it has none
    confidence: float | None  # probability that it is an object; None: given by the caller
    # Why it has no good grasp: "too-wide", "too-flat", "blocked" or "hidden"; None: it has one, or
    # nobody can say.
    reason: str | None
    # (3 K,) points by which it is found again; with `previous`
    surface: Annotated[Float32, (-1,)] | None = None


@dataclass(frozen=True)
class Tracking:
    """How an answer follows the one before, which was sent as `previous`."""

    first: str  # what became of the first grasp: "started", "kept", "replaced" or "lost"
    next_id: int  # above all ids and numbers used so far


@dataclass(frozen=True, eq=False)
class DebugInfo:
    """The processed cloud and every candidate with its outcome. V points, E candidates."""

    points: Annotated[Float32, (-1, 3)]  # (V, 3) metres, cloud frame
    normals: Annotated[Float32, (-1, 3)]  # (V, 3) unit
    approach_index: Int32  # (E,) p_a, rows of `points`
    contact_index: Int32  # (E,) p_c, rows of `points`
    T_cloud_hand: Annotated[Float32, (-1, 4, 4)]  # (E, 4, 4)
    score: Float32  # (E,) NaN where it was not scored
    outcome: list[str]  # E of them: "returned", or what became of it
    support_plane: Float32 | None  # (4,) unit normal and offset, given or found, metres
    # (R,) of each row of the cloud as sent, images row by row: the number of its object; -1: an
    # obstacle; -2: the support; -3: no reading, cut off or below the support.
    labels: Int32


@dataclass(frozen=True, eq=False)
class Detection:
    """Ranked grasps of one cloud, with counts and timings."""

    grasps: list[Grasp]
    counts: dict[str, int]  # points, candidates and grasps that passed each stage
    seconds: dict[str, float]  # spent in each stage, and their `total`
    model: str  # name of the weights used
    gripper: GripperOutline
    warnings: list[str]
    debug: DebugInfo | None  # where `debug` is asked for
    support: FoundSupport | None  # given or found
    up: Float32  # (3,) unit, away from gravity, as it was used
    objects: list[DetectedObject]  # the largest first
    tracking: Tracking | None = None  # where `previous` was sent

    @property
    def best_pick(self) -> Grasp | None:
        """The first grasp within the robot's reach; the server puts those with a motion first."""
        return next((one for one in self.grasps if one.arm and one.arm.reachable), None)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What the network says of one edge or hand pose."""

    grasp: Grasp | None  # None if it defines no edge grasp
    reason: str | None  # why it defines none, e.g. "too-long"


@dataclass(frozen=True, eq=False)
class Scoring:
    """Evaluations, in the order of the edges or hand poses."""

    evaluations: list[Evaluation]
    counts: dict[str, int]
    seconds: dict[str, float]
    model: str
    warnings: list[str]


@dataclass(frozen=True)
class Model:
    """Weights a server has loaded."""

    name: str
    architecture: str
    digest: str
    parameters: int
    crop_radius: float  # metres
    voxel_size: float  # metres
    gripper: str
    default: bool  # whether a request that names no model gets these
    hand_description: bool  # whether the network also sees the hand-frame description
    device: str = ""  # its device: "cpu", or a GPU such as "cuda:0"


@dataclass(frozen=True, eq=False)
class Models:
    """All weights that a server has loaded."""

    models: list[Model]


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm with a gripper on it. J joints; radians and seconds, metres of sliding joints."""

    name: str
    gripper: str  # which grasps are for
    base_frame: str  # link that `T_base_cloud` refers to
    joint_names: list[str]  # J
    home: Float64  # (J,) where it touches nothing of itself
    lower: Float64  # (J,) limits
    upper: Float64
    max_velocity: Float64
    max_acceleration: Float64
    # (J + 1, 4, 4) the frame of each joint at 0 in that of the joint before, the first in the base
    # frame; the last is the hand's in the last joint's
    frames: Annotated[Float64, (-1, 4, 4)]
    axes: Annotated[Float64, (-1, 3)]  # (J, 3) that it turns about or slides along, own frame
    sliding: list[bool]  # J


@dataclass(frozen=True, eq=False)
class Robots:
    """All robots that a server plans for."""

    robots: list[Robot]


@dataclass(frozen=True, eq=False)
class StreamAnswer:
    """The answer to one request of a stream: a detection or an error."""

    request_id: str
    detection: Detection | None = None
    error: GraspClientError | None = None

    def result(self) -> Detection:
        """The detection; raises the error where there is none."""
        if self.detection is None:
            assert self.error is not None
            raise self.error
        return self.detection


# The server's stages in order, since gRPC maps have no order.
_STAGES = (
    *("cloud", "points", "in_workspace", "above_support", "voxels", "kept", "in_approach_region"),
    *("approach_points", "pairs", "in_contact_region", "candidates", "in_direction"),
    *("clear_of_support", "checked", "collision_free", "given", "scored", "above_min_score"),
    *("suppressed", "on_arm", "hand_collision", "out_of_reach", "arm_collision", "no_place"),
    *(
        "reachable",
        "with_trajectory",
        "returned",
        "description",
        "network",
        "ranking",
        "arm",
        "total",
    ),
)


Record = TypeVar("Record")
Read = Callable[[Any, str], Any]
"""read(answer, name): the field of that name of an object in an answer; None if it is absent."""

_hints = lru_cache(partial(get_type_hints, include_extras=True))


def read_as(kind: type[Record], answer: Any, read: Read) -> Record:
    """An answer, or an object in one, as one of the dataclasses above."""
    if not is_dataclass(kind):  # an answer that says nothing
        return kind()
    values = {name: _value(hint, read(answer, name), read) for name, hint in _hints(kind).items()}
    if kind is ArmTrajectory:  # gRPC has rows one behind the other
        for name in ("positions", "velocities"):
            values[name] = values[name].reshape(-1, len(values["joint_names"]))
    return cast("Callable[..., Record]", kind)(**values)


def _value(hint: Any, value: Any, read: Read) -> Any:
    """A value as a field of such a type has it; arrays in the shape of the annotation."""
    parts = [part for part in get_args(hint) if part is not NoneType]
    if NoneType in get_args(hint):
        scalar = parts[0] in (bool, float, int, str) or is_dataclass(parts[0])
        absent = value is None or not (scalar or len(value))  # gRPC: none are sent
        return None if absent else _value(parts[0], value, read)
    if is_dataclass(hint):
        return read_as(cast("type[Any]", hint), value, read)
    if get_origin(hint) is list:
        inner = is_dataclass(parts[0])
        return [read_as(parts[0], one, read) if inner else one for one in value]
    if get_origin(hint) is dict:  # in the order of the stages; those of a newer server come last
        return {name: value[name] for name in (*_STAGES, *sorted(value)) if name in value}
    if get_origin(hint) is Annotated:
        return _value(parts[0], value, read).reshape(hint.__metadata__[0])
    if get_origin(hint) is np.ndarray:
        (dtype,) = get_args(get_args(hint)[1])
        return np.array(value, dtype=dtype)  # null in JSON becomes NaN
    return value
