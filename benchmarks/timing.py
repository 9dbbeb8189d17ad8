"""Timing side by side: variants take turns, so that other work on the machine meets all alike."""

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

RUNS = 5


def interleaved(
    variants: Mapping[str, Callable[[], object]],
    runs: int = RUNS,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, list[float]]:
    """Seconds of each variant in each of `runs` rounds, after one that does not count.

    Args:
        variants: What to run, by name.
        runs: Rounds that count.
        clock: Of the processor, which other work on the machine changes little; or of the wall.
    """
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for number in range(runs + 1):
        for name, variant in variants.items():
            start = clock()
            variant()
            if number:
                seconds[name].append(clock() - start)
    return seconds


def summary(seconds: Mapping[str, list[float]], ours: str, theirs: str) -> dict[str, Any]:
    """Medians of each variant, and of the ratio of two of them round by round."""
    ratios = [b / a for a, b in zip(seconds[ours], seconds[theirs], strict=True)]
    return {
        "seconds": {name: statistics.median(times) for name, times in seconds.items()},
        "times_faster": statistics.median(ratios),
        "rounds": len(ratios),
    }


def machine() -> dict[str, Any]:
    """Where it was measured."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "threads": torch.get_num_threads(),
        "gflops": _gflops(),
        "load_average": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _gflops() -> float:
    """Float32 matrix products, 10⁹ operations per processor second and thread."""
    left, right = torch.rand(4096, 1024), torch.rand(1024, 1024)
    times = interleaved({"product": lambda: left @ right})["product"]
    return 2e-9 * 4096 * 1024 * 1024 / statistics.median(times)
