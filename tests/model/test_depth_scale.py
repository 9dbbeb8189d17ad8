import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import SupportPlane, parse_options
from edgegrasp_model.scene.cloud import CloudInput, check_cloud
from edgegrasp_model.scene.scene import build_scene
from edgegrasp_model.scene.support import correct_depth_scale, depth_scale

CAMERA = np.array([0.0, -0.5, 0.4])
PLANE = {"normal": (0.0, 0.0, 1.0), "offset": 0.05, "max_depth_error": 0.12}


def scene(rng: np.random.Generator, table: int = 2000, things: int = 1000) -> np.ndarray:
    """A table at z = 0.05, and on it a box with a level lid 0.06 above."""
    flat = rng.uniform(-0.15, 0.15, (table, 3)) * (1, 1, 0)
    box = rng.uniform(-0.05, 0.05, (things, 3)) + np.array([0, 0, 0.05])
    box[: things // 2, 2] = 0.06
    points = np.concatenate([flat, box]) + np.array([0, 0, 0.05])
    return points + rng.normal(0, 0.001, points.shape)


def seen(points: np.ndarray, factor: float, camera: np.ndarray = CAMERA) -> np.ndarray:
    """The points as a camera sees them whose depths are wrong by a factor."""
    return (camera + factor * (points - camera)).astype(np.float32)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    factor=st.floats(0.9, 1.1),
    things=st.sampled_from([0, 1000, 4000, 12_000]),
)
def test_the_factor_is_found_in_any_frame(seed: int, factor: float, things: int) -> None:
    rng = np.random.default_rng(seed)
    points = seen(scene(rng, things=things), factor)
    turn, shift = Rotation.random(rng=rng), rng.uniform(-1, 1, 3)
    x, y, z = turn.apply(PLANE["normal"]).tolist()
    offset = 0.05 + float(np.dot((x, y, z), shift))
    plane = SupportPlane(normal=(x, y, z), offset=offset, max_depth_error=0.12)
    moved = (turn.apply(points) + shift).astype(np.float32)
    scale = depth_scale(moved, turn.apply(CAMERA) + shift, plane)
    # A millimetre at the table is a share of 0.003 of the camera's height.
    assert scale == pytest.approx(1.0 / factor, abs=0.003)


@pytest.mark.parametrize(
    ("points", "camera"),
    [
        pytest.param(scene(np.random.default_rng(0), table=0), CAMERA, id="no table"),
        pytest.param(np.empty((0, 3)), CAMERA, id="no points"),
        pytest.param(
            seen(scene(np.random.default_rng(0), things=0), 1.3), CAMERA, id="out of reach"
        ),
        pytest.param(
            scene(np.random.default_rng(0)), np.array([0.0, -0.5, 0.02]), id="camera below it"
        ),
        pytest.param(
            scene(np.random.default_rng(0)), np.array([0.0, 0.0, 1e9]), id="camera in millimetres"
        ),
    ],
)
def test_without_its_plane_there_is_no_factor(points: np.ndarray, camera: np.ndarray) -> None:
    plane = SupportPlane(**PLANE).model_copy(update={"max_depth_error": 0.05})
    assert depth_scale(points, camera, plane) is None


def test_every_view_has_a_factor_of_its_own() -> None:
    rng = np.random.default_rng(3)
    cameras = np.array([CAMERA, [0.4, 0.2, 0.5], [-0.4, 0.2, 0.5]])
    clean = [scene(rng) for _ in cameras]
    factors = 0.96, 1.0, 1.05
    sent = [seen(points, f, c) for points, f, c in zip(clean, factors, cameras, strict=True)]
    ids = np.repeat(np.arange(3), [len(points) for points in sent])
    cloud = check_cloud(CloudInput(np.concatenate(sent), view_ids=ids))
    options = parse_options({"support": PLANE, "viewpoint": cameras.tolist()})
    warnings: list[str] = []
    corrected = correct_depth_scale(cloud, options, cameras, warnings)
    np.testing.assert_allclose(corrected.points, np.concatenate(clean), atol=0.003)
    assert [text[:24] for text in warnings] == [
        "the depths of view 0 wer",
        "the depths of view 2 wer",
    ]
    assert "multiplied by 1.04" in warnings[0]
    assert "multiplied by 0.95" in warnings[1]


def test_a_scene_is_the_same_after_wrong_depths() -> None:
    points = scene(np.random.default_rng(4))
    options = parse_options(
        {
            "support": PLANE,
            "viewpoint": CAMERA.tolist(),
            "workspace": {"min": (-0.15, -0.15, 0.055), "max": (0.15, 0.15, 0.3)},
        }
    )
    scenes = []
    for factor in (1.0, 1.06):
        warnings: list[str] = []
        built = build_scene(check_cloud(seen(points, factor)), options, 0.004, {}, warnings)
        assert built is not None
        assert len(warnings) == (factor != 1.0)
        scenes.append(built.points_in_cloud)
    right, corrected = scenes
    assert abs(len(right) - len(corrected)) < 0.05 * len(right)
    np.testing.assert_allclose(right.max(axis=0), corrected.max(axis=0), atol=0.004)
    np.testing.assert_allclose(right.min(axis=0), corrected.min(axis=0), atol=0.004)


def test_a_table_that_was_cut_away_is_missed() -> None:
    points = scene(np.random.default_rng(5), table=0)[500:]
    warnings: list[str] = []
    options = parse_options({"support": PLANE, "viewpoint": CAMERA.tolist()})
    cloud = check_cloud(points[points[:, 2] > 0.08].astype(np.float32))
    assert correct_depth_scale(cloud, options, CAMERA[None], warnings).points is not None
    assert len(warnings) == 1
    assert "options.support.max_depth_error (0.12)" in warnings[0]


def test_depths_are_left_alone_unless_asked() -> None:
    points = seen(scene(np.random.default_rng(6)), 1.05)
    cloud = check_cloud(points)
    plane = {"normal": PLANE["normal"], "offset": PLANE["offset"]}
    warnings: list[str] = []
    options = parse_options({"support": plane, "viewpoint": CAMERA.tolist()})
    assert correct_depth_scale(cloud, options, CAMERA[None], warnings) is cloud
    assert warnings == []


def test_depths_need_a_camera() -> None:
    cloud = check_cloud(scene(np.random.default_rng(7)).astype(np.float32))
    with pytest.raises(InvalidRequest, match=r"options\.viewpoint: got nothing.*camera's"):
        build_scene(cloud, parse_options({"support": PLANE}), 0.004, {}, [])
