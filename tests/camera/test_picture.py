import io
import itertools
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from edgegrasp_camera.clouds import CloudInput
from edgegrasp_camera.depth import Intrinsics, unproject
from edgegrasp_camera.picture import Camera, Picture, draw_detection, fork


def pixels(written: io.BytesIO) -> np.ndarray:
    with Image.open(written) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def test_the_nearest_point_is_seen_at_a_pixel() -> None:
    view = Camera((3, 3), 1.0, 1.0, 1.0, 1.0)
    points = [(0.0, 0.0, 2.0), (0.0, 0.0, 1.0), (np.nan, 0.0, 1.0), (0.0, 0.0, -1.0)]
    assert view.rows_of_pixels(points)[1, 1] == 1


@pytest.mark.parametrize("signs", [*itertools.product((-1, 1), repeat=3)])
def test_an_image_is_drawn_whatever_its_axes_point_to(signs) -> None:
    points = unproject(np.ones((20, 30), np.float32), Intrinsics(40, 40, 15, 10)) * np.array(signs)
    view = Camera.from_image(points)
    assert view is not None
    assert (view.rows_of_pixels(points.reshape(-1, 3)) >= 0).all()


def test_points_outside_of_a_picture_take_no_memory() -> None:
    near = np.random.default_rng(0).uniform((-0.1, -0.1, 0.9), (0.1, 0.1, 1.1), (2000, 3))
    cloud = np.concatenate([near, np.tile([50.0, 0.0, 1.0], (100_000, 1))])
    tracemalloc.start()
    Camera((960, 1280), 500, 500, 640, 480).rows_of_pixels(cloud)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2e8


def test_an_image_whose_points_lie_in_a_line_has_no_camera() -> None:
    line = np.ones((24, 32, 3)) * (0.0, 1.0, 1.0)
    line[..., 1] *= np.arange(24)[:, None] / 30
    assert Camera.from_image(line) is None


def test_a_camera_straight_above_a_cloud_sees_it() -> None:
    view = Camera.facing(np.zeros((9, 3)), (0.0, 0.0, 1.0))
    np.testing.assert_allclose(view.project((0.0, 0.0, 0.0))[0], (view.cx, view.cy))


def test_the_stem_of_a_fork_ends_at_its_palm() -> None:
    assert fork(np.eye(4), 0.08, (0.06, 0.11))[0, :, 2].max() == 0.06


@pytest.mark.parametrize("behind", [False, True])
def test_what_the_cloud_hides_of_a_hand_is_faint(behind: bool) -> None:
    """A wall, and a hand that points down before or behind it."""
    side = np.linspace(-0.3, 0.3, 200)
    x, z = (grid.ravel() for grid in np.meshgrid(side, side))
    wall = np.stack([x, np.zeros_like(x), z], axis=1)
    y = 0.2 if behind else -0.2
    T = np.array([[0, 1, 0, 0], [1, 0, 0, y], [0, 0, -1, 0.1], [0, 0, 0, 1]])
    stream, grasp = io.BytesIO(), SimpleNamespace(T_cloud_hand=T, score=1.0, width=0.08)
    picture = Picture(Camera.facing(wall, (0.0, -1.0, 0.0)), wall, title="$_$")  # no formula
    picture.grasps([grasp])
    picture.save(stream)
    red, green, blue = np.moveaxis(pixels(stream), 2, 0)
    assert (((red > 220) & (green > 200) & (blue < 80)).sum() < 50) == behind


def test_regions_are_drawn_where_they_are() -> None:
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (2000, 3))
    view, stream = Camera.facing(points, (0.0, -1.0, 0.3)), io.BytesIO()
    picture = Picture(view, points)
    ball = {"kind": "sphere", "center": (0.1, 0.0, 0.0), "radius": 0.03}
    picture.regions({"contact_region": {"include": [ball]}})
    picture.save(stream)
    drawn = pixels(stream)
    row, column = np.nonzero(np.abs(drawn - (76, 201, 240)).max(axis=2) < 30)
    (x, y), _ = view.project((0.1, 0.0, 0.0))
    scale = drawn.shape[1] / view.shape[1]
    assert np.hypot(column.mean() / scale - x, row.mean() / scale - y) < 10


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_a_cloud_is_seen_from_its_camera_or_from_above_its_support(up: float, monkeypatch) -> None:
    """Never from under the table, where the origin of an arm's base is."""
    points, eyes = np.random.default_rng(0).uniform((-0.2, -0.2, 0.5), (0.2, 0.2, 0.6), (90, 3)), []
    monkeypatch.setattr(
        Camera, "facing", lambda _, eye, up: eyes.append(eye) or Camera((4, 4), 1, 1, 2, 2)
    )
    gripper = SimpleNamespace(palm_z=0.05, tip_z=0.1)
    found = SimpleNamespace(up=(0.0, 0.0, up), grasps=[], gripper=gripper, model="")
    for sent in (CloudInput(points), CloudInput(points, viewpoint=(0.0, 0.0, 0.2))):
        draw_detection(io.BytesIO(), found, sent, {})
    assert eyes[0][2] > 0.6 if up > 0 else not eyes[0].any()
    assert eyes[1].tolist() == [0.0, 0.0, 0.2]
