import numpy as np
import pytest

from edgegrasp_model.candidates.collision import FINGER_CLEARANCE
from edgegrasp_model.ranking import objects_first, openings
from edgegrasp_model.scene.cloud import CanonicalFrame, Cloud
from edgegrasp_model.scene.scene import Scene

from .scenes import PANDA


def test_each_object_has_its_best_grasp_before_any_has_a_second() -> None:
    score = np.array([0.9, 0.8, 0.7, 0.6, 0.4, 0.3])
    number = np.array([2, 2, 1, 2, 3, 1])
    order = objects_first(np.arange(6), score, number)
    assert order.tolist() == [0, 2, 1, 3, 4, 5]  # what is on 3 is not good


@pytest.mark.parametrize(
    ("camera", "opening"),
    [
        ((1.0, 0.0, 0.1), 2 * (0.015 + FINGER_CLEARANCE)),  # sees past both sides
        ((0.0, 1.0, 0.1), PANDA.max_opening),  # sees the side of one finger alone
        (None, 2 * (0.015 + FINGER_CLEARANCE)),  # nothing is known to be hidden
    ],
)
def test_a_hand_opens_fully_where_the_far_side_is_hidden(camera, opening) -> None:
    along, height = np.meshgrid(np.arange(-0.015, 0.0155, 0.003), np.arange(0.09, 0.13, 0.003))
    flat = np.zeros_like(along)
    # A plate that faces the camera: across the closing direction y, or along it.
    axes = (along, flat + 0.015, height) if camera and camera[1] else (flat, along, height)
    points = np.stack(axes, axis=-1).reshape(-1, 3).astype(np.float32)
    every = np.ones(len(points), dtype=bool)
    scene = Scene(
        frame=CanonicalFrame(np.eye(4)),
        cloud=Cloud(points, points),
        points_in_cloud=points,
        point_of_row=np.arange(len(points)),
        approach_allowed=every,
        contact_allowed=every,
        object_of_point=np.zeros(len(points), dtype=np.int64),
        support=None,
        obstacles=None,
        viewpoint=None if camera is None else np.array(camera, dtype=np.float32),
    )
    width = openings(scene, np.eye(4, dtype=np.float32)[None], PANDA)
    np.testing.assert_allclose(width, opening, atol=1e-6)
