import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from edgegrasp_model.options import Box, OrientedBox
from edgegrasp_model.scene.cloud import CanonicalFrame
from edgegrasp_model.scene.obstacles import SolidBoxes, separation, signed_distance


def random_boxes(rng: np.random.Generator, count: int) -> SolidBoxes:
    turn = Rotation.random(count, rng=rng).as_matrix()
    extent = rng.uniform(0.01, 0.2, (count, 3))
    return SolidBoxes(rng.uniform(-0.25, 0.25, (count, 3)), extent[..., None] * turn)


def least_distance(generators: np.ndarray, offset: np.ndarray) -> float:
    """Distance of `offset` to all sums of generators, each times -1 to 1."""
    return float(np.sqrt(2 * lsq_linear(generators.T, offset, (-1, 1), tol=1e-14).cost))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_distances_of_boxes_are_those_of_a_convex_optimiser(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ours, theirs = random_boxes(rng, 8), random_boxes(rng, 8)
    way = rng.normal(scale=0.2, size=(8, 3))
    found, swept = signed_distance(ours, theirs), separation(ours, theirs, way)
    for row in range(8):
        offset = theirs.center[row] - ours.center[row]
        both = [*ours.half[row], *-theirs.half[row]]
        np.testing.assert_allclose(
            max(found[row], 0.0), least_distance(np.array(both), offset), atol=1e-6
        )
        moved = least_distance(np.array([*both, way[row] / 2]), offset - way[row] / 2)
        assert (swept[row] > 0) == (moved > 1e-7)
        assert swept[row] <= moved + 1e-9


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_boxes_moved_apart_by_their_depth_just_touch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ours, theirs = random_boxes(rng, 20), random_boxes(rng, 20)
    depth = signed_distance(ours, theirs)
    shifts = rng.normal(size=(20, 3))
    shifts /= np.linalg.norm(shifts, axis=1, keepdims=True)
    inside = depth < -1e-3
    # No shift shorter than the depth separates them.
    moved = SolidBoxes(ours.center + shifts * (np.abs(depth) * 0.99)[:, None], ours.half)
    assert (separation(moved, theirs)[inside] < 0).all()


def test_a_request_gives_boxes_in_the_canonical_frame() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)).astype(np.float32)
    frame = CanonicalFrame.of_scene(points, (0.2, 0.3, 1.0), (1.0, 2.0, 3.0))
    turn = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    tilted = OrientedBox(
        center=(0.1, 0.2, 0.3),
        half_extents=(0.01, 0.02, 0.03),
        quaternion=tuple(turn.as_quat().tolist()),
    )
    boxes = SolidBoxes.from_shapes([tilted, Box(min=(0, 0, 0), max=(0.2, 0.4, 0.6))], frame)
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
    expected = [
        turn.apply(signs * (0.01, 0.02, 0.03)) + np.array([0.1, 0.2, 0.3]),
        (signs + 1) / 2 * (0.2, 0.4, 0.6),
    ]
    for corners, want in zip(boxes.corners(), expected, strict=True):
        found = frame.points_in_cloud(corners)
        apart = np.linalg.norm(found[:, None] - want, axis=2)
        np.testing.assert_allclose(apart.min(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose(apart.min(axis=1), 0.0, atol=1e-6)


@pytest.mark.parametrize("sweep", [None, np.empty((0, 3))])
def test_no_boxes_meet_nothing(sweep: np.ndarray | None) -> None:
    none = SolidBoxes(np.empty((0, 3)), np.empty((0, 3, 3)))
    assert separation(none, none, sweep).shape == (0,)
    assert signed_distance(none, none).shape == (0,)
