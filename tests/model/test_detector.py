"""A cloud in, ranked grasps out; and the catalogue of models."""

import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.checks import refusal

from edgegrasp_camera.depth import DepthView, Intrinsics, fuse_depth_images
from edgegrasp_model.candidates.collision import collides
from edgegrasp_model.candidates.edge_grasps import centred_grasps, crop_balls, edge_grasps
from edgegrasp_model.detector import GraspDetector, ModelCatalogue, choose_device
from edgegrasp_model.errors import InvalidCheckpoint, InvalidDevice, UnknownModel
from edgegrasp_model.gripper import gripper_fields, load_gripper
from edgegrasp_model.kernels import mean_over_similar
from edgegrasp_model.networks.checkpoint import save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.options import Box, Collision, DetectOptions, parse_options
from edgegrasp_model.ranking import densest_first, detected_objects, ranked
from edgegrasp_model.results import Outcome
from edgegrasp_model.scene import network
from edgegrasp_model.scene.cloud import CanonicalFrame, Cloud, CloudInput, pose_matrix
from edgegrasp_model.scene.obstacles import SolidBoxes
from edgegrasp_model.scene.segment import BACKGROUND
from edgegrasp_results import Detection, Grasp
from edgegrasp_training.recipes import build_network

from . import rendered
from .rendered import (
    FOCAL_LENGTH,
    HEIGHT,
    WIDTH,
    box,
    boxes_on_table,
    camera,
    render,
    table,
    to_world,
)
from .scenes import PANDA, TINY, box_on_table, detector, grid, scene_of

CLOUD = box_on_table()
ASKED = {"viewpoint": (0.3, 0.0, 0.5), "support": {"normal": (0.0, 0.0, 1.0), "offset": 0.0}}
NOWHERE = {"min": (1, 1, 1), "max": (2, 2, 2)}
WALL = {"kind": "box", "min": [-1, -1, -1], "max": [1, 1, 1]}  # holds every hand
LID = [{"kind": "box", "min": (-0.5, -0.5, 0.09), "max": (0.5, 0.5, 0.2)}]


def detect(cloud: object = CLOUD, **fields: object) -> Detection:
    return detector().detect(cloud, DetectOptions.model_validate(ASKED | fields))


def same(one: Detection, other: Detection) -> bool:
    return len(one.grasps) == len(other.grasps) and all(
        a.score == b.score and np.array_equal(a.T_cloud_hand, b.T_cloud_hand)
        for a, b in zip(one.grasps, other.grasps, strict=True)
    )


def test_the_seed_decides_not_the_order_of_the_points_or_an_empty_previous() -> None:
    first = detect(seed=0, sampling="uniform")  # zero is a seed
    assert same(first, detect(seed=0, sampling="uniform"))
    assert not same(first, detect(seed=1, sampling="uniform"))
    for mode in ("avoid", "penalise", "ignore"):
        assert same(detect(collision=mode), detect(collision=mode, previous={}))
    one, other = detect(), detect(np.random.default_rng(5).permutation(CLOUD))
    assert one.counts == other.counts
    for a, b in zip(one.grasps, other.grasps, strict=True):
        np.testing.assert_allclose(a.T_cloud_hand, b.T_cloud_hand, atol=1e-4)


@pytest.mark.parametrize("search", [True, False])
def test_what_left_the_view_is_lost_and_what_is_of_another_frame_is_refused(search: bool) -> None:
    first = detect(previous={})
    hand, surface = first.grasps[0].T_cloud_hand, first.objects[0].surface

    def again(scale: float = 1.0, shift: object = 0.0, **fields: object) -> Detection:
        pose = hand.astype(np.float64)
        pose[:3, 3] = scale * pose[:3, 3] + shift
        known = {"number": 0, "surface": (scale * surface + shift).ravel().tolist()}
        grasps = [{"id": 7, "T_cloud_hand": pose.ravel().tolist(), "object": 0}]
        asked = {"gripper": "panda", "grasps": grasps, "objects": [known], "search": search}
        return detect(previous=asked, **fields)

    assert again().tracking.first == "kept"
    for away in ((0.9, 0.0, 0.0), (0.0, -1.2, 0.3)):  # the camera moves with all that it sees
        moved = {"cloud": CLOUD + np.float32(away), "viewpoint": np.add((0.3, 0.0, 0.5), away)}
        assert again(**moved).tracking.first == "lost"
    for wrong in ({"shift": (-0.5, 0.0, -0.9)}, {"shift": 2.0}, {"scale": 1000.0}):
        with refusal("options.previous", "nearest point of the cloud"):
            again(**wrong)


def test_no_loop_is_compiled_again_for_the_read_only_cloud_of_a_message() -> None:
    cloud = CLOUD.astype(np.float32)
    found = detect(cloud, support="auto")
    before = network._render.signatures[:]  # type: ignore[attr-defined]  # of Numba
    cloud.setflags(write=False)
    assert same(found, detect(cloud, support="auto"))
    assert network._render.signatures == before != []  # type: ignore[attr-defined]


def test_an_obstacle_may_be_as_thin_as_a_number_is() -> None:
    plate = {"kind": "box", "min": (0.1, -0.1, 0.0), "max": (0.2, 0.1, 1e-300)}
    found = detect(collision={"mode": "ignore", "obstacles": [plate]})
    assert found.grasps
    assert all(np.isfinite(grasp.clearance) for grasp in found.grasps)


def test_several_depth_images_show_each_object_once() -> None:
    boxes = [table(), *boxes_on_table(1)]
    poses = [camera(0.7, turn, 0.9) for turn in (0.0, 2.1, 4.2)]
    intrinsics = Intrinsics(FOCAL_LENGTH, FOCAL_LENGTH, WIDTH / 2, HEIGHT / 2)
    depths = [render(boxes, pose)[..., 2] for pose in poses]
    cloud = fuse_depth_images(depths, [DepthView(intrinsics, pose) for pose in poses])
    found = detector().detect(cloud)
    assert len(found.objects) == 4
    assert found.grasps
    assert not found.warnings


def test_each_camera_has_its_own_noise() -> None:
    boxes, above = [table(), *boxes_on_table(0)], []
    views = [(camera(0.5, -1.5, 0.5), 1), (camera(0.5, 1.5, 2.0), 3)]
    depths = [render(boxes, pose, zoom=zoom)[..., 2] for pose, zoom in views]
    middle = WIDTH / 2, HEIGHT / 2
    poses = [DepthView(Intrinsics(*(zoom * FOCAL_LENGTH,) * 2, *middle), at) for at, zoom in views]
    for part in (slice(0, 1), slice(1, 2), slice(0, 2)):
        found = detector().detect(fuse_depth_images(depths[part], poses[part]))
        above.append(found.counts["above_support"])
    assert above[2] < 1.1 * (above[0] + above[1])


def test_objects_of_a_few_scattered_points_are_none() -> None:
    places = np.random.default_rng(0).uniform(-0.02, 0.02, (20_000, 2))
    plate = np.column_stack([places, np.full(20_000, 0.01)])
    ids = (np.arange(20_000) % 100 == 0).astype(int)
    found = detect(CloudInput(plate, segment_ids=ids))
    assert not found.grasps
    assert "no object" in found.warnings[-1]


def test_normals_that_contradict_each_other_are_estimated() -> None:
    sheet = np.random.default_rng(0).uniform(-0.1, 0.1, (3000, 3)).astype(np.float32)
    sheet[:, 2] = 0.3
    normals = np.repeat([(1.0, 0.0, 0.0), (-1.0, 1e-3, 0.0)], 3000, axis=0)
    asked = {"support": None, "objects": "off", "debug": True}
    found = detect(CloudInput(np.concatenate([sheet, sheet]), normals), **asked)
    assert (found.debug.normals[:, 2] > 0.99).all()


def test_each_camera_orients_the_normals_of_what_it_saw() -> None:
    sheets = np.random.default_rng(0).uniform(-0.1, 0.1, (6000, 3)).astype(np.float32)
    sheets[:, 2] = np.repeat([0.3, 0.2], 3000)
    cameras = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
    asked = {"viewpoint": cameras, "support": None, "objects": "off", "debug": True}
    found = detect(CloudInput(sheets, view_ids=np.repeat([0, 1], 3000)), **asked)
    upper = found.debug.points[:, 2] > 0.25
    assert (found.debug.normals[upper, 2] > 0.99).all()
    assert (found.debug.normals[~upper, 2] < -0.99).all()
    with refusal("view_ids", "nothing, for 2 viewpoints"):
        detect(sheets, **asked)
    for views, value in (([0, 2], "values from 0 to 2"), ([-1, 1], "values from -1 to 1")):
        with refusal("view_ids", value):
            detect(CloudInput(sheets, view_ids=np.repeat(views, 3000)), **asked)


def test_a_raw_cloud_is_seen_from_its_origin_and_the_answer_says_so(catalogue) -> None:
    cloud = render([table(), *boxes_on_table(1)], camera(0.7, 0.0, 0.9)).reshape(-1, 3)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    network = catalogue.get("edgegrasp-plus")
    given = network.detect(cloud, DetectOptions(viewpoint=(0.0, 0.0, 0.0)))
    assumed = network.detect(cloud)
    assert same(given, assumed)
    assert len(assumed.grasps) > 0
    assert any("the camera is assumed at the origin" in each for each in assumed.warnings)
    # Not below a table that is given.
    above = to_world(camera(0.7, 0.0, 0.9), cloud) + np.array([0.0, 0.0, 1.0])
    support = {"normal": (0.0, 0.0, 1.0), "offset": 1.0}
    found = network.detect(above, DetectOptions.model_validate({"support": support}))
    assert found.grasps[0].score > 0.8


def test_one_of_the_objects_by_number_by_pixel_or_by_place(catalogue) -> None:
    boxes, pose = boxes_on_table(1), camera(0.7, 0.0, 0.9)
    image = render([table(), *boxes], pose)
    network = catalogue.get("edgegrasp-plus")

    def objects(**asked: object) -> set[int]:
        fields = {"viewpoint": (0.0, 0.0, 0.0), "seed": 3} | asked
        found = network.detect(image, DetectOptions.model_validate(fields))
        assert {grasp.object for grasp in found.grasps} <= {each.number for each in found.objects}
        assert found.grasps or any(str(name) in "".join(found.warnings) for name in asked)
        return {each.number for each in found.objects}

    every = network.detect(image, DetectOptions(viewpoint=(0.0, 0.0, 0.0)))
    numbers = {each.number for each in every.objects}
    assert not any(each.reason for each in every.objects if (each.best_score or 0.0) > 0.5)
    one = every.grasps[0].object
    assert objects(objects={"include": [one]}) == {one}
    assert objects(objects={"exclude": [one]}) == numbers - {one}
    assert objects(objects={"include": [99]}) == set()
    place = next(each.center for each in every.objects if each.number == one)
    assert objects(near=place.tolist()) == {one}
    assert objects(near=(0.75 * place).tolist()) == set()
    u, v = FOCAL_LENGTH * place[:2] / place[2] + (WIDTH / 2, HEIGHT / 2)
    assert objects(at=(u, v)) == {one}
    assert objects(at=(0, 0)) == set()
    with refusal("options.at"):
        objects(at=(WIDTH, 0))
    image = image.reshape(-1, 3)[np.isfinite(image).all(axis=2).ravel()]
    with refusal("options.at", "not an image"):
        objects(at=(u, v))


def test_no_grasp_is_an_answer_that_says_why() -> None:
    nothing = detect(workspace=NOWHERE, debug=True)
    assert nothing.grasps == []
    assert nothing.debug is None
    assert nothing.counts["in_workspace"] == nothing.counts["returned"] == 0
    assert any("0 points remain" in warning for warning in nothing.warnings)

    apart = [[0, 0, 0.1], [0.2, 0, 0.1], [0, 0.2, 0.1], [0.2, 0.2, 0.1], [0.1, 0.1, 0.2]]
    alone = detect(np.float32(apart), num_approach_points=5, objects="off")
    assert alone.grasps == []
    assert alone.counts["kept"] == 5
    assert alone.counts["pairs"] == alone.counts["approach_points"]  # each alone in its ball
    assert alone.counts["candidates"] == 0
    assert any("see counts" in warning for warning in alone.warnings)

    far = {"kind": "sphere", "center": [1, 1, 1], "radius": 0.1}
    nowhere = detect(debug=True, approach_region={"include": [far]})
    assert nowhere.debug.outcome == []
    assert nowhere.counts["in_approach_region"] == 0
    assert any("approach region" in warning for warning in nowhere.warnings)

    high, tilted = ({"normal": up, "offset": 0.2} for up in ((0.0, 0.0, 1.0), (0.0, 0.6, 0.8)))
    for below in ({"support": high}, {"support": tilted, "workspace": NOWHERE}):
        found = detect(**below)
        assert (found.grasps, found.counts["above_support"]) == ([], 0)

    assert detect(min_score=1.0).grasps == []


@pytest.mark.parametrize(("mode", "returned"), [("avoid", 0), ("penalise", 1), ("ignore", 1)])
def test_where_every_hand_collides_further_points_are_tried_and_hands_are_marked(mode, returned):
    collision = {"mode": mode, "obstacles": [WALL]}
    found = detect(collision=collision, num_approach_points=4, debug=True)
    assert bool(found.grasps) == returned
    assert not any(grasp.collision_free for grasp in found.grasps)
    assert all(grasp.clearance < 0 for grasp in found.grasps)
    assert found.counts["approach_points"] == (4 if mode == "ignore" else 12)  # three attempts
    assert len(found.debug.outcome) == found.counts["candidates"]
    if mode == "avoid":
        assert Counter(found.debug.outcome)[Outcome.COLLISION] == found.counts["checked"]


def detect_beside(wall: np.ndarray, **fields: object) -> list[Grasp]:
    """Grasps of the box beside more points, inside a workspace that contains the box alone."""
    cloud = np.concatenate([CLOUD, wall]).astype(np.float32)
    sent = CloudInput(cloud, segment_ids=(np.arange(len(cloud)) < len(CLOUD)).astype(int))
    where = {"min": (-0.3, -0.3, 0.0), "max": (0.03, 0.3, 0.2)}
    asked = {"viewpoint": (0.1, 0.5, 0.5), "min_score": 0.0, "workspace": where}
    return detect(sent, **asked | fields).grasps


def test_a_lift_is_checked_to_its_end() -> None:
    board = grid(np.arange(-0.3, 0.3, 0.004), np.arange(-0.3, 0.3, 0.004), [0.5])
    down = {"cones": [{"direction": (0, 0, -1), "max_angle": 0.3}]}
    for length, found in ((0.1, True), (0.4, False)):
        lift = {"retreat_length": length, "retreat_direction": "up"}
        assert bool(detect_beside(board, collision=lift, approach_direction=down)) == found


def test_the_back_of_a_long_hand_is_checked_beyond_the_workspace() -> None:
    wall = grid([0.34], np.arange(-0.3, 0.3, 0.004), np.arange(0, 0.3, 0.004))
    long = gripper_fields("panda")
    long["hand"]["boxes"].append([[-0.045, -0.045, -0.2], [0.045, 0.045, -0.026]])
    side = {"cones": [{"direction": (-1, 0, 0), "max_angle": 0.2}]}
    for moved, found in ((0.3, True), (0.0, False)):
        beside = wall + np.array([moved, 0.0, 0.0])
        assert bool(detect_beside(beside, approach_direction=side, gripper=long)) == found


def test_hands_stay_above_the_support_that_is_seen_not_the_one_that_is_given() -> None:
    cloud = box_on_table(table=True, size=(0.03, 0.03, 0.02))
    ends = grid(*PANDA.open_boxes[-1].T)  # of a finger
    for offset in (0.0, -0.006):
        found = detect(cloud, support={"normal": (0, 0, 1), "offset": offset}, min_score=0.0)
        assert found.grasps
        assert found.support.residual == pytest.approx(-offset, abs=1e-3)
        for one in found.grasps:
            assert (ends @ one.T_cloud_hand[2, :3] + one.T_cloud_hand[2, 3]).min() > -1e-3


def test_an_obstacle_beside_the_object_is_not_closed_on() -> None:
    best = detect().grasps[0]
    side = np.sign(best.T_cloud_hand[:3, 1] @ (best.T_cloud_tcp[:3, 3] - best.contact_point))
    place = best.contact_point - 0.008 * side * best.T_cloud_hand[:3, 1]
    post = {"kind": "box", "min": (place - 0.003).tolist(), "max": (place + 0.003).tolist()}
    found = detect(collision={"obstacles": [post]})
    assert found.grasps
    for grasp in found.grasps:
        x, y, z = np.linalg.inv(grasp.T_cloud_hand) @ np.append(place, 1.0) @ np.eye(4, 3)
        between = abs(x) < PANDA.pad_half_width and abs(y) < PANDA.max_opening / 2
        assert not (between and PANDA.palm_z < z < PANDA.tip_z)


def test_an_unknown_viewpoint_gets_a_warning_and_too_many_voxels_are_refused() -> None:
    found = detector().detect(CLOUD)
    assert found.grasps
    assert any("viewpoint" in warning for warning in found.warnings)
    assert "below the support plane" in detect(viewpoint=(0.3, 0.0, -0.5)).warnings[-1]
    with refusal("options.workspace"):
        detector().prepare(CLOUD, DetectOptions(), 100)


def test_debug_returns_the_cloud_and_every_candidate_with_what_became_of_it() -> None:
    found = detect(debug=True, min_score=0.3, top_k=5, num_candidates=200)
    debug, counts = found.debug, found.counts
    assert len(debug.points) == len(debug.normals) == counts["kept"]
    np.testing.assert_allclose(np.linalg.norm(debug.normals, axis=1), 1.0, atol=1e-5)
    assert len(debug.outcome) == len(debug.score) == len(debug.T_cloud_hand)
    assert len(debug.outcome) == counts["candidates"]
    np.testing.assert_allclose(debug.support_plane, [0, 0, 1, 0], atol=1e-6)
    tally = Counter(debug.outcome)
    assert tally[Outcome.RETURNED] == counts["returned"] == 5
    assert tally[Outcome.SUPPRESSED] == counts["suppressed"]
    for outcome, before, after in (
        (Outcome.LOW_SCORE, "scored", "above_min_score"),
        (Outcome.COLLISION, "checked", "collision_free"),
        (Outcome.NOT_SCORED, "collision_free", "scored"),
        (Outcome.NOT_CHECKED, "clear_of_support", "checked"),
        (Outcome.SUPPORT, "in_direction", "clear_of_support"),
        (Outcome.DIRECTION, "candidates", "in_direction"),
    ):
        assert tally[outcome] == counts[before] - counts[after], outcome
    scored = np.isfinite(debug.score)
    assert scored.sum() == counts["scored"]
    unscored = {Outcome.COLLISION, Outcome.DIRECTION, Outcome.SUPPORT, Outcome.NOT_CHECKED}
    returned = {grasp.T_cloud_hand.tobytes(): grasp for grasp in found.grasps}
    for row, outcome in enumerate(debug.outcome):
        assert not (scored[row] and outcome in unscored)
        assert outcome != Outcome.LOW_SCORE or debug.score[row] < 0.3
        if outcome == Outcome.RETURNED:
            grasp = returned[debug.T_cloud_hand[row].tobytes()]
            np.testing.assert_allclose(debug.score[row], grasp.score, atol=1e-6)
            ends = debug.points[[debug.approach_index[row], debug.contact_index[row]]]
            np.testing.assert_array_equal(ends, [grasp.approach_point, grasp.contact_point])
    assert detect().debug is None


def test_a_catalogue_finds_weights_by_their_file_name(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "mine.safetensors", detector().network, detector().metadata)
    catalogue = ModelCatalogue.load([tmp_path], default="mine")
    assert {"mine", "edgegrasp-plus"} <= {row["name"] for row in catalogue.describe()}
    assert catalogue.get("").metadata.name == "mine"
    assert catalogue.get("mine") is catalogue.get()
    facts = next(facts for facts in catalogue.describe() if facts["name"] == "mine")
    assert facts["default"] is True
    assert len(facts["digest"]) == 64
    mine = ModelCatalogue({"mine": catalogue.get()})
    mine.warm_up()
    with pytest.raises(UnknownModel, match="nobody"):
        mine.get("nobody")
    with pytest.raises(InvalidCheckpoint, match="default_model: got 'other'"):
        ModelCatalogue({"mine": catalogue.get()}, default="other")
    (tmp_path / "empty").mkdir()
    for place in ("empty", "absent"):
        with pytest.raises(InvalidCheckpoint, match=f"{place}, where there are none"):
            ModelCatalogue.load([tmp_path / place])
    with pytest.raises(InvalidCheckpoint):
        ModelCatalogue({})


@pytest.mark.parametrize(
    ("gpus", "name", "device"),
    [
        (2, "auto", "cuda:0"),
        (2, "cuda", "cuda:0"),
        (2, "cuda:1", "cuda:1"),
        (2, "cpu", "cpu"),
        (2, "cuda:2", None),
        (0, "auto", "cpu"),
        (0, "cuda", None),
        *((2, name, None) for name in ("gpu", "cuda:", "cuda:-1", "CPU", "", "mps")),
    ],
)
def test_a_device_is_chosen_only_where_it_is(monkeypatch, gpus, name, device) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    if device is not None:
        assert str(choose_device(name)) == device
    else:
        with pytest.raises(InvalidDevice, match=f"device: got '{name}'"):
            choose_device(name)


@pytest.mark.parametrize(
    ("cameras", "edge", "blocked"),
    [
        *(([-0.6], edge, blocked) for edge, blocked in ((-0.2, True), (0.06, True), (0.1, False))),
        *((places, -0.2, False) for places in ([0.6], [-0.6, 0.6], [])),
    ],
    ids=["behind a plate", "an end of it", "beside it", "before it", "on both sides", "unknown"],
)
def test_a_palm_in_space_that_no_camera_saw_counts_as_colliding(cameras, edge, blocked) -> None:
    plate = grid([-0.1], np.arange(edge, 0.2, 0.004), np.arange(-0.2, 0.3, 0.004))
    viewpoints = np.array([(x, 0.0, 0.0) for x in cameras], np.float32).reshape(-1, 3)
    behind = scene_of(plate.astype(np.float32), viewpoints=viewpoints)
    hand = np.eye(4, dtype=np.float32)[None]
    assert collides(behind, hand, np.float32([0.04]), PANDA, Collision()).tolist() == [blocked]


@pytest.mark.parametrize(("length", "blocked"), [(0.0, False), (0.01, False), (0.05, True)])
def test_unseen_space_is_entered_only_on_the_approach_asked_for(length, blocked) -> None:
    plate = grid([-0.1], np.arange(-0.2, 0.2, 0.004), np.arange(-0.3, -0.03, 0.004))
    eye = np.float32([[-0.6, 0.0, 0.0]])
    hand, asked = np.eye(4, dtype=np.float32)[None], Collision(approach_length=length)
    above = scene_of(plate.astype(np.float32), viewpoints=eye)
    assert collides(above, hand, np.float32([0.04]), PANDA, asked).tolist() == [blocked]


def test_fingers_that_swing_forward_hit_what_is_ahead_of_them() -> None:
    swinging, hand = load_gripper("robotiq-2f-140"), np.eye(4, dtype=np.float32)[None]
    tips = swinging.tip_z + swinging.furthest_advance(0.03)
    ahead = Box(min=(-0.5, -0.5, tips - 0.01), max=(0.5, 0.5, tips + 0.1))
    solid = SolidBoxes.from_shapes([ahead], CanonicalFrame(np.eye(4)))
    plate = grid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.02, 0.02, 9), [tips - 0.005])
    beside = np.full(len(plate), BACKGROUND)
    for scene in (
        scene_of(np.ones((1, 3), np.float32), obstacles=solid),
        scene_of(plate.astype(np.float32), object_of_point=beside),
    ):
        for opening, hit in ((0.04, True), (0.14, False)):
            found = collides(scene, hand, np.float32([opening]), swinging, Collision())
            assert found.tolist() == [hit]


def test_centred_hands_hold_objects_at_the_same_depth() -> None:
    gripper, x = load_gripper("robotiq-2f-85"), np.arange(-0.03, 0.03, 0.004)
    sides = [grid(x, [y], np.arange(-0.03, 0.0, 0.004)) for y in (-0.037, 0.037)]
    count, top = len(sides[0]), grid(x, np.arange(-0.034, 0.035, 0.004), [0.0])
    points = np.concatenate([*sides, top]).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    normals[:count], normals[count : 2 * count] = (0, -1, 0), (0, 1, 0)
    rows = np.arange(2 * count, len(points))
    crop = crop_balls(points, rows, 0.05)
    of_ball = rows[crop.ball_of_point], crop.ball_rows
    found, _ = edge_grasps(Cloud(points, normals), *of_ball, gripper)
    moved = centred_grasps(points, crop, found, gripper)
    hands = moved.T_cloud_hand
    outward = points[moved.contact_index] - hands[:, :3, 3]
    depth = np.einsum("ed,ed->e", outward, hands[:, :3, 2])
    np.testing.assert_allclose(depth, gripper.contact_z_at(moved.opening), atol=1e-4)


def test_hands_that_reach_out_of_the_image_come_last() -> None:
    left, right, top, bottom = 80, 250, 60, 200  # through the objects' surroundings
    image = rendered.SCENE[top:bottom, left:right]
    found = convinced(50.0).detect(image, DetectOptions(viewpoint=(0.0, 0.0, 0.0)))
    assert len(found.objects) == 4
    for grasp in found.grasps[:4]:
        ends = grasp.T_cloud_hand @ np.array([[0, -0.1, 0, 1], [0, 0.1, 0, 1]]).T
        column, row = ends[:2] / ends[2] * FOCAL_LENGTH
        assert (abs(column + WIDTH / 2 - (left + right) / 2) < (right - left) / 2).all()
        assert (abs(row + HEIGHT / 2 - (top + bottom) / 2) < (bottom - top) / 2).all()


def convinced(logit: float) -> GraspDetector:
    """A detector to which all grasps seem equally good."""
    network = build_network(TINY["hand"])
    with torch.no_grad():
        list(network.parameters())[-1].fill_(logit)  # the bias of the last layer
    return GraspDetector(network, CheckpointMetadata("no", TINY["hand"], 0.0045, "panda"))


@pytest.mark.parametrize(
    ("size", "options", "reason"),
    [
        ((0.10, 0.13, 0.10), {}, "too-wide"),
        ((0.03, 0.05, 0.008), {}, "too-flat"),
        ((0.04, 0.06, 0.08), {"collision": {"obstacles": LID}}, "blocked"),
        ((0.04, 0.06, 0.03), {"collision": {"margin": 0.05}}, "blocked"),  # by the support
        ((0.04, 0.06, 0.08), {"collision": {"obstacles": LID}, "num_candidates": 1}, None),
        ((0.04, 0.06, 0.08), {"viewpoint": (1.0, 0.0, 0.04)}, "hidden"),
        ((0.04, 0.06, 0.08), {"viewpoint": None}, "hidden"),  # from where it is assumed
    ],
)
def test_an_object_without_a_good_grasp_has_a_reason(size, options, reason) -> None:
    known = ASKED | {"viewpoint": (0.3, 0.2, 0.5), "objects": "off"}
    asked = parse_options(known | {"approach_direction": {"preset": "top-down"}} | options)
    (single,) = convinced(-50.0).detect(box_on_table(3000, size=size), asked).objects
    assert single.reason == reason


def test_objects_far_apart_have_a_hidden_side() -> None:
    two = [box_on_table(3000) + np.float32([0.0, y, 0.0]) for y in (-0.7, 0.7)]
    floor = grid(np.linspace(-0.1, 0.1, 40), np.linspace(-0.9, 0.9, 300), [0.0])
    known = ASKED | {"viewpoint": (0.8, 0.0, 0.1), "objects": "off"}
    asked = parse_options(known | {"approach_direction": {"preset": "top-down"}})
    found = convinced(50.0).detect(np.concatenate([*two, floor]).astype(np.float32), asked)
    hidden = [grasp.far_side_hidden for grasp in found.grasps]
    assert np.mean(hidden) > 0.5


@pytest.mark.parametrize("second", [False, True])
def test_a_camera_that_looks_elsewhere_does_not_see_an_object(second: bool) -> None:
    box = box_on_table(3000)
    floor = np.random.default_rng(0).uniform((-1.1, -0.9, 0), (-0.9, -0.7, 0), (2000, 3))
    views = np.repeat(np.int64([0, 1]), [len(box), len(floor)])
    eyes = [(1.0, 0.0, 0.04), (-1.0, -0.8, 0.5)]
    known = ASKED | {"objects": "off", "approach_direction": {"preset": "top-down"}}
    asked = parse_options(known | {"viewpoint": eyes if second else eyes[0]})
    both = CloudInput(np.concatenate([box, floor]).astype(np.float32), view_ids=views)
    (one,) = convinced(-50.0).detect(both if second else box, asked).objects
    assert one.reason == "hidden"


@pytest.mark.parametrize("options", [{"approach_direction": {"preset": "side"}}, {}])
def test_a_high_box_of_which_only_the_top_is_seen_is_not_flat(options) -> None:
    cloud = box_on_table(3000, size=(0.04, 0.06, 0.10))
    z = cloud[:, 2]
    top = cloud[(z > z.max() - 0.002) | (z < z.min() + 0.004)]
    known = ASKED | {"viewpoint": (0.0, 0.0, 0.9), "objects": "off", "collision": {"margin": 0.05}}
    (one,) = convinced(-50.0).detect(top, parse_options(known | options)).objects
    assert one.reason != "too-flat"


def test_an_object_that_is_narrow_in_one_direction_is_not_too_wide() -> None:
    """The smallest rectangle around this triangle is 93 mm wide; its least width is 75 mm."""
    places = np.random.default_rng(0).uniform(-0.2, 0.2, (40_000, 2))
    x, y = places.T + np.array([[0.035], [0.04]])
    top = (x > 0) & (y > 0) & (x / 0.100 + y / 0.115 < 1) & (x < 0.088) & (y < 0.100)
    cloud = np.column_stack([places, np.where(top, 0.04, 0.0)]).astype(np.float32)
    known = ASKED | {"viewpoint": (0.0, 0.0, 0.9), "objects": "off", "collision": {"margin": 0.05}}
    (one,) = convinced(-50.0).detect(cloud, parse_options(known)).objects
    assert one.reason == "blocked"


def test_labels_name_the_followed_objects_without_a_search() -> None:
    asked, network = {"viewpoint": (0.0, 0.0, 0.0), "debug": True}, convinced(50.0)
    first = network.detect(rendered.SCENE, parse_options(asked | {"previous": {}}))
    assert first.support is not None
    objects = [
        {"number": one.number, "surface": one.surface.ravel().tolist()}
        for one in first.objects
        if one.surface is not None
    ]
    best = first.grasps[0]
    pose = best.T_cloud_hand.ravel().tolist()
    grasps = [{"id": best.id, "T_cloud_hand": pose, "object": best.object}]
    previous = {"gripper": "panda", "search": False, "grasps": grasps, "objects": objects}
    plane = {"normal": first.support.normal.tolist(), "offset": first.support.offset}
    follow = {"previous": previous, "support": plane, "up": first.up.tolist()}
    found = network.detect(rendered.SCENE, parse_options(asked | follow))
    assert found.debug is not None
    named, count = np.unique(found.debug.labels[found.debug.labels >= 0], return_counts=True)
    assert {one.number for one in found.objects} == {*named.tolist()} == {0, 1, 2, 3}
    assert count.min() > 100


def test_an_object_of_many_points_in_an_upright_line_has_a_box() -> None:
    side = np.arange(-0.5, 0.5, 0.005)
    scene = scene_of(grid([0.5], side, side).astype(np.float32))
    start = time.process_time()
    (one,) = detected_objects(scene, [], None, np.empty(0), PANDA)
    np.testing.assert_allclose(sorted(one.half_extents), [0.0, 0.4975, 0.4975], atol=1e-6)
    assert time.process_time() - start < 5.0  # 30 s if all points are corners


def hands(places: list[float], turns: list[float]) -> np.ndarray:
    """Upright hands along x, turned about the approach, radians.  # (E, 4, 4)."""
    turned = Rotation.from_euler("z", np.reshape(turns, (-1, 1))).as_matrix()
    return pose_matrix(turned, np.outer(places, (1, 0, 0))).astype(np.float32)


def test_hands_are_averaged_with_others_on_the_same_object_that_are_near_and_turned_alike() -> None:
    poses = hands([0.0, 0.01, 0.02, 0.1, 0.01, 0.01], [0.0, 0.1, np.pi, 0.0, 0.0, 1.0])
    logits = np.array([3.0, -1.0, -2.0, 2.0, 5.0, 7.0], dtype=np.float32)
    number = np.array([0, 0, 0, 0, 1, 0])  # the fifth is on another object
    found = mean_over_similar(logits, poses, number, 0.03, 0.5)
    np.testing.assert_allclose(found[:3], [-1.5, 0.5, 1.0], atol=1e-6)
    assert np.isnan(found[3:]).all()


def test_a_colliding_hand_comes_after_the_same_hand_that_is_free() -> None:
    outside = np.eye(4)[[3, 3, 0]] * (0, 0, 0, 1)  # no image contains it
    scene = scene_of(np.zeros((4, 3), np.float32), P_image_cloud=outside)
    alike = hands([1.0, 1.0], [0.0, 0.0]), np.full(2, 0.31), np.array([False, True])
    order, _ = ranked(scene, np.zeros(2, int), *alike, PANDA, DetectOptions(), None)
    assert order[0] == 1


def test_a_hand_among_good_ones_comes_before_a_lone_one_that_is_hardly_better() -> None:
    poses, order = hands([0.0, 0.01, 0.02, 0.2], [0.0] * 4), np.array([3, 1, 0, 2])
    for lone, first in ((0.92, 1), (0.99, 3)):
        worth = np.array([0.9, 0.91, 0.9, lone])
        assert densest_first(order, worth, poses)[0] == first


def test_an_object_is_whole_at_a_side_beyond_which_the_table_is_seen() -> None:
    T_world_camera = camera(0.7, -1.5, 0.7)
    cloud = to_world(
        T_world_camera, render([table(), box((0, 0, 0.05), (0.03, 0.03, 0.05))], T_world_camera)
    ).astype(np.float32)
    where = {"min": (-0.2, -0.2, -0.05), "max": (0.032, 0.2, 0.3)}
    asked = parse_options({"viewpoint": T_world_camera[:3, 3].tolist(), "workspace": where})
    for sent, cut in ((cloud, False), (cloud[cloud[..., 0] < 0.032], True)):
        scene = detector().prepare(sent, asked).scene
        assert scene is not None
        assert scene.at_side.any() == cut


def test_grasps_of_a_marked_object_are_scored_as_they_were_found() -> None:
    bar, block = box((0, 0, 0.03), (0.26, 0.025, 0.03)), box((0.1, 0.15, 0.03), (0.02, 0.03, 0.03))
    T_world_camera = camera(0.7, -1.5, 0.9)
    cloud = to_world(T_world_camera, render([table(), bar, block], T_world_camera))
    mask = (bar.distance(cloud.reshape(-1, 3)) < 0.004) & (np.abs(cloud[..., 0]).ravel() < 0.08)
    mask &= cloud[..., 2].ravel() > 0.01
    region = {"include": [{"kind": "mask", "mask": mask.tolist()}]}
    known = {"viewpoint": T_world_camera[:3, 3].tolist(), "min_score": 0.0}
    asked = parse_options(known | {"approach_region": region})
    found = detector().detect(cloud.astype(np.float32), asked).grasps
    poses = np.stack([grasp.T_cloud_hand for grasp in found])
    scored = detector().score(cloud.astype(np.float32), asked, hand_poses=poses).evaluations
    for mine, theirs in zip(scored, found, strict=True):
        assert mine.grasp is not None
        assert mine.grasp.collision_free
        assert mine.grasp.object == theirs.object


def test_a_wall_is_no_support_of_kind_ransac() -> None:
    T_world_camera = camera(1.15, -1.5, 0.9)
    wall = box((0, 0.42, 0.4), (0.9, 0.01, 0.45))
    cloud = render([table(), wall, *boxes_on_table(1)], T_world_camera)
    for objects in ("auto", "off"):
        asked = parse_options({"viewpoint": (0, 0, 0), "support": "ransac", "objects": objects})
        seen = detector().detect(cloud, asked).support
        assert seen is not None
        assert T_world_camera[2, :3] @ seen.normal > 0.99


def test_a_long_approach_and_retreat_are_checked_to_their_ends() -> None:
    wall = grid([0.4], np.arange(-0.3, 0.3, 0.004), np.arange(0, 0.3, 0.004))
    cloud = np.concatenate([CLOUD, np.float32(wall)])
    sent = CloudInput(cloud, segment_ids=(np.arange(len(cloud)) < len(CLOUD)).astype(int))
    aside = {"cones": [{"direction": (-1, 0, 0), "max_angle": 0.2}]}
    for rule, free in (
        (("approach_length", 0.1), True),
        (("approach_length", 0.5), False),
        (("retreat_length", 0.5), False),
    ):
        asked = {"viewpoint": (0.1, 0.5, 0.5), "min_score": 0.0, "collision": dict([rule])}
        assert bool(detect(sent, approach_direction=aside, **asked).grasps) == free


def test_a_place_chooses_no_object_where_all_is_one() -> None:
    with refusal("options.objects"):
        detect(objects="off", near=(0.0, 0.0, 0.08))


TOP = 0.3  # metres
FIFTEEN_DEGREES = np.cos(np.radians(15.0))


def straight_down(points: np.ndarray) -> list[Grasp]:
    """The grasps of what is seen from straight above whose hand moves straight down."""
    above = {"viewpoint": (0.0, 0.0, 0.9), "suppression": None, "top_k": 500}
    found = detect(points.astype(np.float32), **above)
    return [grasp for grasp in found.grasps if grasp.T_cloud_hand[2, 2] == -1.0]


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_a_box_is_grasped_across_its_edges(turn: float) -> None:
    sides = [np.linspace(-side / 2, side / 2, round(side / 0.004) + 1) for side in (0.05, 0.12)]
    top = Rotation.from_euler("z", turn).apply(grid(*sides, [TOP]))  # a point every 4 mm
    straight = straight_down(top + np.random.default_rng(0).normal(0.0, 0.0003, top.shape))
    assert len(straight) > 20
    assert all(grasp.collision_free for grasp in straight)
    assert all(grasp.T_cloud_hand[2, 1] == 0.0 for grasp in straight)  # closes level
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    aligned = [g for g in straight if abs(g.T_cloud_hand[:3, 1] @ across) > FIFTEEN_DEGREES]
    assert len(aligned) > 0.8 * len(straight)
    for grasp in aligned:
        assert abs(grasp.T_cloud_tcp[:3, 3] @ across) < 0.006
        assert abs(abs(grasp.contact_point @ across) - 0.025) < 0.005


def test_a_rim_is_grasped_across_its_wall() -> None:
    turn = np.linspace(0, 2 * np.pi, round(2 * np.pi * 0.07 / 0.004), endpoint=False)
    rows = [[r * np.cos(turn), r * np.sin(turn), 0 * turn + TOP] for r in (0.07, 0.074)]
    straight = straight_down(np.concatenate([np.transpose(row) for row in rows]))
    assert len(straight) > 20
    contact = np.array([grasp.contact_point for grasp in straight]) * (1, 1, 0)
    radial = contact / np.linalg.norm(contact, axis=1, keepdims=True)
    hands = np.array([grasp.T_cloud_hand for grasp in straight])
    closing = np.abs(np.einsum("ed,ed->e", hands[:, :3, 1], radial))
    assert np.mean(closing > FIFTEEN_DEGREES) > 0.9
    np.testing.assert_allclose(np.linalg.norm(hands[:, :2, 3], axis=1), 0.072, atol=0.003)


def test_a_network_of_edges_gets_edge_grasps_where_they_are_good(catalogue) -> None:
    box_on_table = render([table(), box((0, 0, 0.05), (0.02, 0.03, 0.05))], camera(0.7, -1.5, 0.7))
    found = catalogue.get("edgegrasp-small").detect(box_on_table, DetectOptions(top_k=100))
    assert found.grasps
    for grasp in found.grasps:  # the approach point lies on the hand's axis
        from_hand = np.linalg.inv(grasp.T_cloud_hand) @ np.append(grasp.approach_point, 1.0)
        assert np.abs(from_hand[:2]).max() < 1e-4


def test_the_offset_of_the_support_is_along_its_unit_normal() -> None:
    cloud = box_on_table(table=True) + np.float32([0.0, 0.0, 50.0])
    plane = {"normal": [0.0, 0.0, 1.0009], "offset": 1.0009 * 50.0}
    asked = {"support": plane, "objects": "off", "debug": True}
    found = detector().detect(cloud, parse_options(asked))
    assert found.support.offset == pytest.approx(50.0, abs=1e-4)
    assert found.debug.support_plane[3] == pytest.approx(50.0, abs=5e-3)
    plane = {"normal": [0.0, 0.0, 1.0], "offset": 0.0}
    far = detector().detect(cloud, parse_options({"support": plane, "objects": "off"})).warnings
    assert any("plane lies 50 m below everything" in warning for warning in far)
