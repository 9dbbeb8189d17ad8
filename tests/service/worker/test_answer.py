"""The worker: the same answer over both transports, facts, deadlines and faults."""

import json
from typing import Any

import numpy as np
import pytest
from benchmarks.dummy import DummyCatalogue

from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import answer
from edgegrasp_service.worker.process import Job


class FailingCatalogue(DummyCatalogue):
    """Its network raises."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self.error = error

    def get(self, name: str = "") -> Any:
        detector = super().get(name)

        def evaluate(prepared: object) -> Any:
            raise self.error

        detector.evaluate = evaluate  # type: ignore[method-assign]
        return detector


def job(points: np.ndarray, remaining: float = 30.0, **options: Any) -> Job:
    body = json.dumps({"points": points.tolist(), "options": options}).encode()
    return Job("DetectGrasps", "http", body, remaining, "application/json")


def test_a_fault_is_told_to_the_log_alone(points: np.ndarray) -> None:
    failing = FailingCatalogue(ZeroDivisionError("a secret"))
    told = answer(job(points, seed=7), failing, Settings())
    assert told.error is not None
    assert (told.error.kind, told.error.status) == ("detector-failed", 500)
    assert "secret" not in told.error.detail
    assert "ZeroDivisionError: a secret" in told.facts.traceback
    assert json.loads(told.facts.options) == {"seed": 7}


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")]
)
def test_a_process_without_memory_says_so(points: np.ndarray, error: Exception) -> None:
    with pytest.raises(MemoryError):
        answer(job(points), FailingCatalogue(error), Settings())
