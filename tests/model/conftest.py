"""Random clouds with candidate edge grasps, as the networks take them; a small detector."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.balls import BallBatch, nearest_in_ball
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig

RADIUS = 0.05


@dataclass(frozen=True)
class Scene:
    points: NDArray[np.float64]  # (N, 3)
    normals: NDArray[np.float64]  # (N, 3)
    approach_index: NDArray[np.int64]  # (A,)
    edges: NDArray[np.int64]  # (E, 2) ball, contact row of the cloud

    def turned(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> "Scene":
        return replace(
            self, points=self.points @ rotation.T + translation, normals=self.normals @ rotation.T
        )

    def reordered(self, order: NDArray[np.int64]) -> "Scene":
        """The same scene with its point order[i] at row i."""
        row_of = np.argsort(order)
        return Scene(
            self.points[order],
            self.normals[order],
            row_of[self.approach_index],
            np.column_stack((self.edges[:, 0], row_of[self.edges[:, 1]])),
        )

    def only_ball(self, ball: int) -> "Scene":
        edges = self.edges[self.edges[:, 0] == ball]
        return replace(
            self,
            approach_index=self.approach_index[[ball]],
            edges=np.column_stack((np.zeros(len(edges), dtype=np.int64), edges[:, 1])),
        )

    def batch(self, dtype: torch.dtype = torch.float64) -> BallBatch:
        crop = crop_balls(self.points, self.approach_index, RADIUS)
        row_of = {
            (int(ball), int(row)): place
            for place, (ball, row) in enumerate(
                zip(crop.ball_of_point, crop.ball_rows, strict=True)
            )
        }
        contact = np.array([row_of[int(ball), int(row)] for ball, row in self.edges], dtype=int)
        edge = self.points[self.edges[:, 1]] - self.points[self.approach_index[self.edges[:, 0]]]
        normal = self.normals[self.edges[:, 1]]
        ahead = edge - (edge * normal).sum(axis=1, keepdims=True) * normal
        depth = np.linalg.norm(ahead, axis=1)
        centre = self.points[self.approach_index][crop.ball_of_point]
        return BallBatch(
            points=torch.from_numpy(self.points[crop.ball_rows] - centre).to(dtype),
            normals=torch.from_numpy(self.normals[crop.ball_rows]).to(dtype),
            neighbors=torch.from_numpy(nearest_in_ball(self.points, self.approach_index, crop)),
            ball_of_point=torch.from_numpy(crop.ball_of_point),
            num_balls=len(self.approach_index),
            contact=torch.from_numpy(contact),
            approach=torch.from_numpy(-ahead / depth[:, None]).to(dtype),
            depth=torch.from_numpy(depth).to(dtype),
        )


def _random_scene(seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.06, 0.06, (150, 3)) * (1.0, 1.0, 0.4)
    normals = rng.normal(size=(150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    approach_index = rng.choice(150, 4, replace=False)
    distance = np.linalg.norm(points[approach_index][:, None] - points, axis=2)  # (A, N)
    edges = np.argwhere((distance > 0.003) & (distance < 0.038))
    return Scene(points, normals, approach_index, edges[:: max(1, len(edges) // 40)])


@pytest.fixture(scope="session")
def random_scene() -> Callable[[int], Scene]:
    """Makes a random scene from a seed: 4 balls, some 40 edge grasps."""
    return _random_scene


@pytest.fixture(scope="session")
def tiny_config() -> NetworkConfig:
    """A network of the paper's shape, narrow enough for many examples."""
    return NetworkConfig(
        architecture="edgegrasp",
        conv_widths=(8, 12, 16),
        global_widths_1=(16, 20, 24),
        global_widths_2=(28, 32),
        classifier_widths=(24, 16),
    )


@pytest.fixture(scope="session")
def plus() -> GraspDetector:
    """A quick detector that scores from the hand's frame; random weights spread the scores."""
    config = NetworkConfig(
        architecture="hand", hand_widths=(8, 8), classifier_widths=(8, 8), crop_radius=0.04
    )
    metadata = CheckpointMetadata(
        "tiny", config, voxel_size=0.0045, gripper="panda", temperature=0.01
    )
    network = build_network(config, torch.Generator().manual_seed(0))
    return GraspDetector(network, metadata, load_gripper("panda"))


def _box_on_table(seed: int = 0, count: int = 4000, table: bool = False) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.5, 0.5, (2, count))
    top = np.stack([u, v, np.full(count, 0.5)], axis=1)
    front = np.stack([np.full(count, 0.5), u, v], axis=1)
    side = np.stack([u, np.full(count, 0.5), v], axis=1)
    points = np.concatenate([top, front, side]) * (0.04, 0.06, 0.08) + (0, 0, 0.04)
    if table:
        flat = np.stack([u * 0.5, v * 0.5, np.zeros(count)], axis=1)
        points = np.concatenate([points, flat])
    return (points + rng.normal(0, 0.0003, points.shape)).astype(np.float32)


@pytest.fixture(scope="session")
def box_on_table() -> Callable[..., NDArray[np.float32]]:
    """Makes the top and two sides of a 40 x 60 x 80 mm box on z = 0, with its table if wanted."""
    return _box_on_table
