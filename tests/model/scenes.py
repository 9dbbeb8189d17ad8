"""Clouds, hands and small detectors that several tests take."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.kernels import nearest_in_groups
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_model.scene.cloud import CanonicalFrame, Cloud
from edgegrasp_model.scene.scene import Scene

SEED = 2**32 - 1  # the greatest
PANDA = load_gripper("panda")
VIEW = (0.3, 0.2, 0.5)
RADIUS = 0.05
# Networks of the paper's shape, narrow enough for many examples.
TINY = {
    name: NetworkConfig(name, (8, 12, 16), (16, 20, 24), (28, 32), (24, 16), crop_radius=0.04)
    for name in ("edgegrasp", "vn-edgegrasp")
} | {"hand": NetworkConfig("hand", hand_widths=(8, 8), classifier_widths=(8, 8), crop_radius=0.04)}


@cache
def detector() -> GraspDetector:
    """A quick detector; random weights whose scores the temperature spreads."""
    metadata = CheckpointMetadata("tiny", TINY["hand"], 0.0045, "panda", temperature=0.01)
    return GraspDetector(build_network(TINY["hand"]), metadata, PANDA)


@cache
def box_on_table(
    count: int = 2000, table: bool = False, size: tuple[float, ...] = (0.04, 0.06, 0.08)
) -> np.ndarray:
    """The top and two sides of a box (metres) on z = 0, with its table if wanted."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-0.5, 0.5, (2, count))
    top = np.stack([u, v, np.full(count, 0.5)], axis=1)
    front = np.stack([np.full(count, 0.5), u, v], axis=1)
    side = np.stack([u, np.full(count, 0.5), v], axis=1)
    points = np.concatenate([top, front, side]) * size + (0, 0, size[2] / 2)
    if table:
        flat = np.stack([u * 0.5, v * 0.5, np.zeros(count)], axis=1)
        points = np.concatenate([points, flat])
    return (points + rng.normal(0, 0.0003, points.shape)).astype(np.float32)


def scene_of(points: np.ndarray, **fields: object) -> Scene:
    """A scene of one object's points (N, 3) float32, as they are sent: no plane, no obstacles."""
    every = np.ones(len(points), dtype=bool)
    plain = {"support": None, "obstacles": None} | fields
    return Scene(
        frame=CanonicalFrame(np.eye(4)),
        cloud=Cloud(points, points),
        points_in_cloud=points,
        point_of_row=np.arange(len(points)),
        approach_allowed=every,
        contact_allowed=every,
        object_of_point=np.zeros(len(points), dtype=np.int64),
        **plain,
    )


def random_hands(count: int, seed: int, reach: float = 0.2) -> np.ndarray:
    """Poses (count, 4, 4) turned at random, not further than `reach` along each axis."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-reach, reach, (count, 3))
    return poses


@dataclass(frozen=True)
class RandomScene:
    """A cloud with candidate edge grasps, as the ball networks take them."""

    points: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3)
    approach_index: np.ndarray  # (A,)
    edges: np.ndarray  # (E, 2) ball, contact row of the cloud

    @staticmethod
    def of_seed(seed: int) -> "RandomScene":
        """4 balls, some 40 edge grasps."""
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.06, 0.06, (150, 3)) * (1.0, 1.0, 0.4)
        normals = rng.normal(size=(150, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        approach_index = rng.choice(150, 4, replace=False)
        distance = np.linalg.norm(points[approach_index][:, None] - points, axis=2)  # (A, N)
        edges = np.argwhere((distance > 0.003) & (distance < 0.038))
        return RandomScene(points, normals, approach_index, edges[:: max(1, len(edges) // 40)])

    def turned(self, rotation: np.ndarray, translation: np.ndarray) -> "RandomScene":
        return replace(
            self, points=self.points @ rotation.T + translation, normals=self.normals @ rotation.T
        )

    def reordered(self, order: np.ndarray) -> "RandomScene":
        """The same scene with its point order[i] at row i."""
        row_of = np.argsort(order)
        edges = np.column_stack((self.edges[:, 0], row_of[self.edges[:, 1]]))
        return RandomScene(
            self.points[order], self.normals[order], row_of[self.approach_index], edges
        )

    def only_ball(self, ball: int) -> "RandomScene":
        edges = self.edges[self.edges[:, 0] == ball] * (0, 1)
        return replace(self, approach_index=self.approach_index[[ball]], edges=edges)

    def batch(self, dtype: torch.dtype = torch.float64) -> BallBatch:
        crop = crop_balls(self.points, self.approach_index, RADIUS)
        size = len(self.points)
        row = np.searchsorted(
            crop.ball_of_point * size + crop.ball_rows, self.edges @ np.array([size, 1])
        )
        edge = self.points[self.edges[:, 1]] - self.points[self.approach_index[self.edges[:, 0]]]
        normal = self.normals[self.edges[:, 1]]
        ahead = edge - (edge * normal).sum(axis=1, keepdims=True) * normal
        depth = np.linalg.norm(ahead, axis=1)
        centre = self.points[self.approach_index][crop.ball_of_point]
        centred = self.points[crop.ball_rows] - centre
        bounds = np.searchsorted(crop.ball_of_point, np.arange(len(self.approach_index) + 1))
        return BallBatch(
            points=torch.from_numpy(centred).to(dtype),
            normals=torch.from_numpy(self.normals[crop.ball_rows]).to(dtype),
            neighbors=torch.from_numpy(nearest_in_groups(centred, bounds, 16)),
            ball_of_point=torch.from_numpy(crop.ball_of_point),
            num_balls=len(self.approach_index),
            contact=torch.from_numpy(row),
            approach=torch.from_numpy(-ahead / depth[:, None]).to(dtype),
            depth=torch.from_numpy(depth).to(dtype),
        )
