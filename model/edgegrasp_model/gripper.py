"""A parallel-jaw gripper as a small data file."""

import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidGripper

GRIPPER_FOLDER = Path(__file__).parent / "grippers"


@dataclass(frozen=True)
class Gripper:
    """Geometry of a gripper in its hand frame: z toward the object, y the closing direction."""

    name: str
    max_opening: float  # metres between the open fingers' inner faces
    tip_z: float  # fingertips, metres along z
    contact_z: float  # where an edge grasp puts its contact point, metres along z
    tcp_z: float  # origin of the TCP frame, metres along z
    hand_boxes: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]  # ((min, max), ...)
    finger_boxes: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]  # inner face at y = 0

    @cached_property
    def T_hand_tcp(self) -> NDArray[np.float32]:  # noqa: N802
        """Maps TCP coordinates to hand coordinates.  # (4, 4)."""
        transform = np.eye(4, dtype=np.float32)
        transform[2, 3] = self.tcp_z
        return transform

    @property
    def palm_z(self) -> float:
        """Height of the palm's surface, metres along z."""
        return max(high[2] for _, high in self.hand_boxes)

    @property
    def finger_depth(self) -> float:
        """Greatest distance a contact can lie in front of the palm (the paper's G_d), metres."""
        return self.contact_z - self.palm_z

    def boxes(self, opening: float) -> NDArray[np.float64]:
        """All boxes with the fingers `opening` metres apart: hand, then both fingers.

        Returns:
            (B, 2, 3) min and max corners, hand frame.
        """
        fingers = np.asarray(self.finger_boxes, dtype=np.float64)  # (F, 2, 3)
        right = fingers + np.array([0.0, opening / 2, 0.0])
        left = right.copy()
        left[:, 0, 1], left[:, 1, 1] = -right[:, 1, 1], -right[:, 0, 1]
        return np.concatenate([np.asarray(self.hand_boxes, dtype=np.float64), right, left])


def load_gripper(name_or_path: str | Path = "panda") -> Gripper:
    """Load a gripper that ships with the package by name, or a user's own by path.

    Raises:
        InvalidGripper: There is no such file, or a field is missing or of the wrong kind.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = GRIPPER_FOLDER / f"{name_or_path}.toml"
    if not path.is_file():
        known = sorted(file.stem for file in GRIPPER_FOLDER.glob("*.toml"))
        raise InvalidGripper(f"gripper: got {name_or_path!r}. Use one of {known} or a .toml file.")
    try:
        return _from_fields(tomllib.loads(path.read_text()))
    except (KeyError, TypeError, ValueError, tomllib.TOMLDecodeError) as error:
        raise InvalidGripper(f"{path.name}: {error!r}; see grippers/panda.toml.") from error


def _from_fields(fields: dict[str, Any]) -> Gripper:
    return Gripper(
        name=str(fields["name"]),
        max_opening=float(fields["max_opening"]),
        tip_z=float(fields["tip_z"]),
        contact_z=float(fields["contact_z"]),
        tcp_z=float(fields["tcp_z"]),
        hand_boxes=_corner_pairs(fields["hand"]["boxes"]),
        finger_boxes=_corner_pairs(fields["finger"]["boxes"]),
    )


def _corner_pairs(boxes: list[Any]) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    pairs = []
    for low, high in boxes:
        if len(low) != 3 or len(high) != 3 or any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"box {[low, high]} is not [min corner, max corner]")
        pairs.append((tuple(map(float, low)), tuple(map(float, high))))
    return tuple(pairs)
