"""What the client refuses itself, and what it passes on of a server that refuses."""

from typing import Any

import numpy as np
import pytest

from edgegrasp_client import InvalidRequestError

SOME = np.zeros((40, 3), np.float32)
CAMERA = {"fx": 60.0, "fy": 60.0, "cx": 2.0, "cy": 2.0}
IMAGE = {"depth": np.full((4, 4), 0.3, np.float32), "intrinsics": CAMERA}
NEGATIVE = {"contact_region": {"include": [{"kind": "indices", "indices": [0, -1]}]}}


def mask(values: Any) -> dict[str, Any]:
    return {"contact_region": {"include": [{"kind": "mask", "mask": values}]}}


def image(**changes: Any) -> dict[str, Any]:
    return {"depth_images": [IMAGE | {"T_cloud_camera": np.eye(4)} | changes]}


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"sead": 1}, "options.sead"),
        ({"seed": 2**70}, "options.seed"),
        ({"seed": "first"}, "options.seed"),
        ({"seed": 1.5}, "options.seed"),
        ({"viewpoint": [np.nan, 0.0, 0.0]}, "options.viewpoint"),
        ({"viewpoint": [[0, 0, 1], [0, 0]]}, "options.viewpoint"),
        ({"viewpoint": 3.0}, "options.viewpoint"),
        ({"workspace": {"min": [0, 0, 0], "max": [1, 1, 1], "mid": 3}}, "options.workspace.mid"),
        ({"workspace": [1, 2]}, "options.workspace"),
        ({"support": {"kind": "cylinder"}}, "options.support"),
        ({"approach_region": {"include": [{"kind": "cube"}]}}, "options.approach_region.include.0"),
        ({"approach_region": [{"kind": "mask", "mask": [True]}]}, "options.approach_region"),
        (mask(np.ones((3, 4), np.uint8)), "options.contact_region.include.0.mask"),
        (mask([[True], [False, True]]), "options.contact_region.include.0.mask"),
        (NEGATIVE, "options.contact_region.include.0.indices.1"),
        ({"gripper": {"max_opening": 0.1}}, "options.gripper.tip_z"),
        ({"gripper": [7]}, "options.gripper"),
    ],
)
def test_a_bad_option_is_refused_by_field_value_and_fix(options, field, client, cloud) -> None:
    with pytest.raises(InvalidRequestError) as caught:
        client.detect(cloud, **options)
    error = caught.value
    assert error.field.startswith(field)
    assert error.value
    assert error.fix
    assert str(error) == f"{error.field}: got {error.value}. {error.fix}"


@pytest.mark.parametrize(
    ("sent", "field", "value"),
    [
        ({"cloud": np.zeros((40, 2), np.float32)}, "cloud", "shape (40, 2)"),
        ({"cloud": np.zeros((40, 3), np.int64)}, "cloud", "dtype int64"),
        ({"cloud": np.full((40, 3), np.nan)}, "cloud", "40 points with NaN"),
        ({"cloud": np.zeros((0, 3))}, "cloud", "no points"),
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
        (image(depth="absent.png"), "depth_images.0.depth", "absent.png"),
        (image(depth="depth.tif"), "depth_images.0.depth", "depth.tif"),
        (image(intrinsics={"fx": 1.0}), "depth_images.0.intrinsics", ""),
        (image(intrinsics=(60.0, 60.0, 2.0)), "depth_images.0.intrinsics", "(60.0, 60.0, 2.0)"),
        (image(intrinsics=np.diag([60.0, 60.0, 2.0])), "depth_images.0.intrinsics", "array"),
        (image(intrinsics=(60.0, 60.0, 4.0, 2.0)), "depth_images.0.intrinsics.cx", "4, outside"),
        (image(depth_scale=1000.0), "depth_images.0.depth_scale", "1000"),
        (image(T_cloud_camera=1), "depth_images.0.T_cloud_camera", ""),
        (image(depth=np.full((30, 30), 0.3)) | {"view_ids": np.arange(900)}, "view_ids", ""),
        ({"cloud": SOME, "normals": np.zeros((40, 2))}, "normals", ""),
        ({"cloud": SOME, "normals": [[0, 0, 1]]}, "normals", ""),
        ({"cloud": SOME, "segment_ids": np.zeros(40)}, "segment_ids", ""),
        ({"cloud": SOME, "view_ids": np.full(40, 2**40)}, "view_ids", ""),
    ],
)
def test_a_bad_cloud_is_refused_by_field_value_and_fix(sent, field, value, client) -> None:
    with pytest.raises(InvalidRequestError) as caught:
        client.detect(**sent)
    assert caught.value.field == field
    assert caught.value.value
    assert value in caught.value.value
    assert caught.value.fix


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({}, "edges"),
        ({"edges": np.zeros((1, 2), int), "hand_poses": np.eye(4)[None]}, "edges"),
        ({"edges": [[0, 1]]}, "edges"),
        ({"edges": np.zeros((3, 2))}, "edges"),
        ({"edges": np.array([[0, 500]])}, "edges"),
        ({"hand_poses": np.eye(4)}, "hand_poses"),
        ({"hand_poses": np.full((2, 4, 4), np.nan)}, "hand_poses"),
        ({"edges": np.array([[0, 1]]), "seed": -1}, "options.seed"),
    ],
)
def test_bad_edges_and_hand_poses_are_refused_by_field(given, field, client, cloud) -> None:
    with pytest.raises(InvalidRequestError) as caught:
        client.score(cloud, **given)
    assert caught.value.field in (field, "hand_poses" if field == "edges" else field)
    assert caught.value.fix
