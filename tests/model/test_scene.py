"""A sent cloud made into a scene, and the solid boxes in it."""

import numpy as np
import pytest

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.scene.cloud import CloudInput, check_cloud
from edgegrasp_model.scene.scene import Scene, build_scene, select_points

VOXEL = 0.004


def sheet(z: float, count: int = 3000, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 3))
    points[:, 2] = z
    return points.astype(np.float32)


def build(cloud: object, **options: object) -> tuple[Scene, dict[str, int], list[str]]:
    counts: dict[str, int] = {}
    warnings: list[str] = []
    asked = DetectOptions.model_validate({"support": None} | options)
    selected = select_points(check_cloud(cloud), asked, counts, warnings)
    scene = build_scene(selected, asked, VOXEL, counts)
    assert scene is not None
    return scene, counts, warnings


def normals_in_cloud(scene: Scene) -> np.ndarray:
    return scene.frame.directions_in_cloud(scene.cloud.normals)


def test_given_normals_are_averaged_in_each_voxel_and_estimated_where_they_cancel() -> None:
    sent = np.random.default_rng(1).normal([0.3, 0.2, -1.0], 0.01, (3000, 3)) * 5.0
    scene, _, _ = build(CloudInput(sheet(0.3), normals=sent), viewpoint=(0, 0, 9))
    expected = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    np.testing.assert_allclose(normals_in_cloud(scene) @ expected, 1.0, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(scene.cloud.normals, axis=1), 1.0, atol=1e-5)

    sent = np.where(np.arange(3000)[:, None] % 2, [[1.0, 0, 0]], [[-1.0, 0, 0]])
    twice = np.repeat(sheet(0.3, 1500), 2, axis=0)
    scene, _, _ = build(CloudInput(twice, normals=sent), viewpoint=(0, 0, 9))
    np.testing.assert_allclose(normals_in_cloud(scene)[:, 2], 1.0, atol=1e-4)


def test_each_camera_orients_the_normals_of_what_it_saw() -> None:
    cloud = np.concatenate([sheet(0.3), sheet(0.2)])
    views = np.repeat([0, 1], 3000)
    scene, _, _ = build(
        CloudInput(cloud, view_ids=views), viewpoint=[(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
    )
    upper = scene.points_in_cloud[:, 2] > 0.25
    normals = normals_in_cloud(scene)
    assert (normals[upper, 2] > 0.99).all()
    assert (normals[~upper, 2] < -0.99).all()


@pytest.mark.parametrize(
    ("views", "value"),
    [(None, "nothing, for 2 viewpoints"), (np.array([0, 2] * 10), "values from 0 to 2")],
)
def test_several_cameras_need_to_know_who_saw_what(views: np.ndarray | None, value: str) -> None:
    cloud = CloudInput(sheet(0.1, 20), view_ids=views)
    with pytest.raises(InvalidRequest) as caught:
        build(cloud, viewpoint=[(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
    assert (caught.value.field, caught.value.value) == ("view_ids", value)


@pytest.mark.parametrize(
    "options",
    [
        {"viewpoint": (0.0, 0.0, 0.5), "support": {"normal": (0.0, 0.0, 1.0), "offset": 0.2}},
        {
            "support": {"normal": (0.0, 0.6, 0.8), "offset": 0.2},
            "workspace": {"min": (1.0, 1.0, 1.0), "max": (1.1, 1.1, 1.1)},
        },
    ],
    ids=["below the plane", "outside the workspace"],
)
def test_nothing_above_a_given_plane_is_no_error(options: dict[str, object]) -> None:
    counts: dict[str, int] = {}
    asked = DetectOptions.model_validate(options)
    selected = select_points(check_cloud(sheet(0.1)), asked, counts, [])
    assert len(selected.number) == 0
    assert counts["above_support"] == 0


def test_a_found_plane_is_taken_away_and_stays_as_an_obstacle() -> None:
    box = np.random.default_rng(2).uniform(-0.02, 0.02, (1000, 3)) + np.array([0, 0, 0.35])
    cloud = np.concatenate([sheet(0.3, 4000), box]).astype(np.float32)
    scene, counts, warnings = build(cloud, support={"kind": "ransac"}, viewpoint=(0, 0, 1))
    assert counts["above_support"] == 1000
    assert warnings == []
    assert scene.support is not None
    on_table = scene.frame.points([[0.0, 0.0, 0.3]])
    np.testing.assert_allclose(scene.support.heights(on_table), 0.0, atol=1e-4)
    scene, counts, warnings = build(
        box.astype(np.float32), support={"kind": "ransac", "min_share": 0.9}
    )
    assert scene.support is None
    assert counts["above_support"] == 1000
    assert "no support plane" in warnings[0]
