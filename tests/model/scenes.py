"""Clouds, hands and small detectors that several tests take."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_model.scene.cloud import UP, CanonicalFrame, Cloud, pose_matrix
from edgegrasp_model.scene.scene import Scene
from edgegrasp_training.recipes import build_network

SEED = 2**32 - 1  # the greatest
PANDA = load_gripper("panda")
VIEW = (0.3, 0.2, 0.5)
# Networks of the paper's shape, narrow enough for many examples.
TINY = {
    name: NetworkConfig(name, (8, 12, 16), (16, 20, 24), (28, 32), (24, 16), crop_radius=0.04)
    for name in ("edgegrasp", "vn-edgegrasp")
} | {"hand": NetworkConfig("hand", hand_widths=(8, 8), classifier_widths=(8, 8), crop_radius=0.04)}


@cache
def detector() -> GraspDetector:
    """A quick detector; random weights whose scores the temperature spreads."""
    metadata = CheckpointMetadata("tiny", TINY["hand"], 0.0045, "panda", temperature=0.01)
    return GraspDetector(build_network(TINY["hand"]), metadata)


@cache
def box_on_table(count: int = 2000, table=False, size=(0.04, 0.06, 0.08)) -> np.ndarray:
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
    plain: dict[str, object] = {
        "up": UP,
        "support": None,
        "obstacles": None,
        "viewpoints": np.empty((0, 3)),
        "at_side": ~every,
        "frame": CanonicalFrame(np.eye(4)),
        "cloud": Cloud(points, points),
        "points_in_cloud": points,
        "point_of_row": np.arange(len(points)),
        "approach_allowed": every,
        "contact_allowed": every,
        "object_of_point": np.zeros(len(points), dtype=np.int64),
    }
    return Scene(**plain | fields)


def grid(*axes: object) -> np.ndarray:
    """All points (N, 3) with these coordinates along x, y and z."""
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def random_hands(count: int, seed: int, reach: float = 0.2) -> np.ndarray:
    """Poses (count, 4, 4) turned at random, not further than `reach` along each axis."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, rng=rng).as_matrix()
    return pose_matrix(turns, rng.uniform(-reach, reach, (count, 3))).astype(np.float32)
