"""The planner that runs the detector in its own process, without a server."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgegrasp_cli.planners.requests import choose, request_options
from edgegrasp_model.catalogue import ModelCatalogue
from edgegrasp_model.cloud_input import CloudInput
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.options import parse_options
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.simulation import Observation
from edgegrasp_sim.trials import PlannedGrasp


@dataclass(frozen=True)
class InProcessPlannerFactory:
    """Loads the weights in each worker process.

    Attributes:
        weights: files or folders besides those that ship.
        model: weights to use; empty: the best that is there.
        rules: of the protocol.
        options: of each request, besides the protocol's.
    """

    weights: tuple[Path, ...]
    model: str
    rules: PlanningRules
    options: dict[str, Any]

    def __call__(self) -> "InProcessPlanner":
        """A planner with these weights.

        Raises:
            EdgeGraspError: they cannot be loaded.
        """
        detector = ModelCatalogue.load(self.weights).get(self.model)
        return InProcessPlanner(detector, self.rules, self.options)


@dataclass(frozen=True)
class InProcessPlanner:
    """Takes the best grasp of a detector."""

    detector: GraspDetector
    rules: PlanningRules
    options: dict[str, Any]

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The best grasp; None where there is none."""
        options = request_options(observation, seed, self.rules, self.options)
        several = len(observation.camera_positions) > 1
        cloud = CloudInput(observation.cloud, view_ids=observation.view_ids if several else None)
        detection = self.detector.detect(cloud, parse_options(options))
        best = choose(detection.grasps, self.rules)
        return PlannedGrasp(best.T_cloud_hand, best.score, best.width) if best else None
