"""A hand on an arm, which follows a planned motion."""

from collections.abc import Iterator

import numpy as np

from edgegrasp_results import ArmTrajectory
from edgegrasp_sim.engine import TIME_STEP, ArmModel, HandModel, World
from edgegrasp_sim.hand import CLOSE_SECONDS, MIN_OPENING, Gripper
from edgegrasp_sim.poses import Matrix

SETTLE_SECONDS = 0.25  # at the grasp and at the end, in which the joints arrive


def seconds_of(motion: ArmTrajectory) -> float:
    """Seconds of the motion from home to the grasp, away, and back home the same way."""
    return float(motion.times[-1] + motion.times[motion.pregrasp_row]) + CLOSE_SECONDS


class ArmGripper(Gripper):
    """The hand on an arm; `motion` is that of the next grasp."""

    motion: ArmTrajectory | None = None

    def __init__(
        self, world: World, hand: HandModel, arm: ArmModel, min_opening: float = MIN_OPENING
    ) -> None:
        self.world, self.model, self.min_opening = world, hand, min_opening
        self.body = self._arm = world.add_arm(arm, hand)

    def park(self) -> None:
        """Put the arm to its home, the hand open."""
        self._arm.rest()

    def start(self, T_world_hand: Matrix) -> None:
        """Start at home, wherever the grasp is."""
        self.park()

    def approach(self, T_world_hand: Matrix) -> Iterator[None]:
        """Follow the motion to the grasp."""
        motion = self._planned
        self.on_the_way = True
        for seconds in self._follow(0, motion.grasp_row):
            self.on_the_way = bool(seconds < motion.times[motion.pregrasp_row])
            yield

    def retreat(self, T_world_hand: Matrix) -> Iterator[None]:
        """Follow the motion away from the grasp."""
        motion = self._planned
        for _ in self._follow(motion.grasp_row, len(motion.times) - 1):
            yield

    @property
    def _planned(self) -> ArmTrajectory:
        if self.motion is None:
            raise ValueError("the grasp has no motion of the arm; plan it with a robot")
        return self.motion

    def _follow(self, first: int, last: int) -> Iterator[float]:
        """Yields the time after every time step."""
        motion, substeps = self._planned, self._arm.substeps
        begin, end = motion.times[first], motion.times[last]
        steps = int(np.ceil((end - begin + SETTLE_SECONDS) / TIME_STEP))
        for step in range(steps):
            times = begin + (step + np.arange(1, substeps + 1) / substeps) * TIME_STEP
            times = times.clip(max=end)
            rows = [
                np.column_stack([np.interp(times, motion.times, joint) for joint in table.T])
                for table in (motion.positions, motion.velocities)
            ]
            self._arm.drive(*rows)
            self.world.step()
            yield float(times[-1])
