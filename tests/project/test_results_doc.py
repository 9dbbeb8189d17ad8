"""docs/results.md says what the kept results say, and nothing else."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner

from edgegrasp_cli.main import app
from edgegrasp_sim import experiments

DOCS = Path(__file__).parents[2] / "docs"
KEPT = DOCS / "results"


def results() -> ModuleType:
    pytest.importorskip("matplotlib", reason="the extra `view` is not installed")
    spec = importlib.util.spec_from_file_location("make_results", DOCS / "make_results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_that_of_the_kept_results() -> None:
    assert (DOCS / "results.md").read_text() == results().page(KEPT)


def test_kept_results_are_small_and_name_no_folder_of_a_machine() -> None:
    for file in KEPT.glob("*"):
        assert file.stat().st_size < 300_000, file.name
        if file.suffix == ".json":
            assert "--objects /" not in file.read_text(), file.name


def test_kept_experiments_have_their_picture() -> None:
    module = results()
    for name in module.EXPERIMENTS:
        assert (KEPT / f"{name}.json").is_file() == (KEPT / f"{name}.png").is_file()


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the commands leave: a benchmark, an experiment, a training log."""
    root = tmp_path_factory.mktemp("results")
    common = ("--rounds", "1", "--seed", "0", "--scene", "packed", "--workers", "1")
    top_down = ("--planner", "edgegrasp_sim.top_down:plan_top_down", "--no-report")
    for words in (
        ("benchmark", *top_down, *common, "--output", str(root / "top-down")),
        ("experiment", "samples", *common, "--output", str(root / "samples")),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(experiments, "SAMPLES", {"4-0.05k": (4, 50), "8-0.1k": (8, 100)})
            done = CliRunner().invoke(app, list(words))
        assert done.exit_code == 0, done.output
    (root / "small").mkdir()
    rows = [f"{step},0.001,0.5,{0.5 - step / 1000},0.8,0.9" for step in range(0, 200)]
    head = "step,learning_rate,train_loss,validation_loss,accuracy,auroc"
    (root / "small" / "log.csv").write_text("\n".join([head, *rows]) + "\n")
    return root


def test_results_become_a_page(found: Path, tmp_path: Path) -> None:
    module = results()
    module.collect(found, tmp_path)
    page = module.page(tmp_path)
    kept = json.loads((tmp_path / "benchmarks.json").read_text())
    assert list(kept) == ["top-down"]  # not the cases of the experiment
    gsr = kept["top-down"]["grasp_success_rate"]["value"]
    assert f"| {100 * gsr:.1f} [" in page
    planner = "--planner edgegrasp_sim.top_down:plan_top_down"
    assert f"$ edgegrasp benchmark --scene packed --protocol edgegrasp {planner} " in page
    assert "| *EdgeGraspNet* (Edge Grasp Network, ICRA 2023) | edgegrasp | 64-4k |" in page
    for name in ("4-0.05k", "8-0.1k"):
        assert f"\n| {name} | " in page
    assert "\n| small | 199 | 0.301 | 0.8 | 0.9 |" in page
    assert {path.name for path in tmp_path.glob("*.png")} == {"samples.png", "curves.png"}
    # What is found again replaces what was kept; what is not stays.
    module.collect(found / "top-down", tmp_path)
    assert module.page(tmp_path) == page


def test_a_folder_without_results_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no results of benchmark"):
        results().collect(tmp_path, tmp_path / "kept")
