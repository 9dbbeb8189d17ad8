"""Grasps in the conventions of other programs; numpy only, nothing of theirs is imported.

- `frames`: hand frames with other axes and origins (Contact-GraspNet, GraspNet, VGN), quaternions.
- `moveit`: `moveit_msgs/Grasp`.
- `isaac`: `isaac_grasp` YAML files.

Pictures of the frames stand in docs/frames.md.
"""

from edgegrasp_client.conversions.frames import (
    CONTACT_GRASPNET,
    VGN,
    HandFrame,
    from_frame,
    graspnet_frame,
    matrix_from_quaternion,
    quaternion_from_matrix,
    to_frame,
)
from edgegrasp_client.conversions.isaac import IsaacGrasp, isaac_grasps, read_isaac_grasps
from edgegrasp_client.conversions.joints import PANDA_JOINTS, FingerJoints
from edgegrasp_client.conversions.moveit import moveit_grasp, pose_from_moveit_grasp

__all__ = [
    "CONTACT_GRASPNET",
    "PANDA_JOINTS",
    "VGN",
    "FingerJoints",
    "HandFrame",
    "IsaacGrasp",
    "from_frame",
    "graspnet_frame",
    "isaac_grasps",
    "matrix_from_quaternion",
    "moveit_grasp",
    "pose_from_moveit_grasp",
    "quaternion_from_matrix",
    "read_isaac_grasps",
    "to_frame",
]
