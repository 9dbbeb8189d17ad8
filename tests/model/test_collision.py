import numpy as np
import pytest

from edgegrasp_model.candidates.collision import FINGER_CLEARANCE, hits_cloud, required_openings
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_view import APPROACH_LENGTH, hand_views, reach_of
from edgegrasp_model.options import Collision
from edgegrasp_model.scene.cloud import Cloud

PANDA = load_gripper()
HAND = np.eye(4, dtype=np.float32)[None]


def cloud_of(*points: tuple[float, float, float]) -> Cloud:
    return Cloud(np.array(points, np.float32), np.zeros((len(points), 3), np.float32))


def seen(*points: tuple[float, float, float]):
    return hand_views(cloud_of(*points), HAND, reach_of(PANDA))


@pytest.mark.parametrize(
    ("point", "hits"),
    [
        ((0.0, 0.0, 0.10), False),  # between the fingers
        ((0.0, 0.05, 0.10), True),  # in a finger
        ((0.0, -0.05, 0.10), True),  # in the other
        ((0.0, 0.05, 0.12), False),  # ahead of the tips
        ((0.02, 0.05, 0.10), False),  # beside a finger
        ((0.0, 0.0, 0.06), True),  # in the palm
        ((0.0, 0.1, 0.0), True),  # in the hand
        ((0.0, 0.1, -0.05), True),  # where the hand passes on its way
        ((0.0, 0.1, -0.026 - APPROACH_LENGTH - 0.001), False),  # before it starts
        ((0.0, 0.07, 0.08), False),  # outside of a finger
    ],
)
def test_a_point_hits_the_hand_or_its_way(point: tuple[float, float, float], hits: bool) -> None:
    assert hits_cloud(cloud_of(point), HAND, PANDA, Collision()).tolist() == [hits]


def test_the_width_is_what_lies_between_the_fingers_and_clearance() -> None:
    width = required_openings(
        seen((0.0, 0.012, 0.10), (0.0, -0.02, 0.09), (0.0, 0.03, 0.12)), PANDA
    )
    np.testing.assert_allclose(width, 2 * (0.02 + FINGER_CLEARANCE), atol=1e-6)
    assert required_openings(seen((0.0, 0.039, 0.10)), PANDA)[0] == np.float32(PANDA.max_opening)


def test_views_of_some_hands_are_those_of_all_taken() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.15, (300, 3)).astype(np.float32)
    cloud = Cloud(points, np.zeros_like(points))
    hands = np.repeat(HAND, 9, axis=0)
    hands[:, :3, 3] = rng.uniform(-0.05, 0.05, (9, 3))
    rows = np.array([1, 4, 8])
    taken, direct = (
        hand_views(cloud, hands, reach_of(PANDA)).take(rows),
        hand_views(cloud, hands[rows], reach_of(PANDA)),
    )
    np.testing.assert_array_equal(taken.candidate, direct.candidate)
    np.testing.assert_array_equal(taken.row, direct.row)
    np.testing.assert_allclose(taken.position, direct.position, atol=1e-6)
