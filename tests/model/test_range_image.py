"""Range images of points, as the scene network reads them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from edgegrasp_model.scene.range_image import range_image

from .rendered import box, camera, render, table
from .scenes import SEED


def cloud(seed: int = 0) -> np.ndarray:
    """A table and a box as a camera at the origin sees them."""
    points = render([table(), box((0, 0, 0.05), (0.03, 0.04, 0.05))], camera(0.7, -1.5, 0.8), seed)
    flat = points.reshape(-1, 3)
    return flat[np.isfinite(flat).all(axis=1)]


@given(seed=st.integers(0, SEED))
def test_pixels_hold_points_of_the_cloud_in_the_cameras_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng), rng.uniform(-1, 1, 3)
    points = cloud()
    moved = (turn.apply(points) + shift).astype(np.float32)
    image = range_image(moved, shift, None)
    seen = image.points[np.isfinite(image.points[..., 2])]
    T = image.T_cloud_camera
    apart, _ = cKDTree(seen @ T[:3, :3].T + T[:3, 3]).query(moved)
    assert np.median(apart) < 0.004
    assert np.percentile(apart, 95) < 0.01


def test_up_is_upward_in_the_image() -> None:
    points, T_world_camera = cloud(), camera(0.7, -1.5, 0.8)
    up = T_world_camera[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    turned = Rotation.from_euler("z", 2.0).as_matrix()
    image = range_image((points @ turned.T).astype(np.float32), np.zeros(3), turned @ up)
    assert (image.T_cloud_camera[:3, 1] @ turned @ up) < -0.5  # y is downward


def test_few_points_make_a_small_image_without_gaps() -> None:
    points = cloud()
    some = points[np.random.default_rng(0).choice(len(points), 3000, replace=False)]
    image = range_image(some, np.zeros(3), None)
    assert image.points.shape[0] * image.points.shape[1] < 12_000
    seen = np.isfinite(image.points[..., 2])
    rows, columns = np.nonzero(seen)
    inner = seen[rows.min() + 8 : rows.max() - 8, columns.min() + 8 : columns.max() - 8]
    assert inner.mean() > 0.8


@pytest.mark.parametrize(
    "points",
    [np.zeros((1, 3)), np.full((50, 3), 1e-3), np.array([[0, 0, -1.0], [0, 0.1, -1.0]])],
    ids=["the camera itself", "within millimetres", "straight down"],
)
def test_points_that_make_no_picture_are_no_error(points: np.ndarray) -> None:
    image = range_image(points.astype(np.float32), np.zeros(3), None)
    assert image.points.shape[2] == 3
