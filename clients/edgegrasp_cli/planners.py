"""Planners for clutter-removal trials that ask a grasp-detection server."""

from dataclasses import dataclass, field
from typing import Any

from edgegrasp_client import GraspClient
from edgegrasp_sim.simulation import Observation
from edgegrasp_sim.trials import PlannedGrasp

REQUEST_SECONDS = 120.0


@dataclass(frozen=True)
class ServerPlanner:
    """Asks a server for the best grasp of each observation.

    The simulator's world frame is the cloud's frame, so that T_cloud_hand is T_world_hand.
    """

    client: GraspClient
    options: dict[str, Any] = field(default_factory=dict)

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The server's best grasp; None where it finds none."""
        low, high = observation.workspace.tolist()
        detection = self.client.detect(
            observation.cloud,
            seed=seed,
            viewpoint=tuple(observation.camera_position.tolist()),
            support={"normal": (0.0, 0.0, 1.0), "offset": observation.table_height},
            workspace={"min": tuple(low), "max": tuple(high)},
            top_k=1,
            **self.options,
        )
        if not detection.grasps:
            return None
        best = detection.grasps[0]
        return PlannedGrasp(best.T_cloud_hand, best.score, best.width)


@dataclass(frozen=True)
class ServerPlannerFactory:
    """Makes a planner with a connection of its own in each worker process."""

    address: str
    options: dict[str, Any]

    def __call__(self) -> ServerPlanner:
        """A planner connected to the server."""
        return ServerPlanner(GraspClient(self.address, timeout=REQUEST_SECONDS), self.options)
