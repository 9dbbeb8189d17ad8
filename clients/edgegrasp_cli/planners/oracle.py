"""An oracle: tries candidates in a copy of the scene; the ceiling of what sampling offers."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edgegrasp_cli.planners.edge_sample import CandidateSampler
from edgegrasp_sim.grasping import GraspResult
from edgegrasp_sim.gripper import MAX_OPENING
from edgegrasp_sim.simulation import Observation
from edgegrasp_sim.trials import PlannedGrasp

MAX_TRIES = 300  # candidates tried in one view


@dataclass(frozen=True)
class OracleFactory:
    """Makes an oracle in each worker process."""

    sampler: CandidateSampler

    def __call__(self) -> "OraclePlanner":
        """An oracle."""
        return OraclePlanner(self.sampler)


class OraclePlanner:
    """Takes the first random candidate that holds when tried, or any if none of them does."""

    def __init__(self, sampler: CandidateSampler) -> None:
        self.sampler = sampler
        self._try_grasp: Callable[[ArrayLike], GraspResult] | None = None

    def use_trial(self, try_grasp: Callable[[ArrayLike], GraspResult]) -> None:
        """Take what tries a grasp without changing the scene."""
        self._try_grasp = try_grasp

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """A candidate that holds; score 1 if it does, 0 if `MAX_TRIES` were tried in vain."""
        if self._try_grasp is None:
            raise RuntimeError("the oracle has no scene to try grasps in; call use_trial first")
        poses = self.sampler(observation, np.random.default_rng(seed))
        if len(poses) == 0:
            return None
        for pose in poses[:MAX_TRIES]:
            if self._try_grasp(pose).success:
                return PlannedGrasp(pose, 1.0, MAX_OPENING)
        return PlannedGrasp(poses[0], 0.0, MAX_OPENING)
