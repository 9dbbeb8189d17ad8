"""How time and memory grow: `python -m benchmarks.curves` writes scaling.json and scaling.png.

The small network in the whole pipeline, against the points of the cloud, the approach points, the
candidates and the threads.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.measuring import RESULTS, RUNS, interleaved, machine, write_results
from benchmarks.speed import detector, observe, request

from edgegrasp_model.networks.config import EDGEGRASP_SMALL
from edgegrasp_model.options import Collision
from edgegrasp_sim.camera import Observation

POINTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
APPROACH_POINTS = (8, 16, 32, 64, 128, 256)
CANDIDATES = (500, 1_000, 2_000, 4_000, 8_000, 16_000)
MANY_APPROACH_POINTS = 256  # so that there are enough candidates, those that collide among them
THREADS = (1, 2)
SCATTER = 2e-4  # metres between a point of the scene and those put in its place


def main() -> None:
    """Measure every curve, write and draw them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.curves")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--runs", type=int, default=RUNS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    start = time.perf_counter()
    observation = observe()
    results: dict[str, Any] = {"machine": machine(), "cloud_points": len(observation.cloud)}
    results["curves"] = {}
    for name, variants in curves(observation).items():
        results["curves"][name] = measured(variants, given.runs)
        print(name, results["curves"][name], flush=True)
    results["minutes"] = (time.perf_counter() - start) / 60
    write_results(given.output, "scaling", results)
    draw(results["curves"], given.output / "scaling.png")


def curves(observation: Observation) -> dict[str, dict[int, Callable[[], object]]]:
    """What to run for each value of each quantity."""
    small, cloud = detector(EDGEGRASP_SMALL), observation.cloud

    def detect(
        points: int | None = None, threads: int = 1, *, every: bool = False, **numbers: int
    ) -> Callable[[], object]:
        seen = cloud if points is None else cloud_of(points, cloud)
        options = request(observation, **numbers)
        if every:
            options = options.model_copy(update={"collision": Collision(mode="ignore")})

        def run() -> None:
            torch.set_num_threads(threads)
            small.detect(seen, options)
            torch.set_num_threads(1)

        return run

    many = {"num_approach_points": MANY_APPROACH_POINTS, "every": True}
    return {
        "points": {n: detect(n) for n in POINTS},
        "approach points": {n: detect(num_approach_points=n) for n in APPROACH_POINTS},
        f"candidates ({MANY_APPROACH_POINTS} approach points)": {
            n: detect(num_candidates=n, **many) for n in CANDIDATES
        },
        "threads": {n: detect(threads=n) for n in THREADS},
    }


def cloud_of(count: int, cloud: np.ndarray) -> np.ndarray:
    """A cloud (count, 3) of the same surfaces."""
    rng = np.random.default_rng(count)
    rows = rng.integers(len(cloud), size=count)
    scattered = cloud[rows] + rng.normal(0.0, SCATTER, (count, 3))
    return scattered.astype(np.float32)


def measured(variants: Mapping[int, Callable[[], object]], runs: int) -> dict[str, Any]:
    """Median seconds by the clock and the process's peak memory for each value, ascending."""
    memory = {str(value): peak_memory(run) for value, run in variants.items()}
    by_name = {str(value): run for value, run in variants.items()}
    times = interleaved(by_name, runs, clock=time.perf_counter)
    return {
        "seconds": {value: statistics.median(seconds) for value, seconds in times.items()},
        "memory_mb": memory,
    }


def peak_memory(run: Callable[[], object]) -> float:
    """Most resident memory of this process while something runs, MB."""
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
    run()
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    raise LookupError("VmHWM")


def draw(curves: Mapping[str, Any], path: Path) -> None:
    """Time above memory, a column for each quantity."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    short = EngFormatter(sep="")  # 1000 as 1k
    figure = Figure(figsize=(14, 5), layout="constrained")
    axes = figure.subplots(2, len(curves), sharex="col", squeeze=False)
    for (above, below), (name, curve) in zip(axes.T, curves.items(), strict=True):
        for plot, key in ((above, "seconds"), (below, "memory_mb")):
            values, measured = [int(value) for value in curve[key]], list(curve[key].values())
            plot.plot(values, measured, "o-")
            plot.set(xscale="log", ylim=(0, 1.1 * max(measured)))  # room for the highest marker
            plot.grid(visible=True, alpha=0.3)
        below.set(xlabel=name)
        below.set_xticks(values, [short(value) for value in values], size="small")
        below.minorticks_off()
    axes[0, 0].set_ylabel("seconds")
    axes[1, 0].set_ylabel("peak memory, MB")
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
