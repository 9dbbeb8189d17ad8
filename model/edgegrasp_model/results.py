"""The answer to one request."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from edgegrasp_camera.arrays import Float32, Float64, Int64

OBSTACLE, SUPPORT, UNLABELLED = -1, -2, -3  # labels of rows of the cloud that belong to no object


class Outcome(StrEnum):
    """The outcome of a candidate."""

    RETURNED = "returned"
    DIRECTION = "direction"  # the hand would move in a way that is not allowed
    SUPPORT = "support"  # it would go below the support plane
    NOT_CHECKED = "not-checked"  # dropped at random before the collision check
    COLLISION = "collision"  # the hand would meet the cloud, the support or an obstacle
    NOT_SCORED = "not-scored"  # beyond num_candidates: near another one, or dropped at random
    LOW_SCORE = "low-score"  # below min_score
    SUPPRESSED = "suppressed"  # near a better one
    BEYOND_TOP_K = "beyond-top-k"


class NoGrasp(StrEnum):
    """Why a given edge or hand pose defines no edge grasp."""

    NO_POINT = "no-point"  # a point of it was removed: workspace, support plane or outlier
    TOO_SHORT = "too-short"  # approach and contact point coincide
    TOO_LONG = "too-long"  # the contact lies beyond half the opening
    NO_DIRECTION = "no-direction"  # the edge runs along the normal
    TOO_DEEP = "too-deep"  # the contact lies deeper than the fingers are long
    NOTHING_BETWEEN = "nothing-between"  # the hand pose has no point between its fingers


class Ungraspable(StrEnum):
    """Why an object has no good grasp."""

    TOO_WIDE = "too-wide"  # its visible part is wider than the hand opens, on all sides
    TOO_FLAT = "too-flat"  # most hands would cut into the support, or come from below
    BLOCKED = "blocked"  # every hand would hit something, or could in unseen space
    HIDDEN = "hidden"  # no camera saw where it ends beyond the fingers


class Following(StrEnum):
    """The outcome of the first grasp of `previous`."""

    STARTED = "started"  # there was none
    KEPT = "kept"  # it is the first again, moved with its object
    REPLACED = "replaced"  # another one is better by a margin
    LOST = "lost"  # its object is not found again, or the hand no longer fits


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class ArmPlan:
    """How an arm gets to a grasp."""

    reachable: bool  # whether it gets there and straight on, and to the place, touching nothing
    pregrasp_joints: Float64 | None = None  # (J,) where it is reachable
    grasp_joints: Float64 | None = None  # (J,) where it is reachable
    trajectory: ArmTrajectory | None = None  # if it was asked for and found in time
    place_joints: Float64 | None = None  # (J,) where it lets go; None without a place
    T_base_place: Float64 | None = None  # (4, 4) the hand there, base frame


@dataclass(frozen=True)
class Grasp:
    """One grasp to execute: reach `T_cloud_hand` along `approach_direction`, then close."""

    score: float  # probability that the grasp holds
    T_cloud_hand: Float32  # (4, 4) hand link frame: z out of the palm, y the closing direction
    T_cloud_tcp: Float32  # (4, 4) tool centre point (TCP), same axes
    width: float  # metres to open to before the approach; the maximum if the far side is hidden
    approach_point: Float32  # (3,) p_a, metres, cloud frame
    contact_point: Float32  # (3,) p_c, metres, cloud frame
    approach_direction: Float32  # (3,) unit, the direction the hand moves; +z of the hand
    collision_free: bool  # whether the open hand is free at the grasp, on approach and retreat
    clearance: float  # metres from the open hand at the grasp to the nearest surface; <= 0: inside
    object: int | None = None  # number of the object that the contact is on; None: no object
    arm: ArmPlan | None = None  # None: no robot was given, or time ran out
    id: int | None = None  # the same in all answers that follow it; None without `previous`
    far_side_hidden: bool = False  # whether no camera saw where the object ends beside a finger


@dataclass(frozen=True)
class Tracking:
    """How an answer continues an earlier one."""

    first: Following
    next_id: int  # above all ids and numbers used so far


@dataclass(frozen=True)
class FoundSupport:
    """The plane that objects rest on: the points x with normal . x = offset; cloud frame."""

    normal: Float32  # (3,) unit, away from the table
    offset: float  # metres
    residual: float | None  # metres, median distance of its points; None: none of it is seen
    share: float  # of the seen surface that lies in it


@dataclass(frozen=True)
class GripperOutline:
    """The gripper of the grasps, as needed for drawing it; metres along the hand's z."""

    name: str
    palm_z: float  # the palm's surface between the fingers
    tip_z: float  # the fingertips of the open gripper


@dataclass(frozen=True)
class DetectedObject:
    """A recognised object; cloud frame, metres."""

    number: int  # as in `Grasp.object`; the segment, where segment_ids were sent
    points: int  # its number of voxels in the processed cloud
    center: Float32  # (3,) of the smallest upright box around them
    half_extents: Float32  # (3,) of that box, along its own axes, the last of which is up
    quaternion: Float32  # (4,) x, y, z, w: rotates the box's axes into the cloud's
    best_score: float | None  # of the grasps returned; None: it has none
    confidence: float | None  # probability that it is an object; None: given by the caller
    reason: Ungraspable | None  # why it has no good grasp; None: it has one, or unknown
    surface: Float32 | None = None  # (K, 3) points that `previous` finds it by; sent if tracking


@dataclass(frozen=True)
class DebugInfo:
    """The processed cloud and every candidate with its outcome. V points, E candidates."""

    points: Float32  # (V, 3) metres, cloud frame
    normals: Float32  # (V, 3) unit
    approach_index: Int64  # (E,) p_a, rows of `points`
    contact_index: Int64  # (E,) p_c, rows of `points`
    T_cloud_hand: Float32  # (E, 4, 4)
    score: Float32  # (E,) NaN where it was not scored
    outcome: list[Outcome]  # E of them
    support_plane: Float32 | None  # (4,) unit normal and offset, given or found, metres
    # (R,) of each row of the cloud as sent, images row by row: the number of its object;
    # OBSTACLE; SUPPORT; UNLABELLED: no reading, cut off or below the support.
    labels: Int64


@dataclass(frozen=True)
class Detection:
    """Ranked grasps of one cloud, with counts and timings."""

    grasps: list[Grasp]
    counts: dict[str, int]  # points, candidates and grasps that passed each stage, in order
    seconds: dict[str, float]  # spent in each stage, and their `total`
    model: str  # name of the weights used
    gripper: GripperOutline
    warnings: list[str] = field(default_factory=list)
    debug: DebugInfo | None = None  # where it was asked for
    support: FoundSupport | None = None  # given or found
    up: Float32 = field(default_factory=lambda: np.array([0, 0, 1], np.float32))  # (3,) unit, used
    objects: list[DetectedObject] = field(default_factory=list)  # the largest first
    tracking: Tracking | None = None  # where `previous` was sent


@dataclass(frozen=True)
class Evaluation:
    """The score of one edge or hand pose given by the caller."""

    grasp: Grasp | None  # None if it defines no edge grasp
    reason: NoGrasp | None  # why it defines none


@dataclass(frozen=True)
class Scoring:
    """Evaluations in the order in which the caller gave edges or hand poses."""

    evaluations: list[Evaluation]
    counts: dict[str, int]
    seconds: dict[str, float]
    model: str
    warnings: list[str] = field(default_factory=list)


class Pace(NamedTuple):
    """Least processor time of a detection, seconds; 0: not measured."""

    point: float = 0.0  # for each point of the cloud
    voxel: float = 0.0  # for each voxel in which grasps are searched
