"""What holds for every scene, however its objects are distinguished from the background."""

import numpy as np
import pytest

from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import SUPPORT
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_results import Detection

from .rendered import BACKGROUND, box, boxes_on_table, camera, render, seen_box, table, to_world
from .scenes import detector

ORIGIN = (0.0, 0.0, 0.0)
PANEL = box((0.0, 0.22, 0.06), (0.3, 0.015, 0.06))  # too long for an object, thin enough for a hand


def ask(cloud: object, **fields: object) -> Detection:
    fields = {"viewpoint": ORIGIN, "debug": True, "num_candidates": 200, **fields}
    return detector().detect(cloud, DetectOptions.model_validate(fields))


@pytest.mark.parametrize("roll", [0.5, np.pi])
def test_a_camera_turned_about_its_axis_sees_the_same_objects(roll: float) -> None:
    scene, pose = [table(), *boxes_on_table(4)], camera(0.6, -1.2, 0.9)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    places, planes = [], []
    for T_world_camera in (pose, pose @ turn):
        found = ask(render(scene, T_world_camera))
        centers = np.array([one.center for one in found.objects])
        places.append(to_world(T_world_camera, centers))
        assert found.support is not None
        planes.append(T_world_camera[:3, :3] @ found.support.normal)
    assert len(places[0]) == len(places[1]) == 4
    apart = np.linalg.norm(places[0][:, None] - places[1], axis=2).min(axis=1)
    assert apart.max() < 0.01
    np.testing.assert_allclose(planes[0], planes[1], atol=0.02)


def test_new_noise_leaves_the_number_of_objects() -> None:
    scene, pose = [table(), *BACKGROUND["wall"], *boxes_on_table(5)], camera(0.7, -1.3, 0.9)
    assert {len(ask(render(scene, pose, seed)).objects) for seed in range(4)} == {4}


def test_a_thinned_cloud_without_rows_shows_the_same_objects() -> None:
    pose = camera(0.6, -1.2, 0.9)
    cloud = render([table(), *boxes_on_table(6)], pose).reshape(-1, 3)
    some = np.random.default_rng(0).choice(np.flatnonzero(np.isfinite(cloud[:, 0])), 20_000, False)
    found = ask(cloud[some])
    assert len(found.objects) >= 3
    assert found.grasps


def test_a_mask_of_the_caller_wins() -> None:
    objects, pose = boxes_on_table(2), camera(0.75, -1.5, 0.9)
    boxes = [PANEL, table(), *objects]
    cloud = render(boxes, pose)
    mask = seen_box(boxes, pose) == 0
    assert ask(cloud).objects
    segments = mask.astype(np.int32)
    (panel,) = ask(CloudInput(cloud, segment_ids=segments)).objects
    assert panel.number == 1
    region = {"include": [{"kind": "mask", "mask": mask}]}
    held = ask(cloud, approach_region=region, contact_region=region, min_score=0.0)
    on_panel = cloud.reshape(-1, 3)[mask]
    for grasp in held.grasps:
        for point in (grasp.approach_point, grasp.contact_point):
            assert np.linalg.norm(on_panel - point, axis=1).min() < 0.006


def test_segments_stand_on_what_lies_below_them_not_on_the_top_of_a_carton() -> None:
    carton, small = (
        box((-0.3, -0.3, 0.15), (0.4, 0.5, 0.15)),
        box((0.3, 0.2, 0.05), (0.02, 0.02, 0.05)),
    )
    boxes, pose = [small, carton, table(0.8, 0.7)], camera(0.9, -np.pi / 2, 0.9)
    segments = (seen_box(boxes, pose) == 0).astype(np.int32)
    found = ask(CloudInput(render(boxes, pose), segment_ids=segments))
    assert found.support is not None
    assert found.grasps
    height = (small.center - pose[:3, 3]) @ pose[:3, :3] @ found.support.normal
    assert height - found.support.offset == pytest.approx(small.half[2], abs=0.005)


def test_every_row_is_labelled_with_an_object_the_support_or_neither() -> None:
    objects, pose = boxes_on_table(7), camera(0.7, -1.2, 0.85)
    boxes = [table(), *objects]
    found = ask(render(boxes, pose))
    assert found.debug is not None
    labels, number = found.debug.labels, seen_box(boxes, pose)
    assert set(labels[labels >= 0].tolist()) == {one.number for one in found.objects}
    assert (labels[number == 0] == SUPPORT).mean() > 0.95
    assert (labels[number == -1] < 0).all()
