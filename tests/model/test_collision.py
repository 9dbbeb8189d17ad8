"""What the open hand would hit where no camera has seen."""

import numpy as np
import pytest

from edgegrasp_model.candidates.collision import (
    collides,
)
from edgegrasp_model.options import Collision

from .scenes import PANDA, scene_of

HAND = np.eye(4, dtype=np.float32)[None]


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
