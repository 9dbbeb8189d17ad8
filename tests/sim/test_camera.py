from __future__ import annotations

import numpy as np
import pytest

from edgegrasp_sim.camera import EVALUATION_VIEWS, TRAINING_VIEWS, Camera, ViewRange, look_at
from edgegrasp_sim.engine import World

CENTRE = np.array([0.15, 0.12, 0.10])
HALF = np.array([0.03, 0.04, 0.05])


def distance_to_box(points: np.ndarray) -> np.ndarray:
    outside = np.abs(points - CENTRE) - HALF
    return np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0)


@pytest.mark.parametrize("azimuth", [0.0, 1.0, 2.5, 4.0])
def test_a_box_appears_where_it_is(azimuth: float) -> None:
    eye = np.array([0.15 + 0.5 * np.cos(azimuth), 0.15 + 0.5 * np.sin(azimuth), 0.6])
    with World() as world:
        world.add_box(2 * HALF, CENTRE, lateral_friction=0.5)
        camera = Camera(world)
        T_world_camera = look_at(eye, np.array([0.15, 0.15, 0.1]))
        points = camera.points(camera.render_depth(T_world_camera), T_world_camera)
    assert len(points) > 1000
    assert np.abs(distance_to_box(points)).max() < 1e-4
    # The top is seen from edge to edge, so that no pixel is shifted sideways either.
    top = points[points[:, 2] > CENTRE[2] + HALF[2] - 1e-4]
    assert top[:, :2].min(axis=0) == pytest.approx(CENTRE[:2] - HALF[:2], abs=1.5e-3)
    assert top[:, :2].max(axis=0) == pytest.approx(CENTRE[:2] + HALF[:2], abs=1.5e-3)


def test_depth_is_measured_along_the_line_of_sight() -> None:
    with World() as world:
        world.add_box((4.0, 4.0, 0.02), (0.0, 0.0, -0.01), lateral_friction=0.5)
        camera = Camera(world)
        depth = camera.render_depth(look_at(np.array([0.5, 0.0, 0.5]), np.zeros(3)))
    assert depth[240, 320] == pytest.approx(np.sqrt(0.5), abs=2e-3)
    # Further up in the image the plane is further away.
    assert depth[120, 320] > depth[240, 320] > depth[360, 320]


def test_an_empty_world_shows_nothing() -> None:
    with World() as world:
        camera = Camera(world)
        T_world_camera = look_at(np.array([0.5, 0.0, 0.5]), np.zeros(3))
        assert camera.points(camera.render_depth(T_world_camera), T_world_camera).shape == (0, 3)


@pytest.mark.parametrize("views", [EVALUATION_VIEWS, TRAINING_VIEWS])
def test_views_stay_in_their_range_and_look_at_the_target(views: ViewRange) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        T_world_camera = views.sample(rng)
        sight = np.asarray(views.target) - T_world_camera[:3, 3]
        radius = np.linalg.norm(sight)
        assert views.radius[0] <= radius <= views.radius[1]
        polar = np.arccos(-sight[2] / radius)
        assert views.polar_angle[0] - 1e-9 <= polar <= views.polar_angle[1] + 1e-9
        assert T_world_camera[:3, 2] == pytest.approx(sight / radius)
        assert np.linalg.det(T_world_camera[:3, :3]) == pytest.approx(1.0)
        assert T_world_camera[2, 1] < 0  # the image's y points down in the world


def test_a_vertical_line_of_sight_is_refused() -> None:
    with pytest.raises(ValueError, match="slanted line of sight"):
        look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))
