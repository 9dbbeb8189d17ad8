"""Several observers as one; a fault of one is logged, and harms neither the others nor requests."""

import logging
from collections.abc import Sequence
from typing import Any

from edgegrasp_model.results import Detection, Scoring
from edgegrasp_service.call import Call
from edgegrasp_service.errors import ErrorReport
from edgegrasp_service.observer import Observer

logger = logging.getLogger(__name__)


class Observers(Observer):
    """Tells each of several observers."""

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._observers = tuple(observers)

    def started(self, call: Call) -> None:
        """Tell of a request."""
        self._tell("started", call)

    def stage(self, call: Call, name: str, seconds: float) -> None:
        """Tell of a stage."""
        self._tell("stage", call, name, seconds)

    def places(self, active: int, waiting: int) -> None:
        """Tell of the queue."""
        self._tell("places", active, waiting)

    def batched(self, requests: int, balls: int, points: int) -> None:
        """Tell of a batch."""
        self._tell("batched", requests, balls, points)

    def answered(self, call: Call, answer: Detection | Scoring) -> None:
        """Tell of an answer."""
        self._tell("answered", call, answer)

    def worker_replaced(self, reason: str) -> None:
        """Tell of a thread that died."""
        self._tell("worker_replaced", reason)

    def finished(self, call: Call, problem: ErrorReport | None) -> None:
        """Tell of a request's end."""
        self._tell("finished", call, problem)

    def _tell(self, what: str, *facts: Any) -> None:
        for observer in self._observers:
            try:
                getattr(observer, what)(*facts)
            except Exception:
                logger.exception("%s failed on %s", type(observer).__name__, what)
