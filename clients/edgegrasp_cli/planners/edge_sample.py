"""Edge-Sample: candidate edge grasps drawn uniformly, no network (the paper's baseline)."""

from dataclasses import dataclass

import numpy as np

from edgegrasp_cli.planners.paper_candidates import PaperCandidates
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.hand import MAX_OPENING
from edgegrasp_sim.trial import PlannedGrasp


@dataclass(frozen=True)
class EdgeSampleFactory:
    """Makes the baseline in each worker process."""

    sampler: PaperCandidates

    def __call__(self) -> "EdgeSamplePlanner":
        """The baseline."""
        return EdgeSamplePlanner(self.sampler)


@dataclass(frozen=True)
class EdgeSamplePlanner:
    """Takes any candidate: what the candidates are worth without a network."""

    sampler: PaperCandidates

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """A random candidate; None where there is none."""
        poses = self.sampler(observation, np.random.default_rng(seed))
        if len(poses) == 0:
            return None
        return PlannedGrasp(poses[0], score=0.0, width=MAX_OPENING)
