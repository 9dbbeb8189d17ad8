import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.options import Suppression
from edgegrasp_model.ranking import non_max_suppression, ranked, rotation_distance

from .scenes import SEED


def test_the_score_decides_and_counts_half_where_the_hand_collides() -> None:
    score = np.array([0.9, 0.2, 0.95, 0.5])
    free = np.array([False, True, False, True])
    assert ranked(score, free).tolist() == [3, 2, 0, 1]
    assert ranked(score, ~free).tolist() == [2, 0, 3, 1]


def test_the_highest_of_the_sure_grasps_comes_first_then_the_others_by_score() -> None:
    score = np.array([0.95, 0.5, 0.91, 0.89, 0.99])
    height = np.array([0.1, 0.9, 0.3, 0.8, 0.2])
    free = np.array([True, True, True, True, False])
    assert ranked(score, free, "highest", height=height).tolist() == [2, 0, 3, 1, 4]
    assert ranked(score, free, "highest", height=-height).tolist() == [0, 2, 3, 1, 4]


def test_the_widest_clearance_comes_first_then_the_score_decides() -> None:
    score, clearance = np.array([0.1, 0.2, 0.9, 0.8]), np.array([0.01, 0.02, 0.01, 0.05])
    free = np.array([True, True, True, False])
    assert ranked(score, free, "clearance", clearance=clearance).tolist() == [1, 2, 0, 3]


@given(seed=st.integers(0, SEED))
def test_rotation_distance_is_the_angle_or_that_of_the_flipped_hand(seed: int) -> None:
    one, other = Rotation.random(2, rng=np.random.default_rng(seed))
    flip = Rotation.from_euler("z", np.pi)
    expected = min((one.inv() * other).magnitude(), (one.inv() * other * flip).magnitude())
    found = rotation_distance(other.as_matrix()[None], one.as_matrix())
    np.testing.assert_allclose(found, [expected], atol=1e-3)


def test_near_duplicates_fall_to_the_better_one() -> None:
    T_cloud_tcp = np.repeat(np.eye(4, dtype=np.float32)[None], 4, axis=0)
    T_cloud_tcp[1, :3, 3] = 0.005  # near the first
    T_cloud_tcp[2, 0, 3] = 0.05  # elsewhere
    T_cloud_tcp[3, :3, :3] = Rotation.from_euler("x", 1.0).as_matrix()  # turned away
    rule = Suppression(translation=0.01, rotation=0.5)
    order = np.array([1, 0, 2, 3])
    kept, dropped = non_max_suppression(T_cloud_tcp, order, rule, 10)
    assert (kept.tolist(), dropped.tolist()) == ([1, 2, 3], [0])
    assert non_max_suppression(T_cloud_tcp, order, rule, 2)[0].tolist() == [1, 2]
    none = Suppression(translation=0.0, rotation=0.0)
    kept, dropped = non_max_suppression(T_cloud_tcp, order, none, 10)
    assert (kept.tolist(), dropped.tolist()) == ([1, 0, 2, 3], [])
