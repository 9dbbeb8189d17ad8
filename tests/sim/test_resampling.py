from __future__ import annotations

import numpy as np
import pytest

from edgegrasp_sim.camera import WORKSPACE, Camera, look_at, resample_surfaces
from edgegrasp_sim.engine import World
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.simulation import ClutterSimulation

CENTRE = np.array([0.15, 0.12, 0.10])
HALF = np.array([0.03, 0.04, 0.05])
VOXEL = 0.002
EYE = np.array([0.15, -0.55, 0.30])  # the front is seen face to face, the top aslant


def seen_box() -> tuple[np.ndarray, np.ndarray]:
    """The points of a box's pixels, and those of its resampled surfaces."""
    with World() as world:
        world.add_box(2 * HALF, CENTRE, lateral_friction=0.5)
        camera = Camera(world)
        T_world_camera = look_at(EYE, CENTRE)
        depth = camera.render_depth(T_world_camera)
        pixels = camera.points(depth, T_world_camera)
        box = np.stack((CENTRE - HALF, CENTRE + HALF))
        return pixels, resample_surfaces(depth, T_world_camera, camera.intrinsics, box, VOXEL)


def per_area(points: np.ndarray) -> tuple[float, float]:
    """Points per square millimetre on the front and on the top, away from the edges."""
    inner = np.abs(points - CENTRE) < HALF - 0.01
    front = inner[:, 0] & inner[:, 2] & (points[:, 1] < CENTRE[1] - HALF[1] + 0.005)
    top = inner[:, 0] & inner[:, 1] & (points[:, 2] > CENTRE[2] + HALF[2] - 0.005)
    return front.sum() / (40 * 80), top.sum() / (40 * 60)


def test_surfaces_are_as_dense_aslant_as_face_to_face() -> None:
    pixels, resampled = seen_box()
    front, top = per_area(pixels)
    assert front > 2.5 * top > 0
    for density in per_area(resampled):
        assert density == pytest.approx(1 / (1000 * VOXEL) ** 2, rel=0.2)


def test_points_lie_on_the_surface() -> None:
    _, points = seen_box()
    assert len(points) > 1000
    outside = np.abs(points - CENTRE) - HALF
    distance = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(1), 0.0)
    assert np.quantile(np.abs(distance), 0.95) < 0.5 * VOXEL
    assert abs(np.median(distance)) < 0.2 * VOXEL


def test_an_observation_may_be_resampled() -> None:
    with ClutterSimulation() as simulation:
        simulation.reset(SceneKind.PACKED, np.random.default_rng(0), 3)
        (plain, again, resampled) = (
            simulation.observe(
                np.random.default_rng(1), np.random.default_rng(2), surface_voxel=voxel
            )
            for voxel in (0.0, VOXEL, VOXEL)
        )
    np.testing.assert_array_equal(again.cloud, resampled.cloud)
    assert len(resampled.cloud) != len(plain.cloud)
    assert ((resampled.cloud >= WORKSPACE[0]) & (resampled.cloud <= WORKSPACE[1])).all()
    assert len(resampled.view_ids) == len(resampled.cloud)
