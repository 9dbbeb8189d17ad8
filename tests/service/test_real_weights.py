"""A real network behind the server: every way in gives the detector's own grasps."""

import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from edgegrasp_cli import main
from edgegrasp_client import Detection, GraspClient, InvalidRequestError, UnknownModelError

OPTIONS: dict[str, Any] = {"seed": 7, "num_approach_points": 8, "num_candidates": 200}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import torch

    from edgegrasp_model.networks.checkpoint import build_network, save_checkpoint
    from edgegrasp_model.networks.config import EDGEGRASP_SMALL, CheckpointMetadata

    network = build_network(EDGEGRASP_SMALL, torch.Generator().manual_seed(0))
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    metadata = CheckpointMetadata("untrained", EDGEGRASP_SMALL, voxel_size=0.004, gripper="panda")
    save_checkpoint(path, network, metadata)
    return path


@pytest.fixture(scope="module")
def box() -> np.ndarray:
    """The visible surface of a box that fits the hand, metres."""
    rng = np.random.default_rng(0)
    surface = rng.uniform(-1.0, 1.0, (6000, 3))
    axis = rng.integers(0, 3, 6000)
    surface[np.arange(6000), axis] = np.where(rng.random(6000) < 0.5, -1.0, 1.0)
    surface[axis == 2, 2] = 1.0
    return (surface * (0.02, 0.03, 0.05) + (0, 0, 0.05)).astype(np.float32)


def as_lists(detection: Any) -> list[list[Any]]:
    return [
        [np.asarray(value, np.float32).tolist() for value in vars(grasp).values()]
        for grasp in detection.grasps
    ]


def test_every_way_in_gives_the_detectors_grasps(
    weights: Path, box: np.ndarray, start_server, tmp_path: Path
) -> None:
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_model.options import DetectOptions

    catalogue = ModelCatalogue.load([weights], default="untrained")
    expected = catalogue.get().detect(box, DetectOptions(**OPTIONS))
    assert expected.grasps

    file = tmp_path / "box.ply"
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(box)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    file.write_bytes(header.encode() + box.tobytes())

    with start_server("--weights", str(weights), "--default-model", "untrained") as server:
        found: list[Detection] = []
        for address in (server.grpc_address, server.http_url):
            with GraspClient(address) as client:
                found += [client.detect(box, **OPTIONS), client.detect(file, **OPTIONS)]
                (model,) = (model for model in client.models() if model.default)
                assert (model.name, model.parameters) == ("untrained", _parameters(catalogue))
                with pytest.raises(UnknownModelError, match="untrained"):
                    client.detect(box, model="none")
        words = ["detect", str(file), "--json", "--seed", "7", "--num-approach-points", "8"]
        words += ["--num-candidates", "200"]
        remote = CliRunner().invoke(main.app, [*words, "--server", server.http_url])
    words += ["--weights", str(weights), "--model", "untrained"]
    local = CliRunner().invoke(main.app, words)

    for detection in found:
        assert as_lists(detection) == as_lists(expected)
        assert detection.counts == expected.counts
    for result in (remote, local):
        printed = json.loads(result.stdout)["grasps"]
        assert [list(grasp.values()) for grasp in printed] == as_lists(expected)


def _parameters(catalogue: Any) -> int:
    return next(row["parameters"] for row in catalogue.describe() if row["name"] == "untrained")


# Many options at once, with the weights that ship.
MANY: dict[str, Any] = {
    "gripper": "robotiq-2f-140",
    "seed": 11,
    "num_approach_points": 8,
    "num_candidates": 120,
    "sampling": "uniform",
    "viewpoint": [[0.3, 0.1, 0.6], [-0.4, 0.2, 0.5]],
    "up": [0.0, 0.0, 2.0],
    "support": {"kind": "ransac", "distance": 0.004, "max_tilt": 0.2},
    "workspace": {"min": [-0.3, -0.3, -0.05], "max": [0.3, 0.3, 0.4]},
    "approach_region": {
        "include": [
            {"kind": "sphere", "center": [0.0, 0.0, 0.08], "radius": 0.1},
            {"kind": "half_space", "normal": [0.0, 0.0, 1.0], "offset": 0.02},
        ],
        "exclude": [{"kind": "segments", "ids": [1]}],
    },
    "contact_region": {"exclude": [{"kind": "indices", "indices": [0, 5, 17]}]},
    "approach_direction": {
        "cones": [{"direction": [0.2, 0.0, -1.0], "max_angle": 0.9}],
        "preset": "top-down",
    },
    "collision": {
        "mode": "penalise",
        "margin": 0.001,
        "approach_length": 0.08,
        "retreat_length": 0.05,
        "retreat_direction": "up",
        "obstacles": [{"kind": "box", "min": [0.15, -0.2, 0.0], "max": [0.2, 0.2, 0.2]}],
    },
    "min_score": 1e-6,
    "top_k": 12,
    "suppression": {"translation": 0.005, "rotation": 0.2},
    "order": "clearance",
    "debug": True,
}


@pytest.fixture(scope="module")
def scene(box: np.ndarray) -> dict[str, np.ndarray]:
    """The box on a table, as the arrays of an .npz file."""
    rng = np.random.default_rng(1)
    table = np.column_stack([rng.uniform(-0.2, 0.2, (6000, 2)), rng.normal(0.0, 5e-4, 6000)])
    points = np.concatenate([box, table]).astype(np.float32)
    return {
        "points": points,
        "segment_ids": np.repeat(np.array([0, 1], np.int32), 6000),
        "view_ids": (points[:, 0] < 0).astype(np.int32),
    }


def test_many_options_give_the_same_grasps_everywhere(
    scene: dict[str, np.ndarray], start_server, tmp_path: Path
) -> None:
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_model.options import parse_options
    from edgegrasp_model.scene.cloud import CloudInput

    expected = ModelCatalogue.load().get().detect(CloudInput(**scene), parse_options(MANY))
    assert expected.grasps
    assert expected.debug is not None

    file, options = tmp_path / "scene.npz", tmp_path / "options.json"
    np.savez_compressed(file, **scene)
    options.write_text(json.dumps(MANY))
    flags = ["detect", str(file), "--json"]
    for name, value in MANY.items():
        words = [] if name == "debug" else [value if isinstance(value, str) else json.dumps(value)]
        flags += [f"--{name.replace('_', '-')}", *words]
    printed = [CliRunner().invoke(main.app, flags)]
    beside = {name: array for name, array in scene.items() if name != "points"}
    found: list[Detection] = []
    with start_server() as server:
        with GraspClient(server.grpc_address) as client:
            found.append(client.detect(file, **MANY))
        with GraspClient(server.http_url) as client:
            found.append(client.detect(scene["points"], **beside, **MANY))
        remote = ["--server", server.http_url]
        printed.append(CliRunner().invoke(main.app, [*flags, *remote]))
        body = {name: array.tolist() for name, array in scene.items()} | {"options": MANY}
        answer = httpx.post(f"{server.http_url}/v1/grasps", json=body, timeout=60).json()
        words = ["detect", str(file), "--json", "--options", str(options)]
        printed.append(CliRunner().invoke(main.app, [*words, "--server", server.grpc_address]))
    for detection in found:
        assert as_lists(detection) == as_lists(expected)
        assert detection.counts == expected.counts
        assert detection.warnings == expected.warnings
        assert detection.debug is not None
        for name, value in vars(expected.debug).items():
            np.testing.assert_array_equal(getattr(detection.debug, name), value)
    for document in (answer, *(json.loads(result.stdout) for result in printed)):
        assert [list(grasp.values()) for grasp in document["grasps"]] == as_lists(expected)
        assert document["counts"] == expected.counts
        assert document["debug"]["outcome"] == expected.debug.outcome


def test_wrong_depths_are_put_right_everywhere(scene: dict[str, np.ndarray], start_server) -> None:
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_model.options import parse_options

    camera = np.array([0.3, 0.1, 0.6])
    points = (camera + 1.05 * (scene["points"] - camera)).astype(np.float32)
    plane = {"normal": [0.0, 0.0, 1.0], "offset": 0.0, "max_depth_error": 0.1}
    options: dict[str, Any] = {"seed": 5, "support": plane}
    seen_from = options | {"viewpoint": camera.tolist()}
    expected = ModelCatalogue.load().get().detect(points, parse_options(seen_from))
    assert expected.grasps
    assert expected.warnings == ["the depths were multiplied by 0.952, as the support plane shows."]
    contact = np.array([grasp.contact_point for grasp in expected.grasps])
    assert (np.abs(contact) < np.array([0.02, 0.03, 0.1]) + 0.004).all()  # on the box again
    with start_server() as server:
        for address in (server.grpc_address, server.http_url):
            with GraspClient(address) as client:
                found = client.detect(points, **seen_from)
                assert as_lists(found) == as_lists(expected)
                assert found.warnings == expected.warnings
                with pytest.raises(InvalidRequestError, match=r"options\.viewpoint: got nothing"):
                    client.detect(points, **options)


def test_scores_are_the_same_everywhere(scene: dict[str, np.ndarray], start_server) -> None:
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_model.options import parse_options

    options: dict[str, Any] = {"seed": 3, "viewpoint": [0.3, 0.1, 0.6]}
    points = scene["points"]
    edges = np.random.default_rng(2).integers(0, 6000, (40, 2))
    detector = ModelCatalogue.load().get()
    poses = np.stack(
        [g.T_cloud_hand for g in detector.detect(points, parse_options(options)).grasps]
    )
    by_edges = detector.score(points, parse_options(options), edges=edges)
    by_poses = detector.score(points, parse_options(options), hand_poses=poses)
    assert any(evaluation.grasp for evaluation in by_edges.evaluations)
    assert any(evaluation.grasp for evaluation in by_poses.evaluations)
    with start_server() as server:
        for address in (server.grpc_address, server.http_url):
            with GraspClient(address) as client:
                assert evaluated(client.score(points, edges=edges, **options)) == evaluated(
                    by_edges
                )
                scoring = client.score(points, hand_poses=poses, **options)
                assert evaluated(scoring) == evaluated(by_poses)
                assert scoring.counts == by_poses.counts


def evaluated(scoring: Any) -> list[Any]:
    return [
        evaluation.reason
        or [np.asarray(value, np.float32).tolist() for value in vars(evaluation.grasp).values()]
        for evaluation in scoring.evaluations
    ]
