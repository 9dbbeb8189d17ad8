"""The planner that runs the detector in its own process, without a server."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edgegrasp_cli.planners.requests import choose, request_options
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_sim.observation import Observation
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.trials import PlannedGrasp

FLIP_STREAM = 7  # random stream of one request


@dataclass(frozen=True)
class InProcessPlannerFactory:
    """Loads the weights in each worker process.

    Attributes:
        weights: files or folders besides those that ship.
        model: weights to use; empty: the best that is there.
        rules: of the protocol.
        options: of each request, besides the protocol's.
        voxel_size: metres, in place of what the weights were trained on.
        flipped_normals: share of the processed cloud's normals to turn around at random.
    """

    weights: tuple[Path, ...]
    model: str
    rules: PlanningRules
    options: dict[str, Any]
    voxel_size: float | None = None
    flipped_normals: float = 0.0

    def __call__(self) -> "InProcessPlanner":
        """A planner with these weights.

        Raises:
            EdgeGraspError: they cannot be loaded.
        """
        detector = ModelCatalogue.load(self.weights).get(self.model)
        if self.voxel_size is not None:
            detector.metadata = replace(detector.metadata, voxel_size=self.voxel_size)
        return InProcessPlanner(detector, self.rules, self.options, self.flipped_normals)


@dataclass(frozen=True)
class InProcessPlanner:
    """Takes the best grasp of a detector."""

    detector: GraspDetector
    rules: PlanningRules
    options: dict[str, Any]
    flipped_normals: float = 0.0

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The best grasp; None where there is none."""
        options = parse_options(request_options(observation, seed, self.rules, self.options))
        several = len(observation.camera_positions) > 1
        cloud = CloudInput(observation.cloud, view_ids=observation.view_ids if several else None)
        with one_thread():
            if self.flipped_normals > 0:
                cloud = self._with_flipped_normals(cloud, options)
            detection = self.detector.detect(cloud, options)
        best = choose(detection.grasps, self.rules, observation.failed)
        return PlannedGrasp(best.T_cloud_hand, best.score, best.width) if best else None

    def _with_flipped_normals(self, cloud: CloudInput, options: DetectOptions) -> CloudInput:
        """The cloud with the normals that the pipeline would find, some of them turned around.

        Normals are sent for each point and averaged in each voxel; so all points of a voxel get
        that voxel's.
        """
        scene = self.detector.prepare(cloud, options).scene
        if scene is None:
            return cloud
        rng = np.random.default_rng([options.seed, FLIP_STREAM])
        flips = rng.random(len(scene.cloud.normals)) < self.flipped_normals
        found = scene.frame.directions_in_cloud(scene.cloud.normals)
        turned = np.where(flips[:, None], -found, found).astype(np.float32)
        # Points of no voxel that is kept have no say, whatever their normal.
        up = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
        normals = np.concatenate([turned, up])[scene.point_of_row]
        return replace(cloud, normals=normals)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread: sums then do not depend on how many there are elsewhere."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
