"""How the joints of a gripper stand for an opening."""

from collections.abc import Callable
from dataclasses import dataclass


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
