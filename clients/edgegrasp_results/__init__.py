"""The answer to one request, made by the model and read by the client.

The shape in an array's annotation is the shape that the client returns.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from edgegrasp_camera.arrays import Float32, Float64, Int64


@dataclass(frozen=True, eq=False)
class ArmTrajectory:
    """A timed motion of an arm: to the pregrasp, straight to the grasp, straight out. T rows.

    With a place, the arm continues to above the place, straight down, and back. The gripper opens
    before `pregrasp_row`, closes at `grasp_row` and opens at `release_row`; the arm rests at each.
    """

    joint_names: list[str]  # J
    times: Float64  # (T,) seconds from the start
    positions: Float64  # (T, J) radians, metres for sliding joints
    velocities: Float64  # (T, J) per second
    pregrasp_row: int
    grasp_row: int
    release_row: int | None = None  # with a place


@dataclass(frozen=True, eq=False)
class ArmPlan:
    """Joints and motion of an arm to a grasp."""

    reachable: bool  # pregrasp, grasp and place without a collision
    pregrasp_joints: Float64 | None = None  # (J,) if reachable
    grasp_joints: Float64 | None = None  # (J,) if reachable
    trajectory: ArmTrajectory | None = None  # if requested and found in time
    place_joints: Float64 | None = None  # (J,) at the release; None without a place
    T_base_place: Annotated[Float64, (4, 4)] | None = None  # (4, 4) hand at release, base frame


@dataclass(frozen=True, eq=False)
class Grasp:
    """One grasp: move to `T_cloud_hand` along `approach_direction`, then close."""

    score: float  # probability that the grasp holds
    # Hand link frame: z out of the palm, y the closing direction.
    T_cloud_hand: Annotated[Float32, (4, 4)]
    T_cloud_tcp: Annotated[Float32, (4, 4)]  # tool centre point (TCP), same axes
    width: float  # metres to open to before the approach; the maximum if the far side is hidden
    approach_point: Float32  # (3,) p_a, metres, cloud frame
    contact_point: Float32  # (3,) p_c, metres, cloud frame
    approach_direction: Float32  # (3,) unit, the direction the hand moves; +z of the hand
    collision_free: bool  # whether the open hand touches nothing, also on its approach and retreat
    clearance: float  # metres from the open hand at the grasp to the nearest surface; < 0: inside
    object: int | None = None  # number of the object that the contact is on; None: no object
    arm: ArmPlan | None = None  # None: no robot was given, or time ran out
    id: int | None = None  # the same in all answers that follow the grasp; None without `previous`
    far_side_hidden: bool = False  # whether no camera saw the object's far side, next to a finger

    def pregrasp(self, distance: float = 0.05) -> Float32:
        """The hand's pose (4, 4) `distance` metres back, where the straight approach begins."""
        return self.retreat(distance)

    def retreat(self, distance: float = 0.1, direction: ArrayLike | None = None) -> Float32:
        """The hand's pose (4, 4) after a straight retreat of `distance` metres.

        `direction` is (3,), cloud frame, of any length but zero, such as the detection's `up`;
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
    residual: float | None  # metres, median distance of its points; None: the plane is not visible
    share: float  # share of the points that lie in it


@dataclass(frozen=True)
class GripperOutline:
    """The gripper of the grasps, for drawing; metres along the hand's z."""

    name: str
    palm_z: float  # the palm's surface between the fingers
    tip_z: float  # the fingertips of the open gripper


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """A recognised object; cloud frame, metres."""

    number: int  # as in `Grasp.object`; the segment, if segment_ids were sent
    points: int  # its number of voxels in the processed cloud
    center: Float32  # (3,) of the smallest upright box around its points
    half_extents: Float32  # (3,) of this box, along its own axes, the last of which is up
    quaternion: Float32  # (4,) x, y, z, w: rotates the box's axes into the cloud's
    best_score: float | None  # of its returned grasps; None: it has no grasp
    confidence: float | None  # probability that it is real; None: given by the caller
    # Why it has no good grasp: "too-wide", "too-flat", "blocked" or "hidden"; None: it has one, or
    # there is another reason.
    reason: str | None
    # (K, 3) points to find it again with `previous`; flat in the client, as sent back.
    surface: Annotated[Float32, (-1,)] | None = None


@dataclass(frozen=True)
class Tracking:
    """How the answer continues the one in `previous`."""

    first: str  # state of the first grasp: "started", "kept", "replaced" or "lost"
    next_id: int  # above all ids and numbers used so far


@dataclass(frozen=True, eq=False)
class DebugInfo:
    """The processed cloud and every candidate with its outcome. V points, E candidates."""

    points: Annotated[Float32, (-1, 3)]  # (V, 3) metres, cloud frame
    normals: Annotated[Float32, (-1, 3)]  # (V, 3) unit
    approach_index: Int64  # (E,) p_a, rows of `points`
    contact_index: Int64  # (E,) p_c, rows of `points`
    T_cloud_hand: Annotated[Float32, (-1, 4, 4)]  # (E, 4, 4)
    score: Float32  # (E,) NaN: not scored
    outcome: list[str]  # E outcomes: "returned", or why it was not
    support_plane: Float32 | None  # (4,) unit normal and offset, given or found, metres
    # (R,) for each row of the cloud as sent, images row by row: the number of its object; -1: an
    # obstacle; -2: the support; -3: no reading, cropped or below the support.
    labels: Int64


@dataclass(frozen=True, eq=False)
class Detection:
    """Ranked grasps of one cloud, with counts and timings."""

    grasps: list[Grasp]
    counts: dict[str, int]  # points, candidates and grasps that passed each stage, in order
    seconds: dict[str, float]  # spent in each stage, and their `total`
    model: str  # name of the weights used
    gripper: GripperOutline
    warnings: list[str] = field(default_factory=list)
    debug: DebugInfo | None = None  # if `debug` is set
    support: FoundSupport | None = None  # given or found
    # (3,) unit, away from gravity, as the detector used it
    up: Float32 = field(default_factory=lambda: np.array([0, 0, 1], np.float32))
    objects: list[DetectedObject] = field(default_factory=list)  # the largest first
    tracking: Tracking | None = None  # if `previous` was sent

    @property
    def best_pick(self) -> Grasp | None:
        """The first grasp within the robot's reach; the server puts those with a motion first."""
        return next((one for one in self.grasps if one.arm and one.arm.reachable), None)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The network's score of one edge or hand pose."""

    grasp: Grasp | None  # None if it defines no edge grasp
    reason: str | None  # why it defines none, e.g. "too-long"


@dataclass(frozen=True, eq=False)
class Scoring:
    """Evaluations, in the order of the edges or hand poses."""

    evaluations: list[Evaluation]
    counts: dict[str, int]
    seconds: dict[str, float]
    model: str
    warnings: list[str] = field(default_factory=list)


def plain(value: Any) -> Any:
    """The JSON form of a part of an answer that has no JSON type; its floats are float32."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    fields = vars(value)
    floats = {name: one for name, one in fields.items() if isinstance(one, float)}
    return fields | {name: float(np.float32(one)) for name, one in floats.items()}
