"""How time grows with points, approach points, candidates, threads and batch."""

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.timing import interleaved

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.options import DetectOptions
from edgegrasp_sim.simulation import Observation

POINTS = (1_000, 10_000, 100_000, 1_000_000)
APPROACH_POINTS = (8, 16, 32, 64, 128, 256)
CANDIDATES = (500, 1_000, 2_000, 4_000, 8_000, 16_000)
BATCHES = (1, 2, 4, 8)
THREADS = (1, 2)
RUNS = 3


def measure_curves(detector: GraspDetector, observation: Observation) -> dict[str, Any]:
    """Median seconds for each value of each quantity; by the clock for threads, else processor."""
    rng = np.random.default_rng(0)
    viewpoint = tuple(observation.camera_position.tolist())

    def request(**options: int) -> DetectOptions:
        asked = {"num_approach_points": 32, "num_candidates": 2_000} | options
        return DetectOptions(viewpoint=viewpoint, **asked)

    def cloud_of(count: int) -> np.ndarray:
        rows = rng.integers(len(observation.cloud), size=count)
        scattered = observation.cloud[rows] + rng.normal(0.0, 2e-4, (count, 3))
        return scattered.astype(np.float32)

    clouds = {count: cloud_of(count) for count in POINTS}
    whole = observation.cloud
    batch = detector.prepare(whole, request()).batch
    assert batch is not None
    return {
        "points": _medians({n: lambda n=n: detector.detect(clouds[n], request()) for n in POINTS}),
        "approach points": _medians(
            {
                n: lambda n=n: detector.detect(whole, request(num_approach_points=n))
                for n in APPROACH_POINTS
            }
        ),
        "candidates": _medians(
            {
                n: lambda n=n: detector.detect(
                    whole, request(num_candidates=n, num_approach_points=128)
                )
                for n in CANDIDATES
            }
        ),
        "scenes in a batch": _medians(
            {n: lambda n=n: detector.run(BallBatch.concatenate([batch] * n)) for n in BATCHES}
        ),
        "threads": {str(n): _clock(n, lambda: detector.run(batch)) for n in THREADS},
    }


def draw(curves: dict[str, Any], path: Path) -> None:
    """One small plot for each quantity."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 2.6), layout="constrained")
    for axes, (name, curve) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        axes.plot([int(value) for value in curve], list(curve.values()), "o-")
        axes.set(xscale="log", yscale="log", xlabel=name)
        axes.grid(visible=True, which="both", alpha=0.3)
    figure.axes[0].set_ylabel("seconds")
    figure.savefig(path, dpi=90)


def _medians(variants: dict[int, Callable[[], object]]) -> dict[str, float]:
    times = interleaved({str(value): run for value, run in variants.items()}, RUNS)
    return {value: statistics.median(seconds) for value, seconds in times.items()}


def _clock(threads: int, run: Callable[[], object]) -> float:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        seconds = []
        for _ in range(RUNS):
            start = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - start)
        return statistics.median(seconds)
    finally:
        torch.set_num_threads(before)
