"""Messages as ROS 2 has them on the wire: rosbags serialises them, and reads them back."""

import sys
from pathlib import Path
from typing import Any

import numpy as np

PACKAGE = Path(__file__).parents[2] / "clients" / "ros2"
sys.path.insert(0, str(PACKAGE))

# Of moveit_msgs and grasping_msgs 0.5.0, without their comments.
DEFINITIONS = {
    "moveit_msgs/msg/GripperTranslation": """
        geometry_msgs/Vector3Stamped direction
        float32 desired_distance
        float32 min_distance""",
    "moveit_msgs/msg/Grasp": """
        string id
        trajectory_msgs/JointTrajectory pre_grasp_posture
        trajectory_msgs/JointTrajectory grasp_posture
        geometry_msgs/PoseStamped grasp_pose
        float64 grasp_quality
        moveit_msgs/GripperTranslation pre_grasp_approach
        moveit_msgs/GripperTranslation post_grasp_retreat
        moveit_msgs/GripperTranslation post_place_retreat
        float32 max_contact_force
        string[] allowed_touch_objects""",
    "grasping_msgs/msg/GraspPlanning_Result": "moveit_msgs/Grasp[] grasps",
}


class Types:
    """The messages that tests need; those of the node are read from its own package."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._store = get_typestore(Stores.ROS2_HUMBLE)
        texts = dict(DEFINITIONS)
        for path in (PACKAGE / "msg").glob("*.msg"):
            texts[f"edgegrasp_ros2/msg/{path.stem}"] = path.read_text()
        parts = (PACKAGE / "action" / "GenerateGrasps.action").read_text().split("---\n")
        for part, text in zip(("Goal", "Result", "Feedback"), parts, strict=True):
            # rosbags knows no actions; on the wire each part is a message.
            texts[f"edgegrasp_ros2/msg/GenerateGrasps_{part}"] = text
        for name, text in texts.items():
            self._store.register(get_types_from_msg(text, name))

    def make(self, name: str, fields: dict[str, Any]) -> Any:
        """A message with fields of a dictionary, the others as a new message has them."""
        _, definitions = self._store.fielddefs[name]
        unknown = set(fields) - {field for field, _ in definitions}
        assert not unknown, f"{name} has no {unknown}"
        values = {field: self._value(kind, fields.get(field)) for field, kind in definitions}
        return self._store.types[name](**values)

    def _value(self, kind: tuple[Any, Any], given: Any) -> Any:
        what, of = kind
        if what.name == "NAME":
            return given if hasattr(given, "__msgtype__") else self.make(of, given or {})
        if what.name == "BASE":
            return {"string": "", "bool": False}.get(of[0], 0) if given is None else given
        each, size = of
        if each[0].name == "NAME" or each[1][0] == "string":
            return [self._value(each, one) for one in (() if given is None else given)]
        return np.asarray(np.zeros(size) if given is None else given, np.dtype(each[1][0]))

    def sent(self, name: str, fields: dict[str, Any]) -> Any:
        """The message as it arrives: serialised as CDR and read again."""
        data = self._store.serialize_cdr(self.make(name, fields), name)
        return self._store.deserialize_cdr(data, name)
