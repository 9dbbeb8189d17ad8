"""`edgegrasp benchmark-real` and `benchmark-tracking`: scenes, what grasps are worth, refusals."""

import json
from pathlib import Path
from types import SimpleNamespace as N
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from tests.cli.commands import refused, run
from tests.model.rendered import FOCAL_LENGTH, HEIGHT, WIDTH, box, camera, render, seen_box, table

from edgegrasp_cli.detect import InProcessDetector
from edgegrasp_lab.benchmark_tracking import MOTIONS, follow, simulated
from edgegrasp_lab.real_scenes import SceneFigures, compare_labels, judge, load_scene, renumbered
from edgegrasp_model.gripper import load_gripper
from edgegrasp_results import Grasp

POSE = camera(0.7, -np.pi / 2, 0.5)  # T_world_camera
HALF = np.array([0.02, 0.03, 0.06])  # half the size of a box: across, along and up
BOXES = [table(), box((0, 0, HALF[2]), HALF)]
SHAPE, INTRINSICS = (HEIGHT, WIDTH), (FOCAL_LENGTH, FOCAL_LENGTH, WIDTH / 2, HEIGHT / 2)
# Of the table in the camera's frame; along it is toward the camera.
NORMAL, ALONG, TABLE = POSE[2, :3], -POSE[1, :3], np.array([0.0, 0.0, 0.5])


def seen_scene() -> dict[str, Any]:
    """A scene: a depth camera's image of a box on a table."""
    return {
        "depth": np.rint(1000 * np.nan_to_num(render(BOXES, POSE)[..., 2])).astype(np.uint16),
        "intrinsics": np.array(INTRINSICS, dtype=np.float32),
        "labels": (1 + seen_box(BOXES, POSE)).reshape(SHAPE).astype(np.uint8),
        "support_normal": NORMAL.astype(np.float32),
        "support_offset": np.float32(NORMAL @ TABLE),
    }


def grasp(approach: np.ndarray, tip: np.ndarray, *, end: np.ndarray, score: float = 0.9) -> Grasp:
    """A Panda's grasp with its fingertips around a place, that says it holds a point."""
    pose = np.eye(4, dtype=np.float32)
    closing = np.array([1.0, 0.0, 0.0])
    pose[:3, :3] = np.stack([np.cross(closing, approach), closing, approach], axis=1)
    pose[:3, 3] = tip - 0.1122 * approach
    held = end.astype(np.float32)
    return Grasp(score, pose, pose, 0.08, held, held, pose[:3, 2], True, 0.0)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    np.savez(tmp_path / "box.npz", **seen_scene())
    return tmp_path / "box.npz"


def judged(file: Path, grasps: list[Grasp], plane: Any = None) -> SceneFigures:
    """What an answer is worth that calls nothing an object."""
    scene = load_scene(file)
    nothing = np.zeros(len(scene.points), dtype=np.int64)
    return judge(scene, grasps, plane, nothing, load_gripper(), 5.0)


def test_grasps_are_judged_by_the_labels(scene: Path) -> None:
    top = TABLE + 2 * HALF[2] * NORMAL
    floor = TABLE + 0.2 * ALONG
    grasps = [
        grasp(-NORMAL, top - 0.02 * NORMAL, end=top),  # good
        grasp(NORMAL, top, end=top, score=0.4),  # from below, through the table
        grasp(-NORMAL, floor + 0.02 * NORMAL, end=floor),  # beside the box
        grasp(-NORMAL, top - 0.08 * NORMAL, end=top),  # the palm is in the box
    ]
    figures = judged(scene, grasps)
    assert (figures.grasps, figures.best, figures.objects) == (4, 4, 1)
    assert figures.on_object == 3
    assert (figures.from_below, figures.through_points) == (1, 2)
    assert figures.objects_with_grasp == 1
    assert judged(scene, grasps[1:3]).objects_with_grasp == 0
    nothing = judged(scene, [])
    assert (nothing.best, nothing.on_object, nothing.objects_with_grasp) == (0, 0, 0)
    labels = seen_scene()["labels"].astype(np.uint16)  # which may be any numbers
    np.savez(scene, **seen_scene() | {"labels": np.where(labels > 1, labels + 254, labels)})
    assert min(load_scene(scene).objects) == 256


@pytest.mark.parametrize(
    ("tilt", "shift", "right"),
    [(0.0, 0.0, True), (4.0, 0.0, True), (6.0, 0.0, False), (0.0, 0.012, False), (180, 0, False)],
)
def test_a_plane_is_right_within_5_degrees_and_10_mm(scene, tilt, shift, right) -> None:
    turn = np.radians(tilt)
    normal = np.cos(turn) * NORMAL + np.sin(turn) * ALONG
    found = judged(scene, [], (normal, float(normal @ (TABLE + shift * NORMAL)))).plane
    assert found.angle == pytest.approx(tilt, abs=0.1)
    assert found.right == right


def test_clouds_show_the_same_scene_as_depth_images(scene: Path, tmp_path: Path) -> None:
    """Organised, with y up and z backward as OpenGL has it, and unorganised."""
    arrays = seen_scene()
    image = load_scene(scene)
    turned = image.points * np.float32([1, -1, -1])
    arrays = {name: arrays[name] for name in ("labels", "support_normal", "support_offset")}
    organised = {"points": turned.reshape(*SHAPE, 3), "support_normal": NORMAL * (1, -1, -1)}
    np.savez(tmp_path / "organised.npz", **arrays | organised)
    camera = load_scene(tmp_path / "organised.npz").camera
    wanted = pytest.approx((-INTRINSICS[0], *INTRINSICS[1:]), abs=0.01)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == wanted
    seen = np.isfinite(image.points).all(axis=1)
    flat = {"points": image.points[seen], "labels": arrays["labels"].ravel()[seen]}
    np.savez(tmp_path / "flat.npz", **arrays | flat)
    virtual = load_scene(tmp_path / "flat.npz")
    column, row = virtual.camera.project(virtual.points)[0].T
    assert (column.min() >= 0) & (column.max() < virtual.camera.shape[1])
    assert (row.min() >= 0) & (row.max() < virtual.camera.shape[0])


def test_results_page_and_pictures(scene: Path, tmp_path: Path) -> None:
    output = tmp_path / "results"
    asked = ("--support", '{"kind":"ransac"}', "--up", ",".join(map(str, NORMAL)))
    assert "1 of 1" in run("benchmark-real", "--scenes", scene.parent, "--output", output, *asked)
    results = json.loads((output / "results.json").read_text())
    assert results["scenes"]["box"]["on_object"] == results["scenes"]["box"]["best"] > 0
    assert results["all"]["on_object"] == results["all"]["planes_right"] == 1
    assert results["all"]["instances_found"] == results["all"]["instances"] == 1
    assert min(results["all"][f"pixel_{share}"] for share in ("precision", "recall")) > 0.9
    for picture in ("box.png", "box-labels.png"):
        assert (output / picture).read_bytes().startswith(b"\x89PNG")
    assert "box" in (output / "index.html").read_text()


def test_of_a_heap_that_hides_its_support_no_plane_and_no_objects_are_judged(scene, tmp_path):
    heap = tmp_path / "heap" / "heap.npz"
    heap.parent.mkdir()
    np.savez(heap, **{k: v for k, v in seen_scene().items() if not k.startswith("support_")})
    output = tmp_path / "results"
    folders = ("--scenes", scene.parent, "--scenes", heap.parent)
    run("benchmark-real", *folders, "--output", output)
    results = json.loads((output / "results.json").read_text())
    assert set(results["scenes"]) == {"box", "heap"}
    assert results["all"]["planes"] == results["all"]["instances"] == 1
    assert results["scenes"]["heap"]["segmentation"]["pixel_recall"] > 0.9


def test_a_scene_that_is_refused_counts_as_one_without_grasps(scene, tmp_path) -> None:
    whole = load_scene(scene)
    row = np.flatnonzero(whole.labels == 2)[:10]  # fewer points than grasps are asked around
    plane = {"support_normal": whole.normal, "support_offset": whole.offset}
    few = {"points": whole.points[row], "labels": whole.labels[row], **plane}
    np.savez(scene.parent / "refused.npz", **few)
    asked = ("--num-approach-points", 20, "--output", tmp_path / "results")
    run("benchmark-real", "--scenes", scene.parent, *asked)
    results = json.loads((tmp_path / "results" / "results.json").read_text())
    refused = results["scenes"]["refused"]
    assert refused["refused"]
    assert (refused["best"], refused["segmentation"]["called"]) == (0, 0)
    assert results["all"]["refused"] == 1


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("labels", None, "box.npz: labels: got nothing. Save"),
        ("labels", np.ones(SHAPE, np.uint8), "box.npz: labels: got no label above 1. Save"),
        ("labels", np.ones(7, np.uint8), "box.npz: labels: got shape (7,), dtype uint8. Save"),
        ("intrinsics", None, "box.npz: intrinsics: got nothing. Save"),
        ("intrinsics", np.zeros(4), "box.npz: depth_images.0.intrinsics.fx: got 0"),
        ("support_normal", np.full(3, np.nan), "box.npz: support_normal: got length nan"),
        ("support_normal", np.ones(3), "box.npz: support_normal: got length 1.73"),
        ("support_offset", np.int64(1), "box.npz: support_offset: got 1, a camera below. Save"),
        ("rgb", np.zeros((2, 2, 3), np.uint8), "box.npz: rgb: got shape (2, 2, 3)"),
    ],
)
def test_a_bad_file_is_named_with_field_and_fix(field, value, sentence, scene) -> None:
    arrays = seen_scene() | {field: value}
    np.savez(scene, **{name: array for name, array in arrays.items() if array is not None})
    assert sentence in refused("benchmark-real", "--scenes", scene.parent)


def test_what_is_no_scene_is_refused(scene: Path, tmp_path: Path) -> None:
    twice = ("--scenes", scene.parent, "--scenes", scene.parent)
    assert "two scenes named box" in refused("benchmark-real", *twice)
    scene.unlink()
    assert "Give a folder of scenes" in refused("benchmark-real", "--scenes", tmp_path)
    for content in (b"foreign", b"", b"PK\3\4", b"\x93NUMPY\1\0\2\0{}"):
        (tmp_path / "foreign.npz").write_bytes(content)
        assert "foreign.npz: " in refused("benchmark-real", "--scenes", tmp_path)


LABELS = np.repeat([0, 1, 2, 3], [40, 20, 20, 20])


@pytest.mark.parametrize(
    ("answer", "pixels", "overlap", "called", "same"),
    [
        (np.array([0, 7, 9, 4])[LABELS], (1.0, 1.0), (1.0, 1.0), 3, 100),  # other numbers
        (np.where(np.arange(100) < 20, 8, LABELS), (0.75, 1.0), (0.75, 1.0), 4, 80),  # background
        (np.where(np.arange(100) >= 95, 5, LABELS), (1.0, 1.0), (55 / 60, 55 / 60), 4, 95),  # cut
    ],
)
def test_labels_are_compared_object_by_object(answer, pixels, overlap, called, same) -> None:
    seen = compare_labels(LABELS, answer)
    assert (seen.pixel_precision, seen.pixel_recall) == pytest.approx(pixels)
    assert (seen.overlap_precision, seen.overlap_recall) == pytest.approx(overlap)
    assert (seen.found, seen.labelled, seen.called) == (3, 3, called)
    numbers = renumbered(LABELS, answer)
    assert (numbers == LABELS).sum() == same
    assert (numbers[numbers != LABELS] > 3).all()


def test_the_grasp_of_a_recorded_scene_stays_where_it_is(scene, tmp_path) -> None:
    asked = ("benchmark-tracking", "--scenes", scene.parent, "--output", tmp_path / "out")
    assert "box" in run(*asked, "--seconds", 0.2)
    assert "which stand still" in refused(*asked, "--motion", "still", "--motion", "pushed")
    figures = json.loads((tmp_path / "out" / "results.json").read_text())["box"]
    assert (figures["scenes"], figures["switches"]) == (1, 0)
    assert figures["mm_95"] < 3.0
    assert figures["degrees_95"] < 3.0
    assert (tmp_path / "out" / "jitter.svg").read_text().startswith("<?xml")


def test_a_grasp_that_is_lost_for_long_is_one_switch() -> None:
    pose, ids = np.eye(4), iter([1, 1, *[None] * 8])

    def detect(**_: Any) -> Any:
        number = next(ids)
        one = N(id=number, object=0, T_cloud_hand=pose, T_cloud_tcp=pose, score=0.9)
        grasps = [] if number is None else [one]
        plain = {"tracking": N(next_id=2, first="lost"), "objects": [], "support": None}
        return N(grasps=grasps, gripper=N(name=""), up=None, **plain)

    scene: Any = Mock(image_at=lambda _: {}, object_motion=lambda _: pose)
    detect_of: Any = N(detect=detect)
    assert follow(detect_of, scene, 0.3, clock=lambda: 0.0).switches == 1


def test_the_grasp_of_an_object_on_a_belt_moves_with_it() -> None:
    client = InProcessDetector()
    scenes = simulated(None, MOTIONS["belt-10"], 1)
    scene = next(scenes)
    start = np.array([one.position for one in scene.simulation.placements])
    done = follow(client, scene, 0.2, clock=lambda: 0.0)
    scene.image_at(0.2)
    gone = [one.position for one in scene.simulation.placements] - start
    assert np.allclose(gone, scene.object_motion(0.2)[:3, 3], atol=1e-6)  # all objects
    assert np.linalg.norm(scene.object_motion(0.2)[:3, 3]) == pytest.approx(0.02)
    assert len(done.off) >= 3
    # The last image was taken one thirtieth of a second before, 3 mm back.
    assert max(millimetres for _, millimetres, _ in done.off) < 8.0
    assert scene.execute(done).keys() == {"still", "open_loop", "followed"}
    scenes.close()
