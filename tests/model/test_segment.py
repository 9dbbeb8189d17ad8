"""What is found in a view without further options: the support, and the objects on it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation
from tests.checks import bounded_memory, refusal

from edgegrasp_client import on_mask
from edgegrasp_model.options import parse_options
from edgegrasp_model.results import SUPPORT
from edgegrasp_model.scene.cloud import CloudInput, check_cloud, likely_viewpoint, unit, voxelise
from edgegrasp_model.scene.network import range_image
from edgegrasp_model.scene.scene import build_scene, select_points
from edgegrasp_model.scene.segment import BACKGROUND, Segmentation, merge_views
from edgegrasp_model.scene.support import ViewedPoints, find_support, heights_over
from edgegrasp_results import Detection

from .rendered import SolidBox, box, boxes_on_table, camera, render, seen_box, table, to_world
from .scenes import SEED, detector, grid

AROUND = ["floor", "wall", "carton", "edge"]  # of the table, near the objects
ABOVE = camera(0.8, -1.5, 0.7)
FURNISHINGS = {
    "floor": [box((0, 0, -0.75), (4, 4, 0.05))],
    "wall": [box((0, 0.5, 0.4), (3, 0.05, 1.6))],
    "monitor": [box((-0.38, 0.05, 0.2), (0.03, 0.25, 0.2))],
    "carton": [box((0.02, 0.36, 0.12), (0.28, 0.11, 0.12), 0.2)],
}


def seen_from(points: np.ndarray, eye: np.ndarray) -> ViewedPoints:
    """Points (N, 3) that one camera saw."""
    return ViewedPoints(points, eye, np.linalg.norm(points - eye, axis=1).astype(np.float32))


def bin_walls(length: float, width: float, height: float, wall: float = 0.005) -> list[SolidBox]:
    """An open box on z = 0 around the origin."""
    x, y, z = length / 2, width / 2, height / 2
    return [
        box((x, 0, z), (wall / 2, y, z)),
        box((-x, 0, z), (wall / 2, y, z)),
        box((0, y, z), (x, wall / 2, z)),
        box((0, -y, z), (x, wall / 2, z)),
        box((0, 0, wall / 2), (x, y, wall / 2)),
    ]


def seen_in_world(boxes: list[SolidBox], T_world_camera: np.ndarray) -> np.ndarray:
    """The points (N, 3) of boxes that a camera sees, in the world's frame."""
    cloud = render(boxes, T_world_camera).reshape(-1, 3)
    seen = cloud[np.isfinite(cloud).all(axis=1)]
    return to_world(T_world_camera, seen).astype(np.float32)


def detect(cloud: object, pose: np.ndarray | None = None, **options: object) -> Detection:
    """What is found in a cloud in the frame of its camera, or in that in which a pose puts it."""
    viewpoint = np.zeros(3) if pose is None else pose[:3, 3]
    few = {"viewpoint": viewpoint.tolist(), "num_candidates": 300}
    return detector().detect(cloud, parse_options(few | options))


def view(rng: np.random.Generator) -> np.ndarray:
    return camera(rng.uniform(0.5, 1.15), rng.uniform(-2.6, -0.5), rng.uniform(0.6, 0.9))


def standing(detection: Detection, boxes: list[SolidBox], T_world_camera: np.ndarray) -> set[int]:
    """Which of the boxes the objects of an answer are; each object has to be one of them."""
    found = set()
    for each in detection.objects:
        center = to_world(T_world_camera, each.center)
        distance = [one.distance(center[None])[0] for one in boxes]
        assert min(distance) < 0.02, f"{each} is none of the boxes"
        found.add(int(np.argmin(distance)))
    return found


def assert_grasped(detection: Detection, boxes: list[SolidBox], T_world_camera: np.ndarray) -> None:
    """Some grasps, each with its contact on one of the boxes."""
    assert detection.grasps
    for grasp in detection.grasps:
        contact = to_world(T_world_camera, grasp.contact_point)
        assert min(one.distance(contact[None])[0] for one in boxes) < 0.012


def contents(seed: int, reach: tuple[float, float]) -> list[SolidBox]:
    """Four boxes in a bin."""
    rng = np.random.default_rng(seed)
    return [
        box((*rng.uniform(-np.array(reach), reach), 0.03), (0.02, 0.045, 0.025), yaw)
        for yaw in rng.uniform(0, 3, 4)
    ]


@given(seed=st.integers(0, SEED), around=st.sets(st.sampled_from(AROUND)))
@settings(max_examples=12)
def test_background_around_them_makes_no_other_objects(seed: int, around: set[str]) -> None:
    rng = np.random.default_rng(seed)
    boxes, T_world_camera = boxes_on_table(seed), view(rng)
    background = [one for name in sorted(around - {"edge"}) for one in FURNISHINGS[name]]
    top = table(0.3, 0.24) if "edge" in around else table()
    plain = detect(render([table(), *boxes], T_world_camera))
    crowded = detect(render([top, *boxes, *background], T_world_camera))
    kept = standing(crowded, boxes, T_world_camera)
    assert len(kept) >= len(boxes) - 1
    assert kept <= standing(plain, boxes, T_world_camera)
    up = T_world_camera[:3, :3] @ crowded.support.normal
    assert up[2] > np.cos(np.radians(5))
    assert abs(crowded.support.offset + up @ T_world_camera[:3, 3]) < 0.01  # its height
    assert_grasped(crowded, boxes, T_world_camera)
    for grasp in crowded.grasps:
        assert grasp.approach_direction @ crowded.support.normal < 0.11  # none from below
        assert grasp.object in {each.number for each in crowded.objects}


@pytest.mark.parametrize("seed", range(4))
def test_noise_larger_than_the_pixels_hides_no_object(seed: int) -> None:
    rng, pose = np.random.default_rng(seed), camera(0.8, -1.5, 0.85)
    boxes = [box((x, rng.uniform(-0.03, 0.03), 0.03), (0.02, 0.04, 0.03)) for x in (-0.07, 0.07)]
    image = render([table(), *boxes], pose, zoom=3.0)
    found = detect(image + rng.normal(0.0, 0.001, image.shape).astype(np.float32))
    assert standing(found, boxes, pose) == {0, 1}
    assert_grasped(found, boxes, pose)


@pytest.mark.parametrize("seed", [3, 8])
def test_a_voxel_downsampled_cloud_without_a_viewpoint_keeps_its_objects(seed: int) -> None:
    boxes, pose = boxes_on_table(seed), view(np.random.default_rng(seed))
    cloud = seen_in_world([table(1.0, 0.8), *boxes, *FURNISHINGS["floor"]], pose)
    found = detector().detect(voxelise(cloud, 0.004).mean(cloud))
    assert standing(found, boxes, np.eye(4)) == {0, 1, 2, 3}
    assert_grasped(found, boxes, np.eye(4))


@pytest.mark.parametrize("seed", [3, 8])
def test_a_shelf_seen_from_the_front_without_a_viewpoint_keeps_its_objects(seed: int) -> None:
    boxes, pose = boxes_on_table(seed), camera(1.1, -1.5, 0.9)
    board, back = box((0, 0, 0.4), (0.5, 0.3, 0.01)), box((0, 0.35, 0.2), (0.5, 0.01, 0.25))
    cloud = seen_in_world([table(0.5, 0.3), board, back, *boxes], pose)
    found = detector().detect(cloud)
    assert standing(found, boxes, np.eye(4)) == {0, 1, 2, 3}
    assert_grasped(found, boxes, np.eye(4))
    middle = np.median(cloud, axis=0)
    ways = unit(np.stack([likely_viewpoint(cloud, (0, 0, 1)), pose[:3, 3]]) - middle)
    assert ways[0] @ ways[1] > np.cos(np.radians(30))


@pytest.mark.parametrize("polar", [0.05, 0.4])
@pytest.mark.parametrize("height", [0.045, 0.12])
def test_a_bin_has_contents_and_no_rims(polar: float, height: float) -> None:
    inside, T_world_camera = contents(3, (0.12, 0.07)), camera(polar, -1.5, 0.8)
    cloud = render([table(), *bin_walls(0.45, 0.32, height), *inside], T_world_camera)
    assert_grasped(detect(cloud), inside, T_world_camera)


@pytest.mark.parametrize(("noise", "height"), [(0.0025, 0.022), (0.0, 0.012)])
def test_the_rest_of_a_table_that_was_cut_off_is_no_object(noise: float, height: float) -> None:
    flat = box((0.02, 0.01, height / 2), (0.03, 0.06, height / 2), 0.3)
    T_world_camera = camera(0.5, -1.5, 0.6)
    points = seen_in_world([table(), flat], T_world_camera)
    points += np.random.default_rng(1).normal(0, noise, points.shape)
    near = (np.abs(points[:, :2]) < 0.15).all(axis=1) & (points[:, 2] > 0.005)
    plane = {"normal": (0, 0, 1), "offset": 0.0}
    found = detect(points[near], T_world_camera, support=plane)
    assert len(found.objects) == 1
    assert 2 * found.objects[0].half_extents[:2].max() == pytest.approx(0.12, abs=0.03)
    assert found.objects[0].confidence > 0.9
    assert found.grasps


@pytest.mark.parametrize("given", [True, False])
def test_a_table_that_lies_over_the_plane_is_not_cut_off(given: bool) -> None:
    """What else is in view is no object: a plane that is given is never exact, nor a table flat."""
    one, T_world_camera = box((0, 0, 0.03), (0.02, 0.03, 0.03)), camera(0.7, -1.5, 0.7)
    points = seen_in_world([table(), one, *FURNISHINGS["monitor"]], T_world_camera)
    close = (np.abs(points[:, :2]) < 0.12).all(axis=1) & (points[:, 2] < 0.005)
    points[close, 2] -= 0.0 if given else 0.0015
    asked = {"support": {"normal": (0, 0, 1), "offset": -0.003}} if given else {}
    found = detect(points, T_world_camera, **asked)
    assert len(found.objects) == 1
    assert found.support.share > 0.4


def test_a_workspace_is_where_grasps_are_and_what_is_beyond_stays() -> None:
    boxes = [box((-0.05, 0, 0.05), (0.02, 0.03, 0.05)), box((0.12, 0, 0.05), (0.02, 0.03, 0.05))]
    left = {"min": (-0.2, -0.2, -0.05), "max": (0.05, 0.2, 0.3)}
    found = detect(seen_in_world([table(), *boxes], ABOVE), ABOVE, workspace=left, debug=True)
    assert found.grasps
    assert all(grasp.contact_point[0] < 0.051 for grasp in found.grasps)
    assert found.debug.points[:, 0].max() > 0.1  # the other box is still an obstacle
    assert len(found.objects) == 1


FOUR = boxes_on_table(5)
ON_TABLE = render([table(), *FOUR], ABOVE)
PLACES = np.nan_to_num(to_world(ABOVE, ON_TABLE.reshape(-1, 3)), nan=9.0)


def test_segments_are_the_objects_where_they_are_sent() -> None:
    number = 2**31 - 1000
    segment = np.where(FOUR[2].distance(PLACES) < 0.004, number, 0).reshape(ON_TABLE.shape[:2])
    with bounded_memory(2**30):  # however high the numbers are
        found = detect(CloudInput(ON_TABLE, segment_ids=segment), previous={}, debug=True)
    assert {grasp.object for grasp in found.grasps} == {number}
    assert [each.number for each in found.objects] == [number]
    assert found.debug.labels.max() == number


def continued(before: Detection) -> dict[str, Any]:
    """What the next request sends of an answer."""
    grasps = [
        {"id": one.id, "T_cloud_hand": np.ravel(one.T_cloud_hand).tolist(), "object": one.object}
        for one in before.grasps[:20]
    ]
    objects = [
        {"number": one.number, "surface": np.ravel(one.surface).tolist()} for one in before.objects
    ]
    return {"gripper": before.gripper.name, "grasps": grasps, "objects": objects}


def test_a_chosen_object_is_not_taken_for_one_beside_it_that_was_left_out() -> None:
    boxes = [box((0.045 * row, 0.0, 0.03), (0.015, 0.015, 0.03)) for row in range(3)]
    cloud = render([table(), *boxes], ABOVE)
    before = detect(cloud, previous={})
    assert len(before.objects) == 3
    for one in before.objects:
        now = detect(cloud, near=one.center.tolist(), previous=continued(before))
        assert [each.number for each in now.objects] == [one.number]


@pytest.mark.parametrize("search", [True, False])
def test_followed_objects_have_the_numbers_of_the_segments_they_are_in(search: bool) -> None:
    on = np.array([one.distance(PLACES) < 0.004 for one in FOUR])
    segment = np.argmax([~on.any(axis=0), *on], axis=0)
    previous = continued(detect(CloudInput(ON_TABLE, segment_ids=segment), previous={}))
    cloud = CloudInput(ON_TABLE, segment_ids=np.array([0, 4, 3, 2, 1])[segment])
    now = detect(cloud, previous=previous | {"search": search})
    assert now.tracking.first == "kept"
    for number, there in [
        *((one.number, one.surface) for one in now.objects),
        *((one.object, one.contact_point[None]) for one in now.grasps),
    ]:
        assert FOUR[4 - number].distance(to_world(ABOVE, there)).max() < 0.01


def test_objects_are_chosen_by_the_numbers_that_following_gives_them() -> None:
    previous = continued(detect(ON_TABLE, previous={"next_id": 20}))
    for chosen, numbers in (("include", {22}), ("exclude", {20, 21, 23})):
        now = detect(ON_TABLE, previous=previous, objects={chosen: [22]})
        assert {grasp.object for grasp in now.grasps} == numbers
        assert {each.number for each in now.objects} == numbers
        assert not now.warnings


@pytest.mark.parametrize("search", [True, False])
def test_of_two_earlier_objects_in_one_place_only_one_is_there(search: bool) -> None:
    previous = continued(detect(ON_TABLE, previous={})) | {"search": search}
    few = detect(ON_TABLE, previous=previous, num_candidates=1)
    assert not any(one.reason for one in few.objects if (one.best_score or 0.0) >= 0.5)
    previous["objects"] += [previous["objects"][0] | {"number": 9}]
    now = detect(ON_TABLE, previous=previous)
    numbers = {each.number for each in now.objects}
    assert {grasp.object for grasp in now.grasps} <= numbers
    assert numbers == {*range(4)} or not search


def test_a_segment_for_every_pixel_takes_no_more_approach_points() -> None:
    segment = np.arange(1, len(PLACES) + 1).reshape(ON_TABLE.shape[:2])
    found = detect(CloudInput(ON_TABLE, segment_ids=segment))
    assert len(found.objects) > 256
    assert found.counts["approach_points"] <= 128
    assert found.grasps


def test_objects_that_one_of_three_views_shows_as_one_stay_apart() -> None:
    left = grid(*[np.arange(0.0, 0.04, 0.002)] * 2, [0.0])
    both = np.concatenate([left, left + np.array([0.048, 0, 0])]).astype(np.float32)
    seen = np.tile(both, (3, 1))
    number = np.repeat([0, 0, 1, 2, 3, 4], len(left))
    confidence, view = np.array([0.9, 0.8, 0.7, 0.6, 0.5]), np.array([0, 1, 1, 2, 2])
    joined, best = merge_views(seen, number, confidence, view)
    shown = joined.reshape(3, 2, len(left))
    assert len(best) == 2
    for one, other in ((0, 1), (1, 0)):
        assert (shown[:, one] == shown[1, one, 0]).all()
        assert shown[1, one, 0] != shown[1, other, 0]


@pytest.mark.parametrize(("height", "width"), [(600, 800), (600, 960), (1000, 1200)])
def test_an_image_without_holes_is_looked_at_up_to_its_edges(height: int, width: int) -> None:
    y, x = np.indices((height, width), dtype=np.float32) / width
    points = 0.7 * np.stack([x - 0.5, y - 0.5 * height / width, np.ones_like(x)], axis=-1)
    image = range_image(points.reshape(-1, 3), np.zeros(3), None, np.array([0.0, 1.0, 0.0]))
    end = image.corner + image.footprint * np.array(image.points.shape[1::-1])
    assert image.corner[0] <= -0.49
    assert end[0] >= 0.49


def test_a_speck_before_an_object_is_no_part_of_it() -> None:
    one = box((0, 0, 0.05), (0.03, 0.04, 0.05))
    cloud = render([table(), one], ABOVE)
    middle = ABOVE[:3, :3].T @ (one.center - ABOVE[:3, 3])
    row, column = (round(270 * middle[k] / middle[2]) + m for k, m in ((1, 120), (0, 160)))
    cloud[row - 12 : row - 4, column - 3 : column + 3] *= 0.94  # 4 cm before the box
    found = detect(cloud, debug=True)
    assert len(found.objects) == 1
    assert_grasped(found, [one], ABOVE)


def test_points_scattered_over_the_table_are_no_object() -> None:
    boxes, T_world_camera = [box((0.1, 0, 0.05), (0.03, 0.04, 0.05))], camera(0.5, -1.5, 0.7)
    cloud = render([table(), *boxes], T_world_camera)
    beside = to_world(T_world_camera, cloud)[..., :2] - (-0.1, 0.0)
    patch = np.flatnonzero(np.abs(beside).max(axis=2) < 0.03)
    raised = np.random.default_rng(2).choice(patch, 30, replace=False)
    cloud.reshape(-1, 3)[raised] *= 0.98  # 12 mm over the table
    assert standing(detect(cloud), boxes, T_world_camera) == {0}


def test_bumps_in_an_empty_table_are_no_objects() -> None:
    """Errors of a depth camera are as wide as small objects, but smooth."""
    T_world_camera = camera(0.7, -1.5, 0.7)
    points = seen_in_world([table()], T_world_camera)
    for place in ((0.05, 0.0), (-0.1, 0.08), (0.15, -0.12)):
        away = np.linalg.norm(points[:, :2] - place, axis=1)
        points[:, 2] += 0.01 * np.exp(-((away / 0.02) ** 2))
    found = detect(points, T_world_camera)
    assert found.support is not None
    assert not found.objects


def test_without_a_support_in_view_everything_is_an_object_and_the_answer_says_so() -> None:
    T_world_camera = camera(0.8, -1.5, 0.5)
    found = detect(render([box((0, 0, 0), (0.03, 0.04, 0.06), 0.4)], T_world_camera))
    assert len(found.objects) == 1
    assert found.support is not None  # assumed under it
    assert (T_world_camera[:3, :3] @ found.support.normal)[2] > np.cos(np.radians(3))
    assert any("no support plane" in warning for warning in found.warnings)


@pytest.mark.parametrize("frame", ["world", "camera"])
def test_a_support_is_assumed_under_a_cloud_that_was_cut_off_above_it(frame: str) -> None:
    """No hand reaches under the objects."""
    boxes, pose = boxes_on_table(2), camera(0.8, -1.5, 0.6)
    points = seen_in_world([table(), *boxes], pose)
    points, up = points[points[:, 2] > 0.005], np.array([0, 0, 1])
    if frame == "camera":
        points, up = (points - pose[:3, 3]) @ pose[:3, :3], pose[2, :3]
    found = detect(points.astype(np.float32), pose if frame == "world" else None)
    assert any("one is assumed under the lowest points" in each for each in found.warnings)
    assert found.support.normal @ up > np.cos(np.radians(2))
    heights = points @ found.support.normal - found.support.offset
    assert 0.0 < np.percentile(heights, 1) < 0.006
    assert found.grasps
    assert max(grasp.approach_direction @ found.support.normal for grasp in found.grasps) < 0.11


@pytest.mark.parametrize("support", ["auto", None])
@pytest.mark.parametrize("half", [(0.03, 0.05, 0.02), (0.02, 0.03, 0.07), (0.025, 0.025, 0.04)])
@pytest.mark.parametrize(("polar", "forward"), [(0.3, "z"), (0.7, "z"), (1.0, "z"), (1.0, "x")])
def test_an_object_alone_in_a_camera_frame_is_not_grasped_from_below(support, half, polar, forward):
    """Neither its support nor `up` is known."""
    one, pose = box((0, 0, half[2]), half, 0.4), camera(polar, -1.5, 0.6)
    points, pose = seen_in_world([one], pose) - pose[:3, 3], pose[:3, :3]
    if forward == "x":  # x forward, y left, z up
        pose = pose[:, [2, 0, 1]] * (1, -1, -1)
    found = detect((points @ pose).astype(np.float32), np.eye(4), support=support)
    assert found.up @ pose[2] > np.cos(np.radians(35))
    assert found.grasps
    assert max(grasp.approach_direction @ pose[2] for grasp in found.grasps[:10]) < 0.3


def test_a_cloud_without_a_camera_may_have_no_points_at_its_middle() -> None:
    points = seen_in_world([box((0, 0, 0.03), (0.03, 0.02, 0.03))], camera(0.7, -1.5, 0.6))
    points = np.concatenate([np.add(points, (x, 0, 0)) for x in (-1.5, 1.5)])
    found = detector().detect(points.astype(np.float32), parse_options({"num_candidates": 300}))
    assert found.objects


@pytest.mark.parametrize("count", [20_000, 8_000])
def test_a_sparse_cloud_of_the_whole_view_shows_the_same_objects(count: int) -> None:
    boxes, T_world_camera = boxes_on_table(2), camera(0.8, -1.5, 0.6)
    points = seen_in_world([table(), *boxes, *FURNISHINGS["floor"]], T_world_camera)
    dense = detect(points, T_world_camera)
    some = np.random.default_rng(0).choice(len(points), count, replace=False)
    sparse = detect(points[some], T_world_camera)
    held = {grasp.object for grasp in sparse.grasps}
    assert len(held) == len({grasp.object for grasp in dense.grasps}) == len(boxes)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.1, -0.05), (-0.08, 0.1)])
def test_a_small_object_alone_on_a_table_is_found(place: tuple[float, float]) -> None:
    small = box((*place, 0.009), (0.012, 0.009, 0.009), 0.5)
    found = detect(render([table(), small], ABOVE))
    assert len(found.objects) == 1
    assert_grasped(found, [small], ABOVE)


def test_small_objects_are_found_beside_a_large_one() -> None:
    small = [box((x, 0.1, 0.015), (0.015, 0.012, 0.015), 0.5) for x in (-0.15, 0.0, 0.15)]
    things = [table(), *small, box((0.0, -0.1, 0.06), (0.04, 0.04, 0.06))]
    far = camera(0.8, -1.5, 1.2)
    assert [len(detect(render(things, far, seed)).objects) for seed in range(3)] == [4, 4, 4]


def test_hands_have_a_plane_to_stay_above_where_all_objects_are_outliers() -> None:
    points = seen_in_world([table()], ABOVE)
    request, seen = parse_options({"support": "ransac"}), seen_from(points, ABOVE[:3, 3])
    support = find_support(seen, np.ones(len(points), bool), None, request, [])
    plane = support.plane_under(np.empty((0, 3)), 0.001)
    assert plane.offset == pytest.approx(support.plane.offset + 0.001)
    bowed = replace(support, bow=np.array([0.0, 0.05, -0.08, 0.0, 0.0, 0.0]))  # 50 mm a metre
    x, y = np.random.default_rng(0).uniform((0.2, -0.2), (0.3, 0.0), (99, 2)).T
    on_it = support.frame.points_to_cloud(np.stack([x, y, 0.05 * x - 0.08 * y], axis=1))
    np.testing.assert_allclose(heights_over(bowed.plane_under(on_it, 0.0), on_it), 0.0, atol=0.005)


def test_a_plane_far_from_the_sent_up_is_no_support() -> None:
    T_world_camera = camera(0.6, -1.5, 0.7)
    cloud = render([table(), *boxes_on_table(1)], T_world_camera)
    tilted = T_world_camera[:3, :3].T @ Rotation.from_euler("x", 50, degrees=True).apply([0, 0, 1])
    found = detect(cloud, up=tilted.tolist())
    assert found.support is None
    assert any("no support plane" in warning for warning in found.warnings)


@pytest.mark.parametrize("around", [[], [*FURNISHINGS["monitor"], *FURNISHINGS["floor"]]])
def test_a_table_without_objects_is_a_support_and_has_no_grasps(around: list[SolidBox]) -> None:
    found = detect(render([table(), *around], camera(0.7, -1.5, 0.8)))
    assert found.support is not None
    assert (found.grasps, found.objects) == ([], [])
    said = any("no object was recognised" in warning for warning in found.warnings)
    assert said == bool(around)


def test_objects_that_touch_are_grasped_however_long_the_heap_is() -> None:
    rng = np.random.default_rng(2)
    heap = [
        box((x, rng.uniform(-0.03, 0.03), half), (0.035, rng.uniform(0.02, 0.035), half), 0.0)
        for x, half in zip(np.arange(-0.28, 0.29, 0.07), rng.uniform(0.02, 0.05, 9), strict=True)
    ]
    assert detect(render([table(), *heap], camera(0.6, -1.5, 0.8))).grasps


def test_an_object_that_leans_on_a_wall_ends_there_and_no_hand_closes_on_the_wall() -> None:
    walls = bin_walls(0.4, 0.3, 0.06, wall=0.012)
    leaning = box((-0.168, 0.0, 0.025), (0.02, 0.03, 0.025))  # 2 mm beside a wall
    T_world_camera = camera(0.1, -1.5, 0.7)
    found = detect(render([table(), *walls, leaning], T_world_camera), top_k=100)
    assert len(found.objects) == 1
    size = 2 * np.sort(found.objects[0].half_extents[:2])
    assert size == pytest.approx([0.04, 0.06], abs=0.015)
    assert found.grasps
    for grasp in found.grasps:  # the hand closes along the wall, not across it
        closing = T_world_camera[:3, :3] @ grasp.T_cloud_hand[:3, 1]
        assert abs(closing[0]) < 0.5


@pytest.mark.parametrize("place", [(0.19, 0.115), (0.0, 0.0)])  # a corner, the middle
def test_one_large_object_in_a_shallow_bin_is_found(place: tuple[float, float]) -> None:
    walls = bin_walls(0.5, 0.35, 0.05, wall=0.01)  # its floor is near enough to be the support
    jar = box((*place, 0.045), (0.03, 0.04, 0.035))
    found = detect(render([table(), *walls, jar], camera(0.1, -1.5, 0.8)))
    assert len(found.objects) == 1
    assert found.grasps


def test_the_walls_of_a_bin_whose_inside_is_the_workspace_are_not_grasped() -> None:
    inside, T_world_camera = contents(4, (0.1, 0.07)), camera(0.3, -1.5, 0.7)
    points = seen_in_world([table(), *bin_walls(0.36, 0.28, 0.1), *inside], T_world_camera)
    floor = {"normal": (0, 0, 1), "offset": 0.005}
    within = {"min": (-0.18, -0.14, 0.0), "max": (0.18, 0.14, 0.2)}
    found = detect(points, T_world_camera, support=floor, workspace=within)
    assert_grasped(found, inside, np.eye(4))


@pytest.mark.parametrize("roll", [0.5, np.pi])
def test_a_camera_turned_about_its_axis_sees_the_same_objects(roll: float) -> None:
    scene, pose = [table(), *boxes_on_table(4)], camera(0.6, -1.2, 0.9)
    turn = RigidTransform.from_rotation(Rotation.from_euler("z", roll)).as_matrix()
    places, planes = [], []
    for T_world_camera in (pose, pose @ turn):
        found = detect(render(scene, T_world_camera))
        centers = np.array([one.center for one in found.objects])
        places.append(to_world(T_world_camera, centers))
        planes.append(T_world_camera[:3, :3] @ found.support.normal)
    assert len(places[0]) == len(places[1]) == 4
    apart = np.linalg.norm(places[0][:, None] - places[1], axis=2).min(axis=1)
    assert apart.max() < 0.01
    np.testing.assert_allclose(planes[0], planes[1], atol=0.02)


def test_new_noise_leaves_the_number_of_objects_and_thinning_most_of_them() -> None:
    scene, pose = [table(), *FURNISHINGS["wall"], *boxes_on_table(5)], camera(0.7, -1.3, 0.9)
    assert {len(detect(render(scene, pose, seed)).objects) for seed in range(4)} == {4}
    cloud = render([table(), *boxes_on_table(6)], camera(0.6, -1.2, 0.9)).reshape(-1, 3)
    some = np.random.default_rng(0).choice(np.flatnonzero(np.isfinite(cloud[:, 0])), 20_000, False)
    found = detect(cloud[some])  # without rows
    assert len(found.objects) >= 3
    assert found.grasps


def test_a_mask_of_the_caller_wins() -> None:
    # Too long for an object, thin enough for a hand.
    panel = box((0.0, 0.22, 0.06), (0.3, 0.015, 0.06))
    boxes, pose = [panel, table(), *boxes_on_table(2)], camera(0.75, -1.5, 0.9)
    cloud = render(boxes, pose)
    mask = seen_box(boxes, pose) == 0
    assert detect(cloud).objects
    (segment,) = detect(CloudInput(cloud, segment_ids=mask.astype(np.int32))).objects
    assert segment.number == 1
    held = detect(cloud, **on_mask(mask.reshape(cloud.shape[:2]), {"min_score": 0.0}))
    assert held.grasps
    on_panel = cloud.reshape(-1, 3)[mask]
    for grasp in held.grasps:
        for point in (grasp.approach_point, grasp.contact_point):
            assert np.linalg.norm(on_panel - point, axis=1).min() < 0.006


def test_marked_objects_have_the_scores_they_have_without_a_mask(catalogue) -> None:
    carton = box((0.35, 0.3, 0.1), (0.05, 0.05, 0.1))
    cloud = render([table(), carton, *boxes_on_table(1)], camera(0.7, 0.0, 0.9))
    asked = {"viewpoint": (0.0, 0.0, 0.0), "debug": True}
    plain = catalogue.get().detect(cloud, parse_options(asked))
    assert plain.debug is not None
    assert len(plain.objects) > 2
    for one in plain.objects:
        region = {"include": [{"kind": "mask", "mask": plain.debug.labels == one.number}]}
        fields = parse_options(asked | {"approach_region": region, "contact_region": region})
        best = catalogue.get().detect(cloud, fields).grasps[0].score
        assert one.best_score == pytest.approx(best, abs=0.1)


def test_segments_stand_on_what_lies_below_them_not_on_the_top_of_a_carton() -> None:
    carton = box((-0.3, -0.3, 0.15), (0.4, 0.5, 0.15))
    small = box((0.3, 0.2, 0.05), (0.02, 0.02, 0.05))
    boxes, pose = [small, carton, table(0.8, 0.7)], camera(0.9, -np.pi / 2, 0.9)
    segments = (seen_box(boxes, pose) == 0).astype(np.int32)
    found = detect(CloudInput(render(boxes, pose), segment_ids=segments))
    assert found.grasps
    height = (small.center - pose[:3, 3]) @ pose[:3, :3] @ found.support.normal
    assert height - found.support.offset == pytest.approx(small.half[2], abs=0.005)


@pytest.mark.parametrize("times", [1, 4])  # the latter as large as those that lose pixels
def test_every_row_is_labelled_with_an_object_the_support_or_neither(times: int) -> None:
    objects, pose = boxes_on_table(7), camera(0.7, -1.2, 0.85)
    boxes = [table(), *objects, *FURNISHINGS["floor"]]
    image = render(boxes, pose)
    found = detect(image.repeat(times, axis=0).repeat(times, axis=1), debug=True)
    labels, number = found.debug.labels, seen_box(boxes, pose)
    labels = labels.reshape(times * len(image), -1)[times - 1 :: times, times - 1 :: times].ravel()
    assert set(labels[labels >= 0].tolist()) == {one.number for one in found.objects}
    assert (labels[number == 0] == SUPPORT).mean() > 0.95
    assert (labels[np.isin(number, [-1, 5])] < 0).all()
    assert (labels[number == 5] != SUPPORT).mean() > 0.95


CAMERA = np.array([0.0, -0.5, 0.4])
PLANE = {"normal": (0.0, 0.0, 1.0), "offset": 0.05, "max_depth_error": 0.12}


def table_with_box(rng: np.random.Generator, table: int = 2000) -> np.ndarray:
    """A table at z = 0.05, and on it a box with a level lid 0.06 above."""
    flat = rng.uniform(-0.15, 0.15, (table, 3)) * (1, 1, 0)
    box = rng.uniform(-0.05, 0.05, (1000, 3)) + np.array([0, 0, 0.05])
    box[:500, 2] = 0.06
    points = np.concatenate([flat, box]) + np.array([0, 0, 0.05])
    return points + rng.normal(0, 0.001, points.shape)


def chosen_support(background: np.ndarray, objects: np.ndarray, camera: object) -> Any:
    """The support where all background is classified as such, and the warnings."""
    points = np.concatenate([background, objects])
    points += np.random.default_rng(0).normal(0, 0.001, points.shape)
    number = np.repeat([BACKGROUND, 0], [len(background), len(objects)])
    up, of_object = np.array([0.0, 0.0, 1.0]), (number == 0).astype(np.float32)
    shown = Segmentation(number, of_object, 1 - of_object, np.ones(1), up)
    seen = seen_from(points.astype(np.float32), np.array(camera))
    inside = np.ones(len(points), bool)
    warnings: list[str] = []
    return find_support(seen, inside, shown, parse_options({}), warnings), warnings


@pytest.mark.parametrize("seed", range(4))
def test_the_floor_of_a_bin_counts_and_not_the_table_beside_it(seed: int) -> None:
    """Its floor is 12 mm over a table that is seen to one side, with as many points."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform((-0.2, -0.15, 0.012), (0.2, 0.15, 0.012), (4000, 3))
    table = rng.uniform((0.22, -0.3, 0.0), (0.6, 0.3, 0.0), (4000, 3))
    held = rng.uniform((-0.04, -0.04, 0.02), (0.04, 0.04, 0.06), (500, 3))
    found, _ = chosen_support(np.concatenate([floor, table]), held, (0.0, -0.5, 0.8))
    assert np.abs(heights_over(found.plane, floor[np.abs(floor[:, 0]) < 0.1])).max() < 0.001
    assert found.share == pytest.approx(8000 / 8500, abs=0.01)  # of all points


@pytest.mark.parametrize("below", [0.25, 0.9])  # the median is over the lid, or under it
def test_a_lid_that_a_quarter_of_the_objects_lie_below_is_no_support(below: float) -> None:
    """The top of one object of a heap that fills the view is classified as support."""
    rng = np.random.default_rng(0)
    lid = rng.uniform((-0.2, 0.0, 0.1), (0.2, 0.2, 0.1), (2000, 3))
    height = np.where(rng.random(4000) < below, 0.04, 0.14)
    heap = np.column_stack([rng.uniform((-0.2, -0.2), (0.2, 0.0), (4000, 2)), height])
    found, warnings = chosen_support(lid, heap, (0.0, 0.0, 0.8))
    assert found is None
    assert "no support plane is seen" in warnings[0]


def seen_wrong(points: np.ndarray, factor: float) -> np.ndarray:
    """The points as a camera sees them whose depths are wrong by a factor."""
    return (CAMERA + factor * (points - CAMERA)).astype(np.float32)


def built(points: np.ndarray, **support: object) -> tuple[np.ndarray, list[str]]:
    """What is left above the plane, in the cloud's frame, and the warnings."""
    warnings: list[str] = []
    workspace = {"min": (-0.15, -0.15, 0.055), "max": (0.15, 0.15, 0.3)}
    where = {"viewpoint": CAMERA.tolist(), "workspace": workspace, "objects": "off"}
    options = parse_options({"support": PLANE | support} | where)
    selected = select_points(check_cloud(points.astype(np.float32)), options, 0.0, {}, warnings)
    found = build_scene(selected, options, 0.004, {})
    assert len(found.readings) == len(points)  # whatever the workspace
    if options.support.max_depth_error > 0:
        assert found.readings[:, 2].min() > 0.04 or "taken as" in warnings[0]
    return found.points_in_cloud, warnings


def test_a_scene_is_the_same_after_wrong_depths_where_that_is_asked_for() -> None:
    points = table_with_box(np.random.default_rng(4))
    (right, quiet), (corrected, said) = built(points), built(seen_wrong(points, 1.06))
    assert (len(quiet), len(said)) == (0, 1)
    assert abs(len(right) - len(corrected)) < 0.05 * len(right)
    np.testing.assert_allclose(right.max(axis=0), corrected.max(axis=0), atol=0.004)
    np.testing.assert_allclose(right.min(axis=0), corrected.min(axis=0), atol=0.004)
    wrong, quiet = built(seen_wrong(points, 1.06), max_depth_error=0.0)
    assert quiet == []
    assert abs(wrong[:, 2].max() - right[:, 2].max()) > 0.008


def test_parts_of_a_table_that_was_cut_off_show_the_scale_and_one_cut_away_is_missed() -> None:
    """Depths too small by 5 % lift the table 2 cm over the height at which the cloud was cut."""
    points = table_with_box(np.random.default_rng(6))
    seen = seen_wrong(points, 0.95)
    (right, _), (corrected, said) = built(points), built(seen[seen[:, 2] > 0.055])
    assert "multiplied by 1.05" in said[0]
    np.testing.assert_allclose(right.max(axis=0), corrected.max(axis=0), atol=0.004)
    points = table_with_box(np.random.default_rng(5), table=0)[500:]
    _, warnings = built(points[points[:, 2] > 0.08])
    assert len(warnings) == 1
    assert "options.support.max_depth_error (0.12)" in warnings[0]


def test_depths_are_scaled_by_no_more_than_is_allowed() -> None:
    _, warnings = built(seen_wrong(table_with_box(np.random.default_rng(4)), 0.88))
    assert "are used as sent" in warnings[0]


def test_the_flat_top_of_an_object_is_no_table_by_which_depths_are_scaled() -> None:
    top = np.random.default_rng(8).uniform((-0.07, -0.07, 0.07), (0.07, 0.07, 0.07), (2000, 3))
    left, warnings = built(top)
    assert "are used as sent" in warnings[0]
    np.testing.assert_allclose(left[:, 2], 0.07, atol=0.001)
    with refusal("options.viewpoint"):  # which scaling needs
        detector().detect(top, parse_options({"support": PLANE}))


def test_walls_of_a_cropped_bin_are_no_objects() -> None:
    pose, floor = camera(0.7, -1.5, 0.8), box((0, 0, -0.03), (1, 1, 0.03))
    boxes = [box((-0.05, 0, 0.04), (0.03,) * 3), box((0.07, 0.03, 0.03), (0.03,) * 3)]
    points = seen_in_world([*bin_walls(0.3, 0.22, 0.12), *boxes, floor], pose)
    found = detect(points[points[:, 2] > 0.012], pose, up=[0, 0, 1])
    assert max(2 * one.half_extents.max() for one in found.objects) < 0.15


def test_a_known_up_keeps_the_support_level() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-0.3, 0.3, 0.004), np.arange(0, 0.03, 0.004)))
    strips = [np.stack([x, y + back, 0 * x + z], 1) for back, z in ((0.0, 0.0), (0.3, 0.1))]
    points = np.concatenate(strips).astype(np.float32)
    ones, up = np.ones(len(points), np.float32), np.array([0.0, 0.0, 1.0])
    shown = Segmentation(np.full(len(points), -2), 0 * ones, ones, np.empty(0), up)
    seen = seen_from(points, np.array([0.0, -0.8, 0.25]))
    found = find_support(seen, ones > 0, shown, parse_options({"up": (0, 0, 1)}), [])
    assert found is not None
    assert np.degrees(np.arccos(found.frame.T_canonical_cloud[2, 2])) < 5
