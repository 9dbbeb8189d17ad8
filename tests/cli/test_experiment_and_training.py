"""The commands that run many benchmarks or train weights, end to end and small."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from edgegrasp_model.networks.checkpoint import load_checkpoint
from edgegrasp_sim import experiments
from edgegrasp_training.recipes import recipe

ONE_ROUND = ("--rounds", 1, "--seed", 0, "--scene", "packed", "--workers", 1)
TOP_DOWN = "edgegrasp_sim.top_down:plan_top_down"
VIEWS = ("--scenes", 4, "--views-per-scene", 1, "--grasps-per-view", 10, "--seed", 3)


@pytest.fixture(scope="module")
def data(run: Callable[..., str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    assert "4 scenes made, 0 kept" in run("generate-data", folder, *VIEWS)
    return folder


def test_generate_train_serve_and_benchmark_one_after_the_other(data, run, tmp_path) -> None:
    assert "0 scenes made, 4 kept" in run("generate-data", data, *VIEWS)
    amount = ("--steps", 4, "--views-per-step", 2, "--validation-share", 0.3)
    training = ("train", data, "--run", tmp_path, *amount, "--crop-radius", 0.06)
    assert "paused at step 2" in run(*training, "--until", 2)
    assert "AUROC" in run(*training)
    weights = tmp_path / "edgegrasp-plus.safetensors"
    _, metadata = load_checkpoint(weights)
    assert metadata.training["steps"] == 4
    assert metadata.network == replace(recipe("edgegrasp-plus").network, crop_radius=0.06)
    assert (tmp_path / "edgegrasp-plus.md").is_file()

    tried = {"digest": metadata.digest, "score": 0.9, "held": False}
    outcomes = tmp_path / "outcomes.jsonl"
    outcomes.write_text(json.dumps(tried) + "\n")
    robot = ("--outcomes", outcomes, "--start-from", weights, "--run", tmp_path / "robot")
    assert "1 outcomes, 0.00 held" in run("train", *robot)
    assert (tmp_path / "robot" / "edgegrasp-plus-robot.safetensors").is_file()

    result = tmp_path / "result"
    own = ("--weights", weights, "--model", "edgegrasp-plus", "--num-candidates", 200)
    output = run("benchmark", *ONE_ROUND, *own, "--no-report", "--output", result)
    assert "GSR" in output
    planner = json.loads((result / "manifest.json").read_text())["run"]["planner"]
    assert planner["digest"] == metadata.digest
    assert planner["options"]["num_candidates"] == 200
    summary = json.loads((result / "summary.json").read_text())
    with (result / "attempts.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == summary["attempts"]


def test_an_experiment_writes_figures_and_goes_on_where_it_was(run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(experiments, "BASELINES", ("edge-sample",))
    output = run("experiment", "baselines", *ONE_ROUND, "--output", tmp_path)
    first = json.loads((tmp_path / "experiment.json").read_text())
    assert "| edge-sample | " in (tmp_path / "table.md").read_text()
    assert (tmp_path / "table.md").read_text() in output
    assert (tmp_path / "picture.png").read_bytes()[1:4] == b"PNG"
    (done,) = tmp_path.glob("cases/*/rounds/*.json")
    before = done.stat().st_mtime_ns

    monkeypatch.setattr(experiments, "BASELINES", ("edge-sample", TOP_DOWN))
    run("experiment", "baselines", *ONE_ROUND, "--output", tmp_path)
    second = json.loads((tmp_path / "experiment.json").read_text())
    assert done.stat().st_mtime_ns == before
    assert second["cases"][0] == first["cases"][0]
    assert [case["value"] for case in second["cases"]] == ["edge-sample", TOP_DOWN]
    assert second["cases"][0]["planner"]["num_candidates"] == 4000  # the protocol's, as planned


PROTOCOLS = (
    "bin, bin-full, edgegrasp, edgegrasp-fused, edgegrasp-memory, edgegrasp-thin, giga, "
    "giga-cropped, robot, shelf, table, vgn"
)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("experiment", "guess"), "robustness, samples, labels, families, baselines"),
        (("experiment", "samples", "--scene", "attic"), "attic"),
        (("experiment", "samples", "--model", "none.safetensors"), "no such file"),
        (("experiment", "samples", "--protocol", "paper"), PROTOCOLS),
        (("train", "FOLDER"), "no .npz views"),
        (("train", "DATA", "--model", "huge"), "edgegrasp-plus"),
        (("import-checkpoint", "FOLDER"), "local_emd_model"),
        (("benchmark", "--scene", "attic"), "attic"),
        (("benchmark", "--objects", "FOLDER"), "urdf"),
        (("benchmark", "--rounds", "0"), "rounds is 0"),
        (("benchmark", "--protocol", "paper"), PROTOCOLS),
        (("benchmark", "--collision", "dodge"), "options.collision: got 'dodge'"),
        (("benchmark", "--planner", "guess"), "edge-sample"),
        (("benchmark", "--planner", "no_such:planner"), "cannot be loaded"),
        (("benchmark", "--ray", "10.0.0.1:6379"), "pass --server"),
        (("benchmark", "--model", "absent.safetensors"), "no such file"),
        (("benchmark", "--server", "127.0.0.1:1"), "UNAVAILABLE"),
    ],
)
def test_wrong_arguments_end_with_a_sentence(words, message, data, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places = {"DATA": data, "FOLDER": tmp_path}
    assert message in refused(*(places.get(word, word) for word in words))
