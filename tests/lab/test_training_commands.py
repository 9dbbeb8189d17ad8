"""The commands that make data and train weights; tests/project has them one after the other."""

import json
from pathlib import Path

import pytest
from tests.cli.commands import refused, run

from edgegrasp_model.networks.checkpoint import load_checkpoint
from edgegrasp_training.recipes import recipe

VIEWS = ("--scenes", 4, "--scene", "packed", "--views-per-scene", 1, "--grasps-per-view", 8)
VIEWS += ("--workers", 1)  # processes take longer to start than these scenes to make


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    assert "4 scenes made, 0 kept" in run("generate-data", folder, *VIEWS)
    return folder


def test_training_pauses_goes_on_and_is_recalibrated(data, tmp_path) -> None:
    assert "0 scenes made, 4 kept" in run("generate-data", data, *VIEWS)
    amount = ("--steps", 4, "--views-per-step", 2, "--validation-share", 0.3)
    training = ("train", data, "--run", tmp_path, *amount)
    assert "paused at step 2" in run(*training, "--until", 2)
    assert "AUROC" in run(*training)
    weights = tmp_path / "edgegrasp-plus.safetensors"
    _, metadata = load_checkpoint(weights)
    assert metadata.training["steps"] == 4
    assert metadata.network == recipe("edgegrasp-plus").network
    assert (tmp_path / "edgegrasp-plus.md").is_file()

    tried = {"digest": metadata.digest, "score": 0.9, "held": False}
    outcomes = tmp_path / "outcomes.jsonl"
    outcomes.write_text(json.dumps(tried) + "\n")
    robot = ("--outcomes", outcomes, "--start-from", weights, "--run", tmp_path / "robot")
    assert "1 outcomes, 0.00 held" in run("train", *robot)
    assert (tmp_path / "robot" / "edgegrasp-plus-robot.safetensors").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("train", "FOLDER"), "no .npz views"),
        (("train", "DATA", "--model", "huge"), "edgegrasp-plus"),
        (("train", "DATA", "--device", "gpu"), "Use auto, cpu, cuda"),
        (("train", "DATA", "--keep", "0.5"), "--keep: got no weights"),
        (("generate-data", "FOLDER", "--weights", "gone.safetensors"), "checkpoint: got"),
        (("train", "DATA", "--validation-share", "1"), "Make more"),
        (("import-checkpoint", "FOLDER"), "local_emd_model"),
        (("benchmark", "--scene", "attic"), "attic"),
        (("benchmark", "--objects", "FOLDER"), "urdf"),
        (("benchmark", "--rounds", "0"), "rounds is 0"),
        (("benchmark", "--protocol", "paper"), "choose one of bin, bin-full, edgegrasp"),
        (("benchmark", "--collision", "dodge"), "options.collision: got 'dodge'"),
        (("benchmark", "--planner", "guess"), "choose one of server, in-process"),
        (("benchmark", "--planner", ":loads"), "or module:callable"),
        (("benchmark", "--planner", "no_such:planner"), "cannot be loaded"),
        (("benchmark", "--planner", "json:no_such"), "cannot be loaded"),
        (("benchmark", "--planner", "math:pi"), "is not callable"),
        (("benchmark", "--planner", "json:loads", "--model", "edgegrasp"), "leave out --model"),
        (("benchmark", "--planner", "json:loads", "--min-score", "0.9"), "leave out --model"),
        (("benchmark", "--robot", "ur5", "--gripper", "panda"), "ur5 has its own"),
        (("benchmark", "--ray", "10.0.0.1:6379"), "pass --server"),
        (("benchmark", "--model", "absent.safetensors"), "no such file"),
        (("benchmark", "--model", "a.safetensors", "--server", ":1"), "server's own weights"),
        (("benchmark", "--server", "127.0.0.1:1"), "`edgegrasp serve`"),
        (("benchmark", "--planner", "json:loads", "--gate", "gone.json"), "gone.json"),
        (("benchmark-tracking", "--motion", "fast"), "Choose one of still, pushed"),
    ],
)
def test_wrong_arguments_end_with_a_sentence(words, message, data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places = {"DATA": data, "FOLDER": tmp_path}
    assert message in refused(*(places.get(word, word) for word in words))
