"""What the open hand hits; PyBullet, which knows nothing of ours, has to agree."""

import numpy as np
import pytest

from edgegrasp_model.candidates.collision import (
    collides,
    hits_cloud,
)
from edgegrasp_model.hand_view import APPROACH_LENGTH
from edgegrasp_model.options import Collision
from edgegrasp_model.scene.cloud import Cloud

from .scenes import PANDA, scene_of

HAND = np.eye(4, dtype=np.float32)[None]


def cloud_of(*points: tuple[float, float, float]) -> Cloud:
    return Cloud(np.array(points, np.float32), np.zeros((len(points), 3), np.float32))


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


@pytest.mark.parametrize(
    ("camera", "blocked"),
    [((-0.6, 0.0, 0.0), True), ((0.6, 0.0, 0.0), False), (None, False)],
    ids=["in front of the plate", "behind it, with the hand", "unknown"],
)
def test_a_palm_in_space_that_no_camera_saw_counts_as_colliding(camera, blocked) -> None:
    y, z = np.meshgrid(np.arange(-0.2, 0.2, 0.004), np.arange(-0.2, 0.3, 0.004))
    plate = np.stack([np.full_like(y, -0.1), y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    viewpoints = None if camera is None else np.array([camera], dtype=np.float32)
    behind = scene_of(plate, viewpoints=viewpoints)
    assert collides(behind, HAND, PANDA, Collision()).tolist() == [blocked]
