"""The GPU benchmark runs on a processor too, on tiny networks."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from benchmarks import gpu

from edgegrasp_model.errors import InvalidDevice

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def kept_cloud(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-0.5, 0.5, (2, 600))
    top = np.stack([u, v, np.full(600, 0.5)], axis=1)
    side = np.stack([np.full(600, 0.5), u, v], axis=1)
    cloud = np.concatenate([top, side]) * (0.04, 0.06, 0.08) + (0, 0, 0.04)
    file = tmp_path / "view.npz"
    np.savez(file, cloud=cloud.astype(np.float32), camera=np.array([0.3, 0.0, 0.5]), table=0.0)
    return file


def test_it_measures_everything_on_a_processor(kept_cloud: Path, tmp_path: Path) -> None:
    words = ["--device", "cpu", "--quick", "--cloud", str(kept_cloud), "--output", str(tmp_path)]
    gpu.main(words)
    results = json.loads((tmp_path / "gpu.json").read_text())
    assert [row["network"] for row in results["sizes"]] == list(gpu.QUICK.networks)
    for row in results["sizes"]:
        assert 0 < row["scored"] <= row["candidates"]
        assert row["network_ms"]["ours"] > 0.0
        assert row["end_to_end_ms"]["ours"] > 0.0
        assert ("textbook" in row["network_ms"]) == (row["network"] != "HandNet")
        assert row["network_peak_mb"] is None
    assert {row["scenes_at_once"] for row in results["throughput"]} == {1, 2}
    assert all(row["scenes_per_second"] > 0.0 for row in results["throughput"])
    assert {row["precision"] for row in results["precision"]} == {"float16", "bfloat16"}
    for row in results["precision"]:
        assert -1.0 <= row["least_correlation"] <= 1.0
        assert row["enough"] == (row["least_correlation"] >= 0.999)
    written = (tmp_path / "gpu.md").read_text()
    assert "| EdgeGraspNet 4-60 |" in written
    assert "the processor" in written


def test_the_axes_are_the_papers() -> None:
    asked = set(gpu.FULL.sizes)
    for approach_points, candidates in (
        *((16, 2000), (32, 2000), (64, 2000)),
        *((32, 500), (32, 1000), (64, 4000)),
    ):
        assert ("EdgeGraspNet", approach_points, candidates) in asked
    assert ("VN-EdgeGraspNet", 64, 4000) in asked
    for name in gpu.FULL.networks:
        assert gpu.usual_size(name, gpu.FULL.sizes) == (name, 32, 2000)


def test_weights_that_ship_are_measured_too() -> None:
    shipped = gpu.shipped_detectors(torch.device("cpu"))
    assert "edgegrasp-plus" in shipped


def test_a_gpu_that_is_not_there_is_named(
    kept_cloud: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InvalidDevice, match="device: got 'cuda'"):
        gpu.main(["--device", "cuda", "--cloud", str(kept_cloud)])
