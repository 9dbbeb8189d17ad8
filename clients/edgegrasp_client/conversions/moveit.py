"""Grasps as `moveit_msgs/Grasp`, in plain dictionaries of that message's fields."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from edgegrasp_client.conversions.frames import (
    Float64,
    matrix_from_quaternion,
    quaternion_from_matrix,
    transform,
)
from edgegrasp_client.conversions.joints import PANDA_JOINTS, FingerJoints
from edgegrasp_client.results import Grasp

Message = dict[str, Any]


def moveit_grasp(
    grasp: Grasp,
    frame_id: str,
    *,
    name: str = "",
    joints: FingerJoints = PANDA_JOINTS,
    T_hand_link: ArrayLike | None = None,
    approach_distance: float = 0.05,
    retreat_distance: float = 0.1,
    retreat_direction: Sequence[float] | None = None,
) -> Message:
    """A grasp as the fields of `moveit_msgs/Grasp` (ROS 2).

    Build the message with `rosidl_runtime_py.set_message_fields(Grasp(), fields)`.

    Args:
        grasp: What the server answered.
        frame_id: Name of the cloud's frame.
        name: The message's `id`.
        joints: The gripper's joints.
        T_hand_link: (4, 4) pose in our hand frame of the end effector's parent link, whose pose
            MoveIt wants; None: it is the hand frame.
        approach_distance: Metres of straight way in.
        retreat_distance: Metres of straight way out.
        retreat_direction: (3,) way out, cloud frame; None: back along the approach.

    Returns:
        The message's fields; orientations are the four fields x, y, z, w.
    """
    approach = np.asarray(grasp.approach_direction, dtype=np.float64)
    retreat = -approach if retreat_direction is None else np.asarray(retreat_direction, np.float64)
    T_cloud_link = np.asarray(grasp.T_cloud_hand, dtype=np.float64)
    if T_hand_link is not None:
        T_cloud_link = T_cloud_link @ np.asarray(T_hand_link, dtype=np.float64)
    return {
        "id": name,
        "pre_grasp_posture": _posture(joints, grasp.width, frame_id),
        "grasp_posture": _posture(joints, 0.0, frame_id),
        "grasp_pose": {"header": _header(frame_id), "pose": _pose(T_cloud_link)},
        "grasp_quality": float(grasp.score),
        "pre_grasp_approach": _translation(approach, approach_distance, frame_id),
        "post_grasp_retreat": _translation(retreat, retreat_distance, frame_id),
        "post_place_retreat": _translation(-approach, retreat_distance, frame_id),
        "max_contact_force": 0.0,
        "allowed_touch_objects": [],
    }


def pose_from_moveit_grasp(
    message: Mapping[str, Any], T_hand_link: ArrayLike | None = None
) -> Float64:
    """T_cloud_hand of a `moveit_msgs/Grasp` given as a dictionary of its fields.

    Args:
        message: The fields; only `grasp_pose` is read.
        T_hand_link: (4, 4) as for `moveit_grasp`.

    Returns:
        (4, 4).
    """
    pose = message["grasp_pose"]["pose"]
    rotation = matrix_from_quaternion([pose["orientation"][axis] for axis in "xyzw"])
    T_cloud_link = transform(rotation, [pose["position"][axis] for axis in "xyz"])
    if T_hand_link is None:
        return T_cloud_link
    return T_cloud_link @ np.linalg.inv(np.asarray(T_hand_link, dtype=np.float64))


def _header(frame_id: str) -> Message:
    return {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame_id}


def _pose(T: Float64) -> Message:
    return {
        "position": _xyz(T[:3, 3]),
        "orientation": dict(zip("xyzw", quaternion_from_matrix(T[:3, :3]).tolist(), strict=True)),
    }


def _posture(joints: FingerJoints, opening: float, frame_id: str) -> Message:
    point = {
        "positions": list(joints.at(opening).values()),
        "velocities": [],
        "accelerations": [],
        "effort": [],
        "time_from_start": {"sec": 0, "nanosec": 0},
    }
    return {"header": _header(frame_id), "joint_names": list(joints.names), "points": [point]}


def _translation(direction: Float64, distance: float, frame_id: str) -> Message:
    unit = direction / np.linalg.norm(direction)
    return {
        "direction": {"header": _header(frame_id), "vector": _xyz(unit)},
        "desired_distance": float(distance),
        "min_distance": float(distance),
    }


def _xyz(vector: Float64) -> Message:
    return dict(zip("xyz", vector.tolist(), strict=True))
