"""A detector without a server around it, in this process or in one of its own.

`python -m benchmarks.in_process KIND` detects once for each line on stdin and writes the seconds
by the clock and of processors; KIND is "network", or the milliseconds of a dummy.
"""

import sys
import time
from typing import Any

from benchmarks.apart import measure_when_asked
from benchmarks.senders import cloud

from edgegrasp_service.allocator import keep_freed_memory

POINTS = 20_000
OPTIONS = {"num_approach_points": 32, "num_candidates": 500}


class InProcess:
    """A detector called in this process."""

    def __init__(self, kind: str) -> None:
        self._detector = _detector(kind)
        self._points = cloud(POINTS, seed=0)

    def seconds(self) -> tuple[float, float]:
        """What one detection takes, by the clock and of processors."""
        from edgegrasp_model.options import parse_options
        from edgegrasp_model.scene.cloud import CloudInput

        parsed = parse_options(dict(OPTIONS))
        start, cpu = time.perf_counter(), time.process_time()
        prepared = self._detector.prepare(CloudInput(self._points), parsed)
        logits = self._detector.run(prepared.batch)
        self._detector.finish(prepared, logits)
        return time.perf_counter() - start, time.process_time() - cpu


def _detector(kind: str) -> Any:
    """The dummy network of a service time, or the default weights on one thread."""
    if kind != "network":
        from edgegrasp_service.dummy import DummyDetector

        return DummyDetector(float(kind) / 1000)
    import torch

    from edgegrasp_model.detector import ModelCatalogue

    torch.set_num_threads(1)
    return ModelCatalogue.load((), default="", grippers=()).get("")


if __name__ == "__main__":
    keep_freed_memory()  # as the server does
    measure_when_asked(InProcess(sys.argv[1]).seconds)
