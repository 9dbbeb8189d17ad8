"""Grasps across an outline: from above and from the camera, where no side of an object is seen."""

import numpy as np
import pytest

from edgegrasp_model.candidates.edge_grasps import Candidates, crop_balls, support_clearance
from edgegrasp_model.candidates.outline import (
    CLEARANCE,
    MAX_INSERTION,
    outline_grasps,
    outlines,
)
from edgegrasp_model.options import DetectOptions, SupportPlane

from .scenes import PANDA, detector

FLOOR = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.0)
TOP = 0.3  # metres
FIFTEEN_DEGREES = np.cos(np.radians(15.0))
CONTACT_TO_TIP = PANDA.tip_z - PANDA.contact_z


def level(width: float, length: float, height: float, turn: float = 0.0) -> np.ndarray:
    """A level rectangle seen from above: a point every 4 mm, sampled in its own axes."""
    sides = [np.linspace(-side / 2, side / 2, round(side / 0.004) + 1) for side in (width, length)]
    x, y = (grid.ravel() for grid in np.meshgrid(*sides))
    cosine, sine = np.cos(turn), np.sin(turn)
    points = np.stack([cosine * x - sine * y, sine * x + cosine * y, 0 * x + height], axis=1)
    return points + np.random.default_rng(0).normal(0.0, 0.0003, points.shape)


def ring(radius: float, height: float) -> np.ndarray:
    """The rim of a bowl, two points wide."""
    turn = np.linspace(0, 2 * np.pi, round(2 * np.pi * radius / 0.004), endpoint=False)
    rows = [
        [r * np.cos(turn), r * np.sin(turn), 0 * turn + height] for r in (radius, radius + 0.004)
    ]
    return np.concatenate([np.transpose(row) for row in rows])


def grasps_of(
    points: np.ndarray, viewpoint: np.ndarray | None = None, view: int = 0
) -> tuple[np.ndarray, Candidates]:
    """Grasps across one of a cloud's outlines, around every fourth point."""
    points = points.astype(np.float32)
    approach = np.arange(0, len(points), 4)
    crop = crop_balls(points, approach, 0.045)
    seen = outlines(points, None if viewpoint is None else viewpoint[None], np.arange(len(points)))[
        view
    ]
    every = np.arange(len(crop.ball_rows))
    return points, outline_grasps(points, crop, approach, every, seen, FLOOR, PANDA)


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_a_box_seen_straight_from_above_is_grasped_across_its_edges(turn: float) -> None:
    viewpoint = (0.0, 0.0, 0.9)
    options = DetectOptions(support=FLOOR, viewpoint=viewpoint, suppression=None, top_k=500)
    found = detector().detect(level(0.05, 0.12, TOP, turn), options)
    straight = [g for g in found.grasps if g.T_cloud_hand[2, 2] == -1.0]
    assert len(straight) > 20
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    for grasp in straight:
        assert grasp.collision_free
        assert grasp.T_cloud_hand[2, 1] == 0.0  # closes level
    aligned = [g for g in straight if abs(g.T_cloud_hand[:3, 1] @ across) > FIFTEEN_DEGREES]
    assert len(aligned) > 0.8 * len(straight)
    for grasp in aligned:
        assert abs(grasp.T_cloud_tcp[:3, 3] @ across) < 0.004
        assert abs(abs(grasp.contact_point @ across) - 0.025) < 0.005


def test_nothing_is_taken_across_a_box_wider_than_the_hand_opens() -> None:
    _, hands = grasps_of(level(0.085, 0.12, TOP))
    assert len(hands) == 0


def test_the_hand_goes_in_until_something_is_ahead_of_it() -> None:
    _, alone = grasps_of(level(0.05, 0.12, TOP))
    deepest = TOP - CONTACT_TO_TIP - MAX_INSERTION
    np.testing.assert_allclose(tips(alone), deepest, atol=0.002)

    step = level(0.30, 0.30, TOP - 0.015)  # lower, on all sides
    high_step = level(0.30, 0.30, TOP - 0.003)
    points, beside = grasps_of(np.concatenate([level(0.05, 0.12, TOP), step]))
    on_top = points[beside.contact_index, 2] > TOP - 0.005
    assert on_top.sum() > 20
    np.testing.assert_allclose(tips(beside)[on_top], TOP - 0.015 + CLEARANCE, atol=0.002)

    points, shallow = grasps_of(np.concatenate([level(0.05, 0.12, TOP), high_step]))
    assert (points[shallow.contact_index, 2] < TOP - 0.002).all()  # of the step's own outline

    _, low = grasps_of(level(0.05, 0.12, 0.012))
    assert len(low) > 20
    clearance = support_clearance(low.T_cloud_hand, FLOOR, PANDA)
    np.testing.assert_allclose(clearance, 0.0, atol=1e-5)


def tips(hands: Candidates) -> np.ndarray:
    return hands.T_cloud_hand[:, 2, 3] + PANDA.tip_z * hands.T_cloud_hand[:, 2, 2]


def test_a_rim_is_taken_across_its_wall() -> None:
    points, hands = grasps_of(ring(0.07, TOP))
    assert len(hands) > 20
    contact = points[hands.contact_index]
    radial = contact / np.linalg.norm(contact * (1, 1, 0), axis=1, keepdims=True)
    closing = np.abs(np.einsum("ed,ed->e", hands.T_cloud_hand[:, :3, 1], radial))
    assert np.mean(closing > FIFTEEN_DEGREES) > 0.9
    distance = np.linalg.norm(hands.T_cloud_hand[:, :2, 3], axis=1)
    np.testing.assert_allclose(distance, 0.072, atol=0.003)


def test_two_objects_side_by_side_are_taken_one_at_a_time() -> None:
    each = level(0.03, 0.06, TOP)
    shift = np.array([0.045, 0.0, 0.0])
    _, hands = grasps_of(np.concatenate([each - shift, each + shift]))
    across = hands.T_cloud_hand[np.abs(hands.T_cloud_hand[:, 0, 1]) > 0.9]
    assert len(across) > 5
    np.testing.assert_allclose(np.abs(across[:, 0, 3]), 0.045, atol=0.003)


def test_hands_also_come_from_a_camera_at_the_side() -> None:
    viewpoint = np.array([0.5, 0.0, 0.5 + TOP])
    points, hands = grasps_of(level(0.05, 0.12, TOP), viewpoint, view=1)
    assert len(hands) > 10
    toward = viewpoint - points[hands.contact_index]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    np.testing.assert_allclose(hands.approach, toward, atol=1e-5)
    above = viewpoint * (0, 0, 1) + (0.05, 0, 0)
    _, none = grasps_of(level(0.05, 0.12, TOP), above, view=1)
    assert len(none) == 0  # it sees what is seen from above
