"""A real network behind the server: every way in gives the detector's own grasps."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from edgegrasp_cli import main
from edgegrasp_client import Detection, GraspClient, UnknownModelError

OPTIONS: dict[str, Any] = {"seed": 7, "num_approach_points": 8, "num_candidates": 200}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import torch

    from edgegrasp_model.checkpoint import CheckpointMetadata, save_checkpoint
    from edgegrasp_model.network import build_network
    from edgegrasp_model.network_config import EDGEGRASP_SMALL

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
    from edgegrasp_model.catalogue import ModelCatalogue
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
