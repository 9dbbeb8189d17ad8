"""The commands that need the simulator or the trainer, end to end and small."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from edgegrasp_cli.main import app
from edgegrasp_model.networks.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import EDGEGRASP_SMALL, CheckpointMetadata
from edgegrasp_training.recipes import recipe


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def refused(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 1
    return result.output


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    output = run(
        "generate-data",
        folder,
        "--scenes",
        4,
        "--views-per-scene",
        1,
        "--grasps-per-view",
        10,
        "--seed",
        3,
    )
    assert "4 scenes made, 0 kept" in output
    return folder


def test_generate_train_serve_and_benchmark_one_after_the_other(data: Path, tmp_path: Path) -> None:
    assert "0 scenes made, 4 kept" in run(
        "generate-data", data, "--scenes", 4, "--views-per-scene", 1, "--seed", 3
    )
    training = (
        "train",
        data,
        "--run",
        tmp_path,
        "--steps",
        4,
        "--views-per-step",
        2,
        "--validation-share",
        0.3,
    )
    assert "paused at step 2" in run(*training, "--until", 2)
    assert "AUROC" in run(*training)
    weights = tmp_path / "edgegrasp-plus.safetensors"
    assert load_checkpoint(weights)[1].training["steps"] == 4
    assert (tmp_path / "edgegrasp-plus.md").is_file()

    result = tmp_path / "result"
    output = run(
        "benchmark",
        "--scene",
        "packed",
        "--rounds",
        1,
        "--seed",
        0,
        "--num-candidates",
        200,
        "--weights",
        weights,
        "--model",
        "edgegrasp-plus",
        "--no-report",
        "--output",
        result,
    )
    assert "GSR" in output
    planner = json.loads((result / "manifest.json").read_text())["run"]["planner"]
    assert planner["digest"] == load_checkpoint(weights)[1].digest
    assert planner["options"]["num_candidates"] == 200
    summary = json.loads((result / "summary.json").read_text())
    with (result / "attempts.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == summary["attempts"]


def test_balls_may_be_as_large_as_the_scene(data: Path, tmp_path: Path) -> None:
    network = ("--model", "edgegrasp-small", "--crop-radius", 0.5)
    amount = ("--steps", 1, "--views-per-step", 1, "--validation-share", 0.3)
    run("train", data, "--run", tmp_path, *network, *amount)
    _, metadata = load_checkpoint(tmp_path / "edgegrasp-small.safetensors")
    assert metadata.network == replace(recipe("edgegrasp-small").network, crop_radius=0.5)


def test_the_authors_checkpoint_becomes_one_file(shared_dir: Path, tmp_path: Path) -> None:
    weights = tmp_path / "vn-edgegrasp.safetensors"
    run("import-checkpoint", shared_dir / "reference" / "vn_edge_grasp", weights)
    _, metadata = load_checkpoint(weights)
    assert metadata.name == metadata.network.architecture == "vn-edgegrasp"


def test_weights_in_int8_are_written_beside_the_correlation_of_their_logits(
    data: Path, tmp_path: Path
) -> None:
    weights, output = tmp_path / "small.safetensors", tmp_path / "small-int8.safetensors"
    metadata = CheckpointMetadata("small", EDGEGRASP_SMALL, 0.0045, "panda")
    save_checkpoint(weights, build_network(EDGEGRASP_SMALL), metadata)
    said = run("quantise", weights, data, "--output", output)
    assert "logits correlate 0.99" in said or "logits correlate 1.00" in said
    assert load_checkpoint(output)[1].name == "small-int8"
    assert output.stat().st_size < 0.7 * weights.stat().st_size
    assert "got 'edgegrasp-int8'" in refused("quantise", output, data)
    assert "no .npz views" in refused("quantise", weights, tmp_path)


def test_wrong_arguments_end_with_a_sentence(data: Path, tmp_path: Path) -> None:
    assert "no .npz views" in refused("train", tmp_path)
    assert "edgegrasp-plus" in refused("train", data, "--model", "huge")
    assert "local_emd_model" in refused("import-checkpoint", tmp_path)
    assert "shelf" in refused("benchmark", "--scene", "shelf")
    assert "urdf" in refused("benchmark", "--scene", "pile", "--objects", tmp_path)
    assert "rounds is 0" in refused("benchmark", "--rounds", 0)
    assert "edgegrasp, edgegrasp-fused, edgegrasp-memory, giga, robot, vgn" in refused(
        "benchmark", "--protocol", "paper"
    )
    assert "edge-sample" in refused("benchmark", "--planner", "guess")
    assert "cannot be loaded" in refused("benchmark", "--planner", "no_such:planner")
    assert "workers is 2" in refused("benchmark", "--gui", "--workers", 2)
    assert "ray is 'local'" in refused("benchmark", "--gui", "--ray", "local")
    assert "pass --server" in refused("benchmark", "--ray", "10.0.0.1:6379")
    assert "no such file" in refused("benchmark", "--model", "absent.safetensors")
    assert "UNAVAILABLE" in refused("benchmark", "--server", "127.0.0.1:1")
