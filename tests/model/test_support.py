"""Support planes that are found, and depths that a known one corrects."""

import numpy as np
import pytest

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import parse_options
from edgegrasp_model.scene.cloud import check_cloud
from edgegrasp_model.scene.scene import build_scene, select_points
from edgegrasp_model.scene.segment import FIXED, Segmentation
from edgegrasp_model.scene.support import Seen, choose_support

CAMERA = np.array([0.0, -0.5, 0.4])
PLANE = {"normal": (0.0, 0.0, 1.0), "offset": 0.05, "max_depth_error": 0.12}


def scene(rng: np.random.Generator, table: int = 2000, on_table: int = 1000) -> np.ndarray:
    """A table at z = 0.05, and on it a box with a level lid 0.06 above."""
    flat = rng.uniform(-0.15, 0.15, (table, 3)) * (1, 1, 0)
    box = rng.uniform(-0.05, 0.05, (on_table, 3)) + np.array([0, 0, 0.05])
    box[: on_table // 2, 2] = 0.06
    points = np.concatenate([flat, box]) + np.array([0, 0, 0.05])
    return points + rng.normal(0, 0.001, points.shape)


@pytest.mark.parametrize("seed", range(4))
def test_the_floor_of_a_bin_counts_and_not_the_table_beside_it(seed: int) -> None:
    """Its floor is 12 mm over a table that is seen to one side, with as many points."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform((-0.2, -0.15, 0.012), (0.2, 0.15, 0.012), (4000, 3))
    table = rng.uniform((0.22, -0.3, 0.0), (0.6, 0.3, 0.0), (4000, 3))
    held = rng.uniform((-0.04, -0.04, 0.02), (0.04, 0.04, 0.06), (500, 3))
    points = np.concatenate([floor, table, held])
    points = (points + rng.normal(0, 0.001, points.shape)).astype(np.float32)
    number = np.repeat([FIXED, 0], [8000, 500])
    up, of_object = np.array([0.0, 0.0, 1.0]), (number == 0).astype(np.float32)
    shown = Segmentation(number, of_object, 1 - of_object, np.ones(1), up)
    seen, inside = Seen(points, np.array([0.0, -0.5, 0.8])), np.ones(len(points), dtype=bool)
    found = choose_support(seen, inside, shown, number == 0, parse_options({}), [])
    assert found is not None
    assert np.abs(found.plane.heights(floor[np.abs(floor[:, 0]) < 0.1])).max() < 0.001


def seen(points: np.ndarray, factor: float, camera: np.ndarray = CAMERA) -> np.ndarray:
    """The points as a camera sees them whose depths are wrong by a factor."""
    return (camera + factor * (points - camera)).astype(np.float32)


def built(points: np.ndarray, **support: object) -> tuple[np.ndarray, list[str]]:
    """What is left above the plane, in the cloud's frame, and the warnings."""
    warnings: list[str] = []
    workspace = {"min": (-0.15, -0.15, 0.055), "max": (0.15, 0.15, 0.3)}
    where = {"viewpoint": CAMERA.tolist(), "workspace": workspace, "objects": "off"}
    options = parse_options({"support": PLANE | support} | where)
    selected = select_points(check_cloud(points.astype(np.float32)), options, {}, warnings)
    found = build_scene(selected, options, 0.004, {})
    assert found is not None
    return found.points_in_cloud, warnings


def test_a_scene_is_the_same_after_wrong_depths_where_that_is_asked_for() -> None:
    points = scene(np.random.default_rng(4))
    (right, quiet), (corrected, said) = built(points), built(seen(points, 1.06))
    assert (len(quiet), len(said)) == (0, 1)
    assert abs(len(right) - len(corrected)) < 0.05 * len(right)
    np.testing.assert_allclose(right.max(axis=0), corrected.max(axis=0), atol=0.004)
    np.testing.assert_allclose(right.min(axis=0), corrected.min(axis=0), atol=0.004)
    wrong, quiet = built(seen(points, 1.06), max_depth_error=0.0)
    assert quiet == []
    assert abs(wrong[:, 2].max() - right[:, 2].max()) > 0.008


def test_a_table_that_was_cut_away_is_missed() -> None:
    points = scene(np.random.default_rng(5), table=0)[500:]
    _, warnings = built(points[points[:, 2] > 0.08])
    assert len(warnings) == 1
    assert "options.support.max_depth_error (0.12)" in warnings[0]


def test_depths_need_a_camera() -> None:
    cloud = check_cloud(scene(np.random.default_rng(7)).astype(np.float32))
    with pytest.raises(InvalidRequest) as caught:
        select_points(cloud, parse_options({"support": PLANE}), {}, [])
    assert caught.value.field == "options.viewpoint"
