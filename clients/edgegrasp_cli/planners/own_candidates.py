"""The candidates that our own pipeline would let its network score."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from edgegrasp_cli.planners.paper_candidates import Float32
from edgegrasp_cli.planners.requests import request_options
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.options import parse_options
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_sim.observation import Observation
from edgegrasp_sim.protocol import PlanningRules


@dataclass
class OwnCandidates:
    """Draws candidates as a detection does, level grasps included, free of collision.

    Attributes:
        rules: of the protocol.
        options: of each request, besides the protocol's.
        weights: files or folders besides those that ship; they only say how clouds are prepared.
        model: of them; empty: the best that is there.
    """

    rules: PlanningRules
    options: dict[str, Any] = field(default_factory=dict)
    weights: tuple[Path, ...] = ()
    model: str = ""

    @cached_property
    def detector(self) -> GraspDetector:
        """Loaded where it is first needed, so that this can be sent to worker processes."""
        return ModelCatalogue.load(self.weights).get(self.model)

    def __call__(self, observation: Observation, rng: np.random.Generator) -> Float32:
        """Poses `T_world_hand` of candidates, in random order: (E, 4, 4)."""
        seed = int(rng.integers(2**31))
        options = request_options(observation, seed, self.rules, self.options)
        several = len(observation.camera_positions) > 1
        cloud = CloudInput(observation.cloud, view_ids=observation.view_ids if several else None)
        prepared = self.detector.prepare(cloud, parse_options(options))
        if prepared.scene is None or prepared.sample is None:
            return np.empty((0, 4, 4), dtype=np.float32)
        sample = prepared.sample
        poses = sample.candidates.take(sample.collision_free).T_cloud_hand
        return prepared.scene.frame.poses_in_cloud(poses[rng.permutation(len(poses))])
