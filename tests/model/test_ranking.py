"""How scores of single hands become those of an answer."""

import numpy as np

from edgegrasp_model.hand_kernels import mean_of_alike


def hands(places: list[float], turns: list[float]) -> np.ndarray:
    """Upright hands along x, turned about the approach, radians.  # (E, 4, 4)."""
    poses = np.tile(np.eye(4, dtype=np.float32), (len(places), 1, 1))
    poses[:, 0, 3] = places
    cosine, sine = np.cos(turns), np.sin(turns)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cosine, -sine, sine, cosine
    return poses


def test_hands_are_averaged_with_others_on_the_same_object_that_are_near_and_turned_alike() -> None:
    poses = hands([0.0, 0.01, 0.02, 0.1, 0.01, 0.01], [0.0, 0.1, np.pi, 0.0, 0.0, 1.0])
    logits = np.array([3.0, -1.0, -2.0, 2.0, 5.0, 7.0], dtype=np.float32)
    number = np.array([0, 0, 0, 0, 1, 0])  # the fifth is on another object
    found = mean_of_alike(logits, poses, number, 0.03, 0.5)
    np.testing.assert_allclose(found[:3], [-1.5, 0.5, 1.0], atol=1e-6)
    assert np.isnan(found[3:]).all()
