"""docs/make_results.py makes a page of what the commands leave."""

import importlib
import json
import shutil
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("make_results")


def test_results_become_a_page(results: ModuleType, edge_sample: Path, tmp_path: Path) -> None:
    found, kept = tmp_path / "found", tmp_path / "kept"
    shutil.copytree(edge_sample, found / "edge-sample")
    (found / "samples").mkdir()
    shutil.copy(DOCS / "results" / "samples.json", found / "samples" / "experiment.json")
    shutil.copy(DOCS / "results" / "samples.png", found / "samples" / "picture.png")
    (found / "small").mkdir()
    rows = [f"{step},0.001,0.5,{0.5 - step / 1000},0.8,0.9" for step in range(0, 200)]
    head = "step,learning_rate,train_loss,validation_loss,accuracy,auroc"
    (found / "small" / "log.csv").write_text("\n".join([head, *rows]) + "\n")

    results.collect(found, kept)
    page = results.page(kept)
    (record,) = json.loads((kept / "benchmarks.json").read_text()).values()
    assert f"| {100 * record['grasp_success_rate']['value']:.1f} [" in page
    command = "$ edgegrasp benchmark --scene packed --protocol edgegrasp --planner edge-sample "
    assert command in page
    assert "| *EdgeGraspNet* (Edge Grasp Network, ICRA 2023) | edgegrasp | 64-4k |" in page
    assert "\n| 32-2k | " in page
    assert "\n| small | 199 | 0.301 | 0.8 | 0.9 |" in page
    assert {path.name for path in kept.glob("*.png")} == {"samples.png", "curves.png"}
    # What is found again replaces what was kept; what is not stays.
    results.collect(found / "edge-sample", kept)
    assert results.page(kept) == page


def test_a_folder_without_results_is_refused(results: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no results of benchmark"):
        results.collect(tmp_path, tmp_path / "kept")
