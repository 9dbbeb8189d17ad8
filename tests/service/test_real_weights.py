"""A real network behind the server: every way in gives the detector's own grasps."""

import json
from typing import Any

import httpx
import numpy as np
import pytest
from tests.cli.commands import run
from tests.cloud_files import npy
from tests.many_options import MANY
from tests.model.rendered import FOCAL_LENGTH, ROOM_INSIDE, SCENE, wavy
from tests.model.scenes import box_on_table, random_hands

from edgegrasp_client import GraspClient
from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.options import parse_options
from edgegrasp_model.results import UnitCosts
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import answer
from edgegrasp_service.worker.process import Job

POINTS = box_on_table(3000, table=True)
BESIDE = {
    "segment_ids": np.repeat(np.array([2, 1], np.int32), [9000, 3000]),
    "view_ids": (POINTS[:, 0] < 0).astype(np.int32),
}


def as_list(grasp: Any) -> list[Any]:
    return [np.asarray(v, np.float32).tolist() for v in vars(grasp).values() if v is not None]


def as_lists(detection: Any) -> list[list[Any]]:
    return [as_list(grasp) for grasp in detection.grasps]


def test_many_options_give_the_same_grasps_everywhere(catalogue, real_server, tmp_path):
    expected = catalogue.get().detect(CloudInput(POINTS, **BESIDE), parse_options(MANY))
    assert expected.grasps

    file, options = tmp_path / "scene.npz", tmp_path / "options.json"
    np.savez_compressed(file, points=POINTS, **BESIDE)
    options.write_text(json.dumps(MANY))
    flags = ["detect", str(file), "--json"]
    remote = [*flags, "--options", str(options), "--server", real_server.grpc_address]
    for name, value in MANY.items():
        words = [] if name == "debug" else [value if isinstance(value, str) else json.dumps(value)]
        flags += [f"--{name.replace('_', '-')}", *words]
    body = {name: array.tolist() for name, array in BESIDE.items()}
    body |= {"points": POINTS.tolist(), "options": MANY}
    documents = [httpx.post(f"{real_server.http_url}/v1/grasps", json=body, timeout=60).json()]
    documents += [json.loads(run(*each)) for each in (flags, remote)]
    for document in documents:
        given = [[v for v in grasp.values() if v is not None] for grasp in document["grasps"]]
        assert given == as_lists(expected)
        assert document["counts"] == expected.counts
        assert document["debug"]["outcome"] == expected.debug.outcome

    with GraspClient(real_server.grpc_address) as client:
        found = [client.detect(file, **MANY)]
    with GraspClient(real_server.http_url) as client:
        found.append(client.detect(POINTS, **BESIDE, **MANY))
    for detection in found:
        assert as_lists(detection) == as_lists(expected)
        assert list(detection.counts.items()) == list(expected.counts.items())  # in their order
        assert list(detection.seconds) == list(expected.seconds)
        assert detection.warnings == expected.warnings
        for name, value in vars(expected.debug).items():
            np.testing.assert_array_equal(getattr(detection.debug, name), value)


def evaluated(scoring: Any) -> list[Any]:
    return [one.reason or as_list(one.grasp) for one in scoring.evaluations]


def test_scores_are_the_same_everywhere(catalogue, real_server) -> None:
    options: dict[str, Any] = {"seed": 3, "viewpoint": [0.3, 0.1, 0.6]}
    detector, parsed = catalogue.get(), parse_options(options)
    poses = np.stack([grasp.T_cloud_hand for grasp in detector.detect(POINTS, parsed).grasps])
    edges = np.random.default_rng(2).integers(0, 9000, (40, 2))
    for given in ({"edges": edges}, {"hand_poses": poses}):
        expected = detector.score(POINTS, parsed, **given)
        assert any(evaluation.grasp for evaluation in expected.evaluations)
        for address in (real_server.grpc_address, real_server.http_url):
            with GraspClient(address) as client:
                scoring = client.score(POINTS, **given, **options)
            assert evaluated(scoring) == evaluated(expected)
            assert list(scoring.counts.items()) == list(expected.counts.items())


@pytest.mark.parametrize(
    ("costs", "kind", "named"),
    [
        (UnitCosts(voxel=1e-2), "invalid-request", "voxels"),
        (UnitCosts(point=1e-2), "deadline-exceeded", "50000 points"),
        (UnitCosts(1e-6, 1e-6), "invalid-request", "20000"),
    ],
)
def test_clouds_that_take_too_long_are_refused(catalogue, monkeypatch, costs, kind, named) -> None:
    monkeypatch.setattr(catalogue, "unit_costs", costs)
    room = np.random.default_rng(0).random((50_000, 3), np.float32) * 4
    whole = "objects=off&support=null"
    job = Job("DetectGrasps", "http", npy(room), 60.0, "application/x-npy", whole)
    error = answer(job, catalogue, Settings(max_voxels=20_000)).error
    assert error.kind == kind
    assert named in error.detail


def test_the_pace_is_measured(catalogue: ModelCatalogue) -> None:
    catalogue.warm_up()
    assert min(catalogue.unit_costs) > 0  # 0 where it is not measured


ONE_PLACE = np.full((50, 3), 1e-3, np.float32)
NO_SCENES = {  # depth images (H, W), or clouds (N, 3), in metres
    "one pixel": SCENE[120:121, 160:161, 2],
    "one row": SCENE[120:121, :, 2],
    "one column": SCENE[:, 160:161, 2],
    "holes": np.zeros((240, 320), np.float32),
    "within 5 cm": wavy(0.04),
    "beyond 10 m": wavy(12.0),
    "a room from inside": ROOM_INSIDE[..., 2],
    "points all around the camera": random_hands(5000, 0, reach=0.5)[:, :3, 3],
    "the camera itself": 0 * ONE_PLACE,
    "one place": ONE_PLACE,
}


@pytest.mark.parametrize("name", NO_SCENES)
def test_what_is_no_scene_gets_no_grasps_and_a_reason(real_server, name: str) -> None:
    sent, url = NO_SCENES[name], f"{real_server.http_url}/v1/grasps"
    if sent.shape[1] == 3:
        kind = {"content-type": "application/x-npy"}
        answer = httpx.post(url, content=npy(sent), headers=kind, timeout=60)
    else:
        middle = (sent.shape[1] // 2, sent.shape[0] // 2)
        camera = json.dumps([FOCAL_LENGTH, FOCAL_LENGTH, *middle])
        files = {"depth": ("depth.npy", npy(sent))}
        answer = httpx.post(url, files=files, data={"intrinsics": camera}, timeout=60)
    document = answer.json()
    if answer.status_code == 200:
        assert (document["grasps"], bool(document["warnings"])) == ([], True)
        assert document["counts"]["points"] >= 0
    else:
        assert answer.status_code in (400, 413, 422)
        assert all(document[part] for part in ("field", "value", "fix"))
