"""What speed is measured on: clouds of the simulator, detectors with random weights, requests."""

import numpy as np

from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_model.options import DetectOptions
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.observation import Observation
from edgegrasp_sim.simulation import ClutterSimulation

VOXEL_SIZE = 0.0045  # metres


def observe(kind: SceneKind = SceneKind.PILE, views: int = 2) -> Observation:
    """A scene of the built-in objects; a pile seen from two sides has some 15,000 points."""
    with ClutterSimulation() as simulation:
        simulation.reset(kind, np.random.default_rng(1))
        streams = np.random.default_rng(1), np.random.default_rng(2)
        return simulation.observe(*streams, num_views=views)


def detector(config: NetworkConfig) -> GraspDetector:
    """A detector with random weights, which cost what trained ones cost."""
    metadata = CheckpointMetadata("random", config, VOXEL_SIZE, "panda")
    return GraspDetector(build_network(config), metadata, load_gripper())


def request(
    observation: Observation, num_approach_points: int = 32, num_candidates: int = 2000
) -> DetectOptions:
    """A request where the table is known."""
    return DetectOptions(
        num_approach_points=num_approach_points,
        num_candidates=num_candidates,
        viewpoint=tuple(observation.camera_position.tolist()),
        support={"normal": (0.0, 0.0, 1.0), "offset": observation.table_height},
    )
