"""Grasps in the conventions of other programs, none of which is imported.

- Hand frames with other axes and origins (Contact-GraspNet, GraspNet, VGN).
- Rotations as quaternions xyzw.
- `moveit_msgs/Grasp` and `trajectory_msgs/JointTrajectory`, as dictionaries of their fields.
- `isaac_grasp` YAML 1.0, in the dialects of Isaac Sim's Grasp Editor and of Isaac ROS; needs the
  extra `yaml`.

docs/frames.md has pictures of the frames.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from edgegrasp_camera.arrays import Array, Float64
from edgegrasp_results import ArmTrajectory, Grasp

Message = dict[str, Any]

_AXES = dict(zip(("x", "y", "z", "-x", "-y", "-z"), [*np.eye(3), *-np.eye(3)], strict=True))


@dataclass(frozen=True)
class HandFrame:
    """A frame fixed to the hand: the directions of its axes and its origin.

    Rotating a parallel-jaw hand by 180 degrees about the approach gives the same grasp, so
    `closing="x"` and `closing="-x"` are both correct.
    """

    approach: str  # the frame's axis along the approach: x, -x, y, -y, z or -z
    closing: str  # the frame's axis along our y, the closing direction
    origin_z: float = 0.0  # metres along our z from our hand frame's origin to the frame's

    def __post_init__(self) -> None:
        axes = self.approach, self.closing
        if not _AXES.keys() >= {*axes} or len({axis[-1] for axis in axes}) < 2:
            raise ValueError(f"got {axes}. Use one of {', '.join(_AXES)}, and one across it.")

    @property
    def T_hand_frame(self) -> Float64:  # noqa: N802
        """Maps the frame's coordinates to our hand frame's, (4, 4)."""
        approach, closing = _AXES[self.approach], _AXES[self.closing]
        transform = np.eye(4)
        # Rows: our x, y and z axes in the frame's coordinates.
        transform[:3, :3] = [np.cross(closing, approach), closing, approach]
        transform[2, 3] = self.origin_z
        return transform


CONTACT_GRASPNET = HandFrame(approach="z", closing="x")
"""Contact-GraspNet, 6-DOF GraspNet, ACRONYM: origin of `panda_hand`, x the closing direction."""

VGN = HandFrame(approach="z", closing="y", origin_z=0.062)
"""VGN's TCP with the Panda hand: 0.022 m ahead of the centre of mass, which lies at z = 0.04."""


def graspnet_frame(tip_z: float, depth: float = 0.02) -> HandFrame:
    """GraspNet-1Billion (graspnetAPI): x the approach, y the closing direction.

    `tip_z` is the position of the gripper's fingertips along our z in metres (0.1122 for the Panda
    hand), and `depth` the grasp's depth in GraspNet: metres from its origin to the fingertips.
    """
    return HandFrame(approach="x", closing="y", origin_z=tip_z - depth)


def to_frame(T_cloud_hand: ArrayLike, frame: HandFrame) -> Float64:
    """Poses (..., 4, 4) of another frame on the hand, cloud frame, from poses of our hand frame."""
    return np.asarray(T_cloud_hand, dtype=np.float64) @ frame.T_hand_frame


@dataclass(frozen=True)
class FingerJoints:
    """The joints that open and close a gripper."""

    names: tuple[str, ...]
    positions_at: Callable[[float], tuple[float, ...]]  # opening in metres to joint positions

    def at(self, opening: float) -> dict[str, float]:
        """Position of each joint at an opening in metres."""
        return dict(zip(self.names, self.positions_at(opening), strict=True))


PANDA_JOINTS = FingerJoints(
    names=("panda_finger_joint1", "panda_finger_joint2"),
    positions_at=lambda opening: (opening / 2, opening / 2),
)
"""The Panda's two finger joints: metres from the middle, each half the opening."""

PANDA_LINK8: Float64 = np.eye(4)
"""T_hand_link of the link that carries the Panda hand in MoveIt's configuration, `panda_link8`."""
PANDA_LINK8[:2, :2] = np.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])  # 45 degrees about z
PANDA_LINK8.setflags(write=False)


def moveit_grasp(
    grasp: Grasp,
    frame_id: str,
    *,
    name: str = "",
    stamp: Message | None = None,
    joints: FingerJoints = PANDA_JOINTS,
    T_hand_link: ArrayLike | None = None,
    approach_distance: float = 0.05,
    retreat_distance: float = 0.1,
) -> Message:
    """A grasp as the fields of `moveit_msgs/Grasp` (ROS 2).

    Build the message with `rosidl_runtime_py.set_message_fields(Grasp(), fields)`.

    Args:
        grasp: A grasp of the server's answer.
        frame_id: Name of the cloud's frame.
        name: The message's `id`.
        stamp: Time of the cloud, `sec` and `nanosec`, needed if its frame moves with the hand;
            None: 0, which means the latest transform.
        joints: The gripper's joints.
        T_hand_link: (4, 4) pose, in our hand frame, of the end effector's parent link, which MoveIt
            moves to the grasp, such as PANDA_LINK8; None: it is the hand frame.
        approach_distance: Metres of straight approach.
        retreat_distance: Metres of straight retreat, back along the approach.

    Returns:
        The message's fields, without those that keep the default of a new message; orientations
        have the four fields x, y, z, w.
    """
    approach = np.asarray(grasp.approach_direction, dtype=np.float64)
    T_cloud_link = _matrix(grasp.T_cloud_hand) @ _matrix(T_hand_link)
    header = {"stamp": stamp or {"sec": 0, "nanosec": 0}, "frame_id": frame_id}
    return {
        "id": name,
        "pre_grasp_posture": _posture(joints, grasp.width),
        "grasp_posture": _posture(joints, 0.0),
        "grasp_pose": {"header": header, "pose": pose_fields(T_cloud_link)},
        "grasp_quality": float(grasp.score),
        "pre_grasp_approach": _translation(approach, approach_distance, header),
        "post_grasp_retreat": _translation(-approach, retreat_distance, header),
        "post_place_retreat": _translation(-approach, retreat_distance, header),
    }


def joint_trajectories(motion: ArmTrajectory) -> list[Message]:
    """A motion as the fields of `trajectory_msgs/JointTrajectory`, to be executed one by one.

    The first ends at the grasp, where the hand closes. With a place, the second ends where the hand
    opens. Each begins and ends at rest; without a stamp, it is executed on arrival.
    """
    stops = [0, motion.grasp_row, motion.release_row, len(motion.times) - 1]
    return [
        {
            "joint_names": list(motion.joint_names),
            "points": [_point(motion, row, first) for row in range(first, last + 1)],
        }
        for first, last in pairwise([row for row in stops if row is not None])
    ]


def _point(motion: ArmTrajectory, row: int, first: int) -> Message:
    seconds, nanoseconds = divmod(round(1e9 * (motion.times[row] - motion.times[first])), 10**9)
    return {
        "positions": motion.positions[row].tolist(),
        "velocities": motion.velocities[row].tolist(),
        "time_from_start": {"sec": seconds, "nanosec": nanoseconds},
    }


@dataclass(frozen=True, eq=False)
class IsaacGrasp:
    """One grasp of an `isaac_grasp` file."""

    name: str
    confidence: float
    T_object_gripper: Float64  # (4, 4) pose of the gripper's frame in the object's
    cspace_position: dict[str, float] = field(default_factory=dict)  # joints, closed
    pregrasp_cspace_position: dict[str, float] = field(default_factory=dict)  # joints, open


def isaac_grasps(
    grasps: Sequence[Grasp],
    *,
    object_frame: str,
    gripper_frame: str,
    T_object_cloud: ArrayLike | None = None,
    T_hand_gripper: ArrayLike | None = None,
    joints: FingerJoints = PANDA_JOINTS,
    dialect: Literal["isaac-sim", "isaac-ros"] = "isaac-sim",
) -> str:
    """Grasps as the text of an `isaac_grasp` file.

    Args:
        grasps: Grasps of the server's answer, best first.
        object_frame: Name of the object's frame, such as `/World/mug`.
        gripper_frame: Name of the gripper's frame, such as `/World/panda_hand`.
        T_object_cloud: (4, 4) pose of the cloud's frame in the object's; None: they are the same.
        T_hand_gripper: (4, 4) pose of the gripper's frame in our hand frame; None: the same.
        joints: The gripper's joints.
        dialect: Names of the frames: `object_frame_link` and `gripper_frame_link` in Isaac
            Sim, `object_frame` and `gripper_frame` in Isaac ROS.

    Returns:
        YAML; orientations are w and xyz.

    Raises:
        ModuleNotFoundError: The extra `yaml` is not installed.
    """
    link = {"isaac-sim": "_link", "isaac-ros": ""}[dialect]
    found: Message = {}
    for number, grasp in enumerate(grasps):
        T_object_hand = _matrix(T_object_cloud) @ _matrix(grasp.T_cloud_hand)
        pose = pose_fields(T_object_hand @ _matrix(T_hand_gripper))
        w, *xyz = (pose["orientation"][axis] for axis in "wxyz")
        found[f"grasp_{number}"] = {
            "confidence": float(grasp.score),
            "position": list(pose["position"].values()),
            "orientation": {"w": w, "xyz": xyz},
            "cspace_position": _joint_positions(joints.at(0.0)),
            "pregrasp_cspace_position": _joint_positions(joints.at(grasp.width)),
        }
    file = {
        "format": "isaac_grasp",
        "format_version": 1.0,
        f"object_frame{link}": object_frame,
        f"gripper_frame{link}": gripper_frame,
        "grasps": found,
    }
    return str(_yaml().safe_dump(file, sort_keys=False, default_flow_style=None, width=200))


def read_isaac_grasps(text: str) -> list[IsaacGrasp]:
    """The grasps of an `isaac_grasp` file of either dialect.

    Raises:
        ModuleNotFoundError: The extra `yaml` is not installed.
        ValueError: It is not such a file; the message names the line or field.
    """
    yaml = _yaml()
    try:
        file = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"isaac_grasp file: {error}") from None
    fields = file if isinstance(file, dict) else {}
    kind = (fields.get("format"), fields.get("format_version"))
    if kind != ("isaac_grasp", 1.0):
        raise ValueError(f"format, format_version: got {kind}. Give isaac_grasp, 1.0.")
    grasps = fields.get("grasps") or {}
    if not isinstance(grasps, dict):
        raise ValueError(f"grasps: got a {type(grasps).__name__}. Give a mapping of names.")
    return [_isaac_grasp(name, grasp) for name, grasp in grasps.items()]


def quaternion_from_matrix(rotation: ArrayLike) -> Float64:
    """The unit quaternion (4,) x, y, z, w of a rotation (3, 3); w is not negative."""
    r = np.asarray(rotation, dtype=np.float64)
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    multiples = np.empty((4, 4))  # of the quaternion, by 4x, 4y, 4z and 4w
    multiples[:3, :3] = r + r.T + (1.0 - np.trace(r)) * np.eye(3)
    multiples[:3, 3] = multiples[3, :3] = x, y, z
    multiples[3, 3] = 1.0 + np.trace(r)
    longest = multiples[np.argmax(np.diag(multiples))]  # numerically the most precise row
    quaternion: Float64 = longest / np.linalg.norm(longest)
    return -quaternion if quaternion[3] < 0 else quaternion


def matrix_from_quaternion(quaternion: ArrayLike) -> Float64:
    """The rotation (3, 3) of a quaternion x, y, z, w; raises ValueError for a zero quaternion."""
    q = np.asarray(quaternion, dtype=np.float64)
    length = np.linalg.norm(q)
    if not np.isfinite(length) or length < 1e-12:
        raise ValueError(f"quaternion: got {q.tolist()}. Give x, y, z, w that are not all zero.")
    x, y, z, w = q / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # cross @ v: the axis times v
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _matrix(pose: ArrayLike | None) -> Float64:
    """A (4, 4) pose in double precision; the identity for None."""
    return np.eye(4) if pose is None else np.asarray(pose, dtype=np.float64)


def pose_fields(T: Array) -> Message:
    """A (4, 4) transform as the fields of `geometry_msgs/Pose`."""
    return {
        "position": xyz_fields(T[:3, 3]),
        "orientation": dict(zip("xyzw", quaternion_from_matrix(T[:3, :3]).tolist(), strict=True)),
    }


def _posture(joints: FingerJoints, opening: float) -> Message:
    # A stamp would be the start time.
    point = {"positions": list(joints.at(opening).values())}
    return {"joint_names": list(joints.names), "points": [point]}


def _translation(direction: Float64, distance: float, header: Message) -> Message:
    unit = direction / np.linalg.norm(direction)
    return {
        "direction": {"header": header, "vector": xyz_fields(unit)},
        "desired_distance": float(distance),
        "min_distance": float(distance),
    }


def xyz_fields(vector: Array) -> Message:
    """A vector (3,) as the fields x, y, z."""
    return {axis: float(value) for axis, value in zip("xyz", vector, strict=True)}


def _isaac_grasp(name: str, fields: Any) -> IsaacGrasp:
    try:  # YAML reads 1e-05, which has no point, as text: convert numbers here
        x, y, z = fields["orientation"]["xyz"]
        rotation = matrix_from_quaternion([x, y, z, fields["orientation"]["w"]])
        T_object_gripper = np.eye(4)
        T_object_gripper[:3, :3], T_object_gripper[:3, 3] = rotation, fields["position"]
        return IsaacGrasp(
            name=str(name),
            confidence=float(fields["confidence"]),
            T_object_gripper=T_object_gripper,
            cspace_position=_joint_positions(fields.get("cspace_position")),
            pregrasp_cspace_position=_joint_positions(fields.get("pregrasp_cspace_position")),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"grasps.{name}: {error!r}") from error


def _joint_positions(positions: Any) -> dict[str, float]:
    return {str(name): float(position) for name, position in (positions or {}).items()}


def _yaml() -> ModuleType:
    try:
        import yaml
    except ModuleNotFoundError:
        message = "isaac_grasp files need PyYAML: pip install 'edgegrasp[yaml]'"
        raise ModuleNotFoundError(message, name="yaml") from None
    return yaml
