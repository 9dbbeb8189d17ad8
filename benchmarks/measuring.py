"""Shared by the benchmarks: alternating runs, the machine, a server's memory."""

import json
import os
import platform
import re
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import psutil

from edgegrasp_service.settings import MIB

RESULTS = Path(__file__).parent / "results"
RUNS = 5


def time_interleaved(
    variants: Mapping[str, Callable[[], object]],  # functions to run, by name
    # Processor time, which other work on the machine changes little; or wall-clock time.
    clock: Callable[[], float] = time.process_time,
) -> dict[str, list[float]]:
    """Seconds of each variant in each of RUNS rounds, after a warm-up round."""
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for number in range(RUNS + 1):
        for name, variant in variants.items():
            start = clock()
            variant()
            if number:
                seconds[name].append(clock() - start)
    return seconds


def machine() -> dict[str, Any]:
    """The machine: its processor, speed, load and versions."""
    import torch

    model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    left, right = torch.rand(4096, 1024), torch.rand(1024, 1024)
    product = statistics.median(time_interleaved({"product": lambda: left @ right})["product"])
    return {
        "processor": model[1] if model else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "threads": torch.get_num_threads(),
        "gflops": 2e-9 * 4096 * 1024 * 1024 / product,  # float32, per thread
        "load_average": os.getloadavg()[0],  # other work on the machine makes everything slower
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def write_results(folder: Path, name: str, results: Mapping[str, Any]) -> None:
    """Write `name`.json into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(results, indent=1) + "\n")


def memory(pid: int) -> float:
    """Resident memory of a server's processes, MiB; shared pages count once."""
    front = psutil.Process(pid)
    return sum(one.memory_full_info().pss for one in [front, *front.children(recursive=True)]) / MIB
