import numpy as np
import pytest

from edgegrasp_sim.camera import look_at, points_of
from edgegrasp_sim.engine import Intrinsics, World

CENTRE = np.array([0.15, 0.12, 0.10])
HALF = np.array([0.03, 0.04, 0.05])
CAMERA = Intrinsics()


def distance_to_box(points: np.ndarray) -> np.ndarray:
    outside = np.abs(points - CENTRE) - HALF
    return np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0)


@pytest.mark.parametrize(("aside", "azimuth"), [(0.5, 0.0), (0.5, 1.0), (0.5, 4.0), (0.0, 0.0)])
def test_a_box_appears_where_it_is(world: World, aside: float, azimuth: float) -> None:
    target = np.array([0.15, 0.15, 0.1])
    away = [aside * np.cos(azimuth), aside * np.sin(azimuth), 0.5]  # or straight above
    eye = target + np.array(away)
    world.add_box(2 * HALF, CENTRE, friction=0.5)
    T_world_camera = look_at(eye, target)
    points = points_of(world.render_depth(T_world_camera, CAMERA), T_world_camera, CAMERA)
    assert len(points) > 1000
    assert np.abs(distance_to_box(points)).max() < 1e-4
    # The top is seen from edge to edge, so that no pixel is shifted sideways either.
    top = points[points[:, 2] > CENTRE[2] + HALF[2] - 1e-4]
    assert top[:, :2].min(axis=0) == pytest.approx(CENTRE[:2] - HALF[:2], abs=1.5e-3)
    assert top[:, :2].max(axis=0) == pytest.approx(CENTRE[:2] + HALF[:2], abs=1.5e-3)
