import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.options import RansacPlane, SupportPlane
from edgegrasp_model.scene.support import find_support_plane


def table(rng: np.random.Generator, share: float = 0.5, count: int = 3000) -> np.ndarray:
    """A noisy table at z = 0.1 with a crowded box on it and things in the air."""
    flat = rng.uniform(-0.3, 0.3, (int(count * share), 3)) * (1, 1, 0)
    box = rng.uniform(-0.05, 0.05, (count - len(flat), 3)) + np.array([0, 0, 0.05])
    box[: len(box) // 2, 2] = 0.1  # its top: level too, and more crowded than the table
    points = np.concatenate([flat, box]) + rng.normal(0, 0.001, (count, 3))
    return (points + np.array([0, 0, 0.1])).astype(np.float32)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.3, 0.9))
def test_the_table_is_found_in_any_frame(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng), rng.uniform(-1, 1, 3)
    points = (turn.apply(table(rng, share)) + shift).astype(np.float32)
    up = turn.apply([0.1, 0.0, 1.0])  # need not be exact
    plane = find_support_plane(points, RansacPlane(), up, np.random.default_rng(seed))
    assert plane is not None
    normal = turn.apply([0, 0, 1])
    assert np.dot(plane.normal, normal) > np.cos(0.01)
    assert abs(plane.heights(shift[None] + 0.1 * normal)[0]) < 0.001


def test_the_same_seed_finds_the_same_plane() -> None:
    points = table(np.random.default_rng(0))
    planes = [
        find_support_plane(points, RansacPlane(), (0, 0, 1), np.random.default_rng(5))
        for _ in range(2)
    ]
    assert planes[0] == planes[1]


@pytest.mark.parametrize(
    "request_",
    [RansacPlane(max_tilt=0.3), RansacPlane(min_share=0.95, max_tilt=1.6)],
    ids=["too steep", "too small"],
)
def test_a_plane_that_is_too_steep_or_too_small_is_none(request_: RansacPlane) -> None:
    rng = np.random.default_rng(1)
    wall = rng.uniform(-0.3, 0.3, (2000, 3)) * (1, 0, 1)  # plane y = 0
    cloud = rng.uniform(-0.3, 0.3, (1000, 3))
    points = np.concatenate([wall, cloud]).astype(np.float32)
    assert find_support_plane(points, request_, (0, 0, 1), rng) is None


def test_a_steep_plane_is_found_where_it_may_be_steep() -> None:
    rng = np.random.default_rng(1)
    wall = (rng.uniform(-0.3, 0.3, (2000, 3)) * (1, 0, 1)).astype(np.float32)
    plane = find_support_plane(wall, RansacPlane(max_tilt=1.6), (0, 0.1, 1), rng)
    assert plane is not None
    np.testing.assert_allclose(plane.normal, (0, 1, 0), atol=1e-4)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 10])
def test_a_handful_of_points_or_one_point_many_times_is_no_plane(count: int) -> None:
    rng = np.random.default_rng(0)
    same = np.zeros((count, 3), np.float32)
    assert find_support_plane(same, RansacPlane(), (0, 0, 1), rng) is None


def test_heights_are_over_the_plane() -> None:
    plane = SupportPlane(normal=(0.0, 0.6, 0.8), offset=0.5)
    np.testing.assert_allclose(plane.heights(np.array([[9.0, 0.0, 0.0], [0, 3, 4]])), [-0.5, 4.5])
