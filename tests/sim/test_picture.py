"""The picture of a cloud and its grasps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from edgegrasp_sim.picture import TIP_Z, draw_grasps, fork


@dataclass(frozen=True)
class Found:
    score: float
    T_cloud_hand: NDArray[np.float32]
    width: float


def pose(x: float, y: float) -> NDArray[np.float32]:
    """A hand above (x, y) that looks straight down."""
    T = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
    T[:3, 3] = x, y, 0.2
    return T


@pytest.fixture
def cloud() -> NDArray[np.float32]:
    rng = np.random.default_rng(0)
    return rng.uniform((0.05, 0.05, 0.05), (0.25, 0.25, 0.10), (20_000, 3)).astype(np.float32)


def red_pixels(path: Path) -> int:
    from matplotlib.image import imread

    image = imread(path)
    red, green, blue = image[..., 0], image[..., 1], image[..., 2]
    return int(((red > 0.7) & (green < 0.1) & (blue < 0.1)).sum())


def test_fork_follows_the_hand() -> None:
    tips = fork(pose(0.1, 0.2), 0.08)[2:, 1]
    np.testing.assert_allclose(
        tips, [(0.1, 0.24, 0.2 - TIP_Z), (0.1, 0.16, 0.2 - TIP_Z)], atol=1e-7
    )


def test_only_a_best_grasp_is_drawn_in_red(tmp_path: Path, cloud: NDArray[np.float32]) -> None:
    path = tmp_path / "grasps.png"
    found = [Found(0.9, pose(0.1, 0.1), 0.08), Found(0.4, pose(0.2, 0.2), 0.05)]
    draw_grasps(path, cloud, found, camera_position=(0.15, 0.8, 0.6), title="two grasps")
    assert red_pixels(path) > 500
    draw_grasps(path, cloud, [], camera_position=(0.15, 0.8, 0.6), title="no grasp")
    assert red_pixels(path) == 0
