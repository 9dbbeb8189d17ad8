"""The scaling curves: what they measure and draw, without waiting for them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from benchmarks import curves

from edgegrasp_sim.camera import Observation

if TYPE_CHECKING:
    from pathlib import Path


def test_peak_memory_is_that_of_the_run_alone() -> None:
    large = curves.peak_memory(lambda: np.ones(50_000_000))  # 400 MB, let go again
    small = curves.peak_memory(lambda: np.ones(1_000))
    assert large - small > 300


def test_each_value_is_run_for_memory_and_for_time() -> None:
    calls: list[int] = []
    variants = {value: lambda value=value: calls.append(value) for value in (1, 2)}
    found = curves.measured(variants, runs=2)
    assert calls == [1, 2] + [1, 2] * 3  # memory; a round that does not count and two that do
    assert {key: list(values) for key, values in found.items()} == {
        "seconds": ["1", "2"],
        "memory_mb": ["1", "2"],
    }


def test_a_picture_has_a_column_for_each_quantity(tmp_path: Path) -> None:
    one = {"seconds": {"1": 0.1, "2": 0.2}, "memory_mb": {"1": 100.0, "2": 120.0}}
    curves.draw({"points": one, "threads": one}, tmp_path / "scaling.png")
    assert (tmp_path / "scaling.png").stat().st_size > 1000


def test_clouds_of_any_size_lie_on_the_same_surfaces() -> None:
    cloud = np.random.default_rng(0).uniform(0.0, 0.1, (50, 3)).astype(np.float32)
    larger = curves.cloud_of(500, cloud)
    assert larger.shape == (500, 3)
    apart = np.linalg.norm(larger[:, None] - cloud, axis=2).min(axis=1)
    assert 0 < apart.max() < 10 * curves.SCATTER


def test_every_curve_asks_for_its_values() -> None:
    camera, pose = np.array([0.4, 0.5, 0.6], np.float32), np.eye(4)
    cloud = np.random.default_rng(0).uniform(0.1, 0.2, (400, 3)).astype(np.float32)
    seen = Observation(
        cloud, pose, camera, np.zeros((2, 3)), 0.05, camera[None], np.zeros(400, np.int32)
    )
    variants = curves.curves(seen)
    assert list(variants["points"]) == list(curves.POINTS)
    assert len(variants["points"][1_000].args[0]) == 1_000  # type: ignore[attr-defined]
    names = {
        "approach points": "approach points",
        "candidates": "candidates (256 approach points)",
    }
    asked = {name: variants[title] for name, title in names.items()}
    options = {name: [run.args[1] for run in runs.values()] for name, runs in asked.items()}
    assert [o.num_approach_points for o in options["approach points"]] == [8, 16, 32, 64, 128, 256]
    assert [o.num_candidates for o in options["candidates"]] == list(curves.CANDIDATES)
    assert {o.collision.mode for o in options["candidates"]} == {"ignore"}
