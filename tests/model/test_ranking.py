import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.options import Suppression
from edgegrasp_model.ranking import non_max_suppression, objects_first, rotation_distance

from .scenes import SEED


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


def test_each_object_has_its_best_grasp_before_any_has_a_second() -> None:
    score = np.array([0.9, 0.8, 0.7, 0.6, 0.4, 0.3])
    number = np.array([2, 2, 1, 2, 3, 1])
    order = objects_first(np.arange(6), score, number)
    assert order.tolist() == [0, 2, 1, 3, 4, 5]  # what is on 3 is not good
