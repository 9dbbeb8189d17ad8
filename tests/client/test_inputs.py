"""What may be sent besides an array of points, and scoring: the same over both transports."""

from array import array
from collections import deque
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.checks import refusal
from tests.cloud_files import ros_message

from edgegrasp_client import PayloadTooLargeError
from edgegrasp_results import Detection


def contacts(detection: Detection) -> list[list[float]]:
    return [grasp.contact_point.tolist() for grasp in detection.grasps]


def depth_image(**changes: Any) -> Any:
    depth = np.random.default_rng(0).uniform(0.3, 0.4, (20, 30)).astype(np.float32)
    camera = {"fx": 60.0, "fy": 60.0, "cx": 14.5, "cy": 9.5}
    return {"depth": depth, "intrinsics": camera, "T_cloud_camera": np.eye(4)} | changes


def test_arrays_beside_the_cloud_have_its_rows(client, cloud, tmp_path) -> None:
    ids = np.arange(500)
    beside = {"normals": cloud, "colors": cloud.astype(np.float64), "segment_ids": ids}
    found = client.detect(cloud, view_ids=ids % 2, viewpoint=[[0, 0, 1], [1, 0, 1]], **beside)
    assert contacts(found) == contacts(client.detect(cloud))
    for name in (*beside, "view_ids"):
        with refusal(name, fix="500 points"):
            client.detect(cloud, **{name: (beside | {"view_ids": ids})[name][1:]})
    np.savez(tmp_path / "cloud.npz", points=cloud, normals=cloud, segment_ids=ids)
    assert client.detect(tmp_path / "cloud.npz").grasps
    with refusal("normals"):  # they are sent already
        client.detect(tmp_path / "cloud.npz", normals=cloud)


def test_organised_clouds_may_have_holes(client, cloud) -> None:
    organised = cloud.reshape(20, 25, 3).copy()
    assert contacts(client.detect(organised)) == contacts(client.detect(cloud))
    organised[3, 4] = np.nan
    found = client.detect(organised, segment_ids=np.zeros((20, 25), np.int64))
    assert found.counts["points"] == 499


def test_point_cloud2_messages_are_read(client, cloud) -> None:
    expected = contacts(client.detect(cloud))
    assert contacts(client.detect(ros_message(cloud))) == expected
    assert contacts(client.detect(ros_message(cloud, data=list(cloud.tobytes())))) == expected
    assert contacts(client.detect(ros_message(cloud.reshape(20, 25, 3)))) == expected
    with refusal("point_cloud2.data"):
        client.detect(ros_message(cloud, data=b""))


def test_depth_images_are_sent_in_every_form(client) -> None:
    assert client.detect(depth_images=[depth_image()]).counts["points"] == 600
    millimetres = np.round(depth_image()["depth"] * 1000).astype(np.uint16)
    expected = client.detect(depth_images=[depth_image(depth=millimetres)])
    assert expected.grasps
    nested = [[60.0, 0, 14.5], [0, 60.0, 9.5], [0, 0, 1]]
    for camera in ((60.0, 60.0, 14.5, 9.5), np.array(nested), np.ravel(nested)):
        found = client.detect(depth_images=[{"depth": millimetres, "intrinsics": camera}])
        assert contacts(found) == contacts(expected)
    masked = np.ma.masked_greater(millimetres, np.median(millimetres))
    found = client.detect(depth_images=[depth_image(depth=masked)])
    zeros = client.detect(depth_images=[depth_image(depth=masked.filled(0))])
    assert contacts(found) == contacts(zeros) != contacts(expected)
    rows = np.eye(4).tolist(), np.eye(4).ravel().tolist()
    views = [depth_image(), *(depth_image(T_cloud_camera=pose) for pose in rows)]
    assert client.detect(depth_images=views, segment_ids=np.arange(1800)).counts["points"] == 1800


def test_depth_files_are_read_with_their_scale(client, tmp_path) -> None:
    tenths = np.round(depth_image()["depth"] * 10000).astype(np.uint16)
    Image.fromarray(tenths).save(tmp_path / "depth.png")
    np.save(tmp_path / "depth.npy", tenths[..., None])
    np.save(tmp_path / "metres.npy", (tenths / 10000).astype(np.float32))
    expected = contacts(client.detect(depth_images=[depth_image(depth=tenths / 10000)]))
    one = np.float32(1)
    for name, scale in (("depth.png", 0.0001), ("depth.npy", 0.0001), ("metres.npy", one)):
        image = depth_image(depth=tmp_path / name, depth_scale=scale)
        found = contacts(client.detect(depth_images=[image]))
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_file_that_no_server_takes_is_not_read(client, tmp_path) -> None:
    with (tmp_path / "large.npy").open("wb") as file:
        file.truncate(2**30 + 1)
    with pytest.raises(PayloadTooLargeError, match=r"large\.npy has 1,073,741,825 bytes"):
        client.detect(tmp_path / "large.npy")


def test_edges_are_scored_in_their_order(client, cloud) -> None:
    edges = np.array([[0, 1], [7, 7], [499, 3]])
    scoring = client.score(cloud, edges=edges, seed=2, collision={"mode": "ignore"})
    assert [evaluation.reason for evaluation in scoring.evaluations] == [None, "too-short", None]
    first, none, last = (evaluation.grasp for evaluation in scoring.evaluations)
    assert none is None
    np.testing.assert_array_equal(first.contact_point, cloud[1])
    np.testing.assert_array_equal(last.contact_point, cloud[3])
    assert (scoring.counts["scored"], scoring.model) == (2, "dummy")
    assert scoring.warnings
    assert scoring.seconds["total"] >= 0


def test_scoring_over_any_cloud(client, cloud) -> None:
    edges = np.array([[0, 1], [2, 3]])
    expected = [e.grasp.score for e in client.score(cloud, edges=edges).evaluations]
    for given in (cloud.reshape(20, 25, 3), ros_message(cloud)):
        scoring = client.score(given, edges=edges, segment_ids=np.arange(500))
        assert [evaluation.grasp.score for evaluation in scoring.evaluations] == expected
    assert client.score(depth_images=[depth_image()], edges=edges).evaluations


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int64])
def test_options_too_long_for_a_query_are_sent(client, cloud, kind) -> None:
    mask = np.full((20, 25), 255).astype(kind)
    options: dict[str, Any] = {
        "approach_region": {"include": [{"kind": "mask", "mask": mask}]},
        "contact_region": {"include": [{"kind": "indices", "indices": np.arange(499)}] * 10},
    }
    assert contacts(client.detect(cloud, **options)) == contacts(client.detect(cloud))


def test_options_may_be_sequences_of_any_kind(client, cloud) -> None:
    given: Any = {"up": array("d", [0.0, 0.0, 1.0]), "objects": {"exclude": deque([9])}}
    plain: Any = {"up": [0.0, 0.0, 1.0], "objects": {"exclude": [9]}}
    assert contacts(client.detect(cloud, **given)) == contacts(client.detect(cloud, **plain))


SOME = np.zeros((40, 3), np.float32)


def region(**shape: Any) -> dict[str, Any]:
    return {"contact_region": {"include": [shape]}}


def image(**changes: Any) -> dict[str, Any]:
    return {"depth_images": [depth_image(**changes)]}


OPTIONS: list[tuple[dict[str, Any], str]] = [
    ({"sead": 1}, "sead"),
    ({"seed": 2**70}, "seed"),
    ({"seed": "first"}, "seed"),
    ({"seed": 1.5}, "seed"),
    ({"viewpoint": [np.nan, 0.0, 0.0]}, "viewpoint."),
    ({"viewpoint": [[0, 0, 1], [0, 0]]}, "viewpoint."),
    ({"viewpoint": 3.0}, "viewpoint."),
    ({"workspace": {"min": [0, 0, 0], "max": [1, 1, 1], "mid": 3}}, "workspace.mid"),
    ({"workspace": [1, 2]}, "workspace"),
    ({"support": {"kind": "cylinder"}}, "support"),
    ({"approach_region": {"include": ["box"]}}, "approach_region.include.0"),
    ({"approach_region": {"include": [{"kind": "cube"}]}}, "approach_region.include.0"),
    ({"approach_region": [{"kind": "mask", "mask": [True]}]}, "approach_region"),
    (region(kind="mask", mask=np.ones((3, 4), np.float32)), "contact_region.include.0.mask"),
    (region(kind="mask", mask=[[True], [False, True]]), "contact_region.include.0.mask"),
    (region(kind="indices", indices=[0, -1]), "contact_region.include.0.indices.1"),
    ({"gripper": [7]}, "gripper"),
    ({"suppression": {"disabled": True}}, "suppression.disabled"),
    ({"support": {"disabled": True}}, "support."),
    ({"robot": {"name": "fr3", "T_base_cloud": 3, "joints": [0.0]}}, "robot.T_base_cloud"),
]


@pytest.mark.parametrize(
    ("sent", "field", "value"),
    [
        *(({"cloud": SOME} | options, f"options.{field}", "") for options, field in OPTIONS),
        ({"cloud": np.zeros((40, 2), np.float32)}, "cloud", "shape (40, 2)"),
        ({"cloud": np.zeros((40, 3), np.int64)}, "cloud", "dtype int64"),
        ({"cloud": np.ma.masked_equal(SOME, 0.0)}, "cloud", "NaN"),
        ({"cloud": np.zeros((40, 3), dtype=object)}, "cloud", "dtype object"),
        ({"cloud": [[0.0, 0.0, 0.0]]}, "cloud", "a list"),
        ({"cloud": "cloud.las"}, "cloud", "'cloud.las'"),
        ({"cloud": "absent.npy"}, "cloud", "absent.npy (No such file or directory)"),
        ({}, "cloud", ""),
        ({"cloud": SOME} | image(), "cloud", ""),
        ({"depth_images": [3]}, "depth_images.0", ""),
        (image(more=1), "depth_images.0", ""),
        (image(depth=[[1.0]]), "depth_images.0.depth", ""),
        (image(depth=np.zeros((3, 4), int)), "depth_images.0.depth", ""),
        ({"cloud": "depth.png"}, "cloud", "'depth.png'"),
        ({"cloud": np.zeros((48, 64, 1), np.float32)}, "cloud", "shape (48, 64, 1)"),
        (image(depth=np.full((20, 30), -0.5)), "depth_images.0.depth", "-0.5 m"),
        (image(depth="absent.png"), "depth_images.0.depth", "absent.png"),
        (image(depth="depth.tif"), "depth_images.0.depth", "depth.tif (neither .png nor .npy)"),
        (image(intrinsics={"fx": 1.0}), "depth_images.0.intrinsics", ""),
        (image(intrinsics=(60.0, 60.0, 2.0)), "depth_images.0.intrinsics", "(60.0, 60.0, 2.0)"),
        (image(intrinsics=np.diag([60.0, 60.0, 2.0])), "depth_images.0.intrinsics", "array"),
        (image(depth_scale=1000.0), "depth_images.0.depth_scale", "1000"),
        (image(T_cloud_camera=1), "depth_images.0.T_cloud_camera", ""),
        (image(T_cloud_camera=[[1.0], [0.0, 1.0]]), "depth_images.0.T_cloud_camera", "[[1.0], "),
        (image(depth=np.full((30, 30), 0.3)) | {"view_ids": np.arange(900)}, "view_ids", ""),
        ({"cloud": SOME, "normals": np.zeros((40, 2))}, "normals", ""),
        ({"cloud": SOME, "normals": [[0, 0, 1]]}, "normals", ""),
        ({"cloud": SOME, "segment_ids": np.zeros(40)}, "segment_ids", ""),
        ({"cloud": SOME, "view_ids": np.full(40, 2**40)}, "view_ids", ""),
    ],
)
def test_what_is_bad_is_refused_by_field_value_and_fix(sent, field, value, client) -> None:
    with refusal(field, value):
        client.detect(**sent)


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({}, "edges"),
        ({"edges": np.zeros((1, 2), int), "hand_poses": np.eye(4)[None]}, "edges"),
        ({"edges": [[0, 1]]}, "edges"),
        ({"edges": np.zeros((3, 2))}, "edges"),
        ({"hand_poses": np.eye(4)}, "hand_poses"),
    ],
)
def test_bad_edges_and_hand_poses_are_refused_by_field(given, field, client, cloud) -> None:
    with refusal(field):
        client.score(cloud, **given)
