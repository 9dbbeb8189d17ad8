"""An oracle: tries candidates in a copy of the scene; the ceiling of what sampling offers."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from edgegrasp_cli.planners.paper_candidates import Float32
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.hand import MAX_OPENING, GraspResult
from edgegrasp_sim.trial import PlannedGrasp

# From what is seen to poses `T_world_hand` in random order, (E, 4, 4); can be pickled.
Sampler: TypeAlias = Callable[[Observation, np.random.Generator], Float32]

MAX_TRIES = 300  # candidates tried in one view
# Metres along the hand's x and y: a grasp that holds there as well is no close call.
SHIFTS = ((0.002, 0.0), (-0.002, 0.0), (0.0, 0.002), (0.0, -0.002))


@dataclass(frozen=True)
class OracleFactory:
    """Makes an oracle in each worker process."""

    sampler: Sampler

    def __call__(self) -> "OraclePlanner":
        """An oracle."""
        return OraclePlanner(self.sampler)


class OraclePlanner:
    """Takes the first random candidate that holds when tried, and when tried a little aside.

    Without one, it takes the first that holds at all; without that, any.
    """

    def __init__(self, sampler: Sampler) -> None:
        self.sampler = sampler
        self._try_grasp: Callable[[ArrayLike], GraspResult] | None = None

    def use_trial(self, try_grasp: Callable[[ArrayLike], GraspResult]) -> None:
        """Take what tries a grasp without changing the scene."""
        self._try_grasp = try_grasp

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """A candidate that holds; score 1 if safely, 0.5 if barely, 0 if none did."""
        poses = self.sampler(observation, np.random.default_rng(seed))[:MAX_TRIES]
        if len(poses) == 0:
            return None
        fallback = PlannedGrasp(poses[0], 0.0, MAX_OPENING)
        for pose in poses:
            if not self._holds(pose):
                continue
            if all(self._holds(_shifted(pose, *shift)) for shift in SHIFTS):
                return PlannedGrasp(pose, 1.0, MAX_OPENING)
            if fallback.score == 0.0:
                fallback = PlannedGrasp(pose, 0.5, MAX_OPENING)
        return fallback

    def _holds(self, pose: Float32) -> bool:
        if self._try_grasp is None:
            raise RuntimeError("the oracle has no scene to try grasps in; call use_trial first")
        return self._try_grasp(pose).success


def _shifted(pose: Float32, along_x: float, along_y: float) -> Float32:
    shifted = pose.copy()
    shifted[:3, 3] += along_x * pose[:3, 0] + along_y * pose[:3, 1]
    return shifted
