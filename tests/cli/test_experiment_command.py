"""`edgegrasp experiment`, end to end and small."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from edgegrasp_cli.main import app
from edgegrasp_sim import experiments

ONE_ROUND = ("--rounds", "1", "--seed", "0", "--scene", "packed", "--workers", "1")
TOP_DOWN = "edgegrasp_sim.top_down:plan_top_down"


def run(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


def test_an_experiment_writes_figures_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert second["cases"][0]["protocol"] == {"name": "edgegrasp", "version": 2}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("guess",), "robustness, samples, labels, families, baselines"),
        (("samples", "--scene", "shelf"), "shelf"),
        (("samples", "--model", "none.safetensors"), "no such file"),
        (
            ("samples", "--protocol", "paper"),
            "edgegrasp, edgegrasp-fused, edgegrasp-memory, giga, robot, vgn",
        ),
    ],
)
def test_wrong_arguments_end_with_a_sentence(
    words: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    asked = ["experiment", *words, "--rounds", "1", "--output", str(tmp_path)]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 1
    assert message in result.output
