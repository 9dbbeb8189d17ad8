"""Grasps as `isaac_grasp` YAML, the file format of Isaac Sim's Grasp Editor, version 1.0."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
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
from edgegrasp_client.conversions.yaml_subset import read_mapping
from edgegrasp_client.results import Grasp


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
) -> str:
    """Grasps as the text of an `isaac_grasp` file.

    Args:
        grasps: What the server answered, best first.
        object_frame: Name of the object's frame, such as `/World/mug`.
        gripper_frame: Name of the gripper's frame, such as `/World/panda_hand`.
        T_object_cloud: (4, 4) pose of the cloud's frame in the object's; None: they are the same.
        T_hand_gripper: (4, 4) pose of the gripper's frame in our hand frame; None: the same.
        joints: The gripper's joints.

    Returns:
        YAML; orientations are w and xyz.
    """
    T_object_cloud = np.eye(4) if T_object_cloud is None else np.asarray(T_object_cloud, np.float64)
    T_hand_gripper = np.eye(4) if T_hand_gripper is None else np.asarray(T_hand_gripper, np.float64)
    lines = [
        "format: isaac_grasp",
        "format_version: 1.0",
        f"object_frame_link: {json.dumps(object_frame)}",
        f"gripper_frame_link: {json.dumps(gripper_frame)}",
        "grasps:" if grasps else "grasps: {}",
    ]
    for number, grasp in enumerate(grasps):
        pose = T_object_cloud @ np.asarray(grasp.T_cloud_hand, np.float64) @ T_hand_gripper
        x, y, z, w = quaternion_from_matrix(pose[:3, :3]).tolist()
        lines += [
            f"  grasp_{number}:",
            f"    confidence: {_number(grasp.score)}",
            f"    position: {_numbers(pose[:3, 3])}",
            f"    orientation: {{w: {_number(w)}, xyz: {_numbers([x, y, z])}}}",
            *_joint_lines("cspace_position", joints.at(0.0)),
            *_joint_lines("pregrasp_cspace_position", joints.at(float(grasp.width))),
        ]
    return "\n".join([*lines, ""])


def read_isaac_grasps(text: str) -> list[IsaacGrasp]:
    """The grasps of an `isaac_grasp` file.

    Reads what `isaac_grasps` and the Grasp Editor write, as far as `yaml_subset` goes.

    Raises:
        ValueError: It is not such a file; says which line or field.
    """
    file = read_mapping(text)
    kind = (file.get("format"), file.get("format_version"))
    if kind != ("isaac_grasp", 1.0):
        raise ValueError(f"format, format_version: got {kind}. Give isaac_grasp, 1.0.")
    return [_grasp(name, fields) for name, fields in (file.get("grasps") or {}).items()]


def _grasp(name: str, fields: Any) -> IsaacGrasp:
    try:
        x, y, z = fields["orientation"]["xyz"]
        rotation = matrix_from_quaternion([x, y, z, fields["orientation"]["w"]])
        return IsaacGrasp(
            name=name,
            confidence=float(fields["confidence"]),
            T_object_gripper=transform(rotation, fields["position"]),
            cspace_position=_joints(fields.get("cspace_position")),
            pregrasp_cspace_position=_joints(fields.get("pregrasp_cspace_position")),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"grasps.{name}: {error!r}") from error


def _joint_lines(name: str, positions: dict[str, float]) -> list[str]:
    joints = (f"      {joint}: {_number(at)}" for joint, at in positions.items())
    return [f"    {name}:", *joints]


def _joints(positions: Any) -> dict[str, float]:
    return {name: float(position) for name, position in (positions or {}).items()}


def _numbers(values: Iterable[float]) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _number(value: float) -> str:
    """A float as every YAML reader takes it for one: 1e-05 without a point is text to some."""
    digits, exponent, power = repr(float(value)).partition("e")
    return digits + (".0" if exponent and "." not in digits else "") + exponent + power
