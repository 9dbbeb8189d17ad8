"""Grasps across an outline: seen from straight above, where no side of an object is seen."""

import numpy as np
import pytest

from edgegrasp_model.options import DetectOptions, SupportPlane
from edgegrasp_results import Grasp

from .rendered import box, camera, render, table
from .scenes import detector

TOP = 0.3  # metres
FIFTEEN_DEGREES = np.cos(np.radians(15.0))


def level(width: float, length: float, turn: float) -> np.ndarray:
    """A level rectangle seen from above: a point every 4 mm, sampled in its own axes."""
    sides = [np.linspace(-side / 2, side / 2, round(side / 0.004) + 1) for side in (width, length)]
    x, y = (grid.ravel() for grid in np.meshgrid(*sides))
    cosine, sine = np.cos(turn), np.sin(turn)
    points = np.stack([cosine * x - sine * y, sine * x + cosine * y, 0 * x + TOP], axis=1)
    return points + np.random.default_rng(0).normal(0.0, 0.0003, points.shape)


def ring(radius: float) -> np.ndarray:
    """The rim of a bowl, two points wide."""
    turn = np.linspace(0, 2 * np.pi, round(2 * np.pi * radius / 0.004), endpoint=False)
    rows = [[r * np.cos(turn), r * np.sin(turn), 0 * turn + TOP] for r in (radius, radius + 0.004)]
    return np.concatenate([np.transpose(row) for row in rows])


def straight_down(points: np.ndarray) -> list[Grasp]:
    """The grasps whose hand moves straight down."""
    floor = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.0)
    viewpoint = (0.0, 0.0, 0.9)
    options = DetectOptions(support=floor, viewpoint=viewpoint, suppression=None, top_k=500)
    found = detector().detect(points.astype(np.float32), options)
    return [grasp for grasp in found.grasps if grasp.T_cloud_hand[2, 2] == -1.0]


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_a_box_is_grasped_across_its_edges(turn: float) -> None:
    straight = straight_down(level(0.05, 0.12, turn))
    assert len(straight) > 20
    assert all(grasp.collision_free for grasp in straight)
    assert all(grasp.T_cloud_hand[2, 1] == 0.0 for grasp in straight)  # closes level
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    aligned = [g for g in straight if abs(g.T_cloud_hand[:3, 1] @ across) > FIFTEEN_DEGREES]
    assert len(aligned) > 0.8 * len(straight)
    for grasp in aligned:
        assert abs(grasp.T_cloud_tcp[:3, 3] @ across) < 0.006
        assert abs(abs(grasp.contact_point @ across) - 0.025) < 0.005


def test_a_rim_is_grasped_across_its_wall() -> None:
    straight = straight_down(ring(0.07))
    assert len(straight) > 20
    contact = np.array([grasp.contact_point for grasp in straight]) * (1, 1, 0)
    radial = contact / np.linalg.norm(contact, axis=1, keepdims=True)
    hands = np.array([grasp.T_cloud_hand for grasp in straight])
    closing = np.abs(np.einsum("ed,ed->e", hands[:, :3, 1], radial))
    assert np.mean(closing > FIFTEEN_DEGREES) > 0.9
    distance = np.linalg.norm(hands[:, :2, 3], axis=1)
    np.testing.assert_allclose(distance, 0.072, atol=0.003)


def test_a_network_of_edges_gets_edge_grasps_where_they_are_good(catalogue) -> None:
    box_on_table = render([table(), box((0, 0, 0.05), (0.02, 0.03, 0.05))], camera(0.7, -1.5, 0.7))
    found = catalogue.get("edgegrasp-small").detect(box_on_table, DetectOptions(top_k=100))
    assert found.grasps
    for grasp in found.grasps:  # the approach point lies on the hand's axis
        from_hand = np.linalg.inv(grasp.T_cloud_hand) @ np.append(grasp.approach_point, 1.0)
        assert np.abs(from_hand[:2]).max() < 1e-4
