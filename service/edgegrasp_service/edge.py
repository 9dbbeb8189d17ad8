"""What is the same at the edge of both transports, before and after the service itself."""

import asyncio
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from edgegrasp_service.errors import HeadersTooLarge, NotReady
from edgegrasp_service.metrics import Metrics
from edgegrasp_service.request_id import HEADER, REQUEST_ID, TRACEPARENT, usable_request_id
from edgegrasp_service.tokens import Tokens

MAX_HEADERS = 64
PROBES = ("Live", "Ready", "HealthCheck", "Metrics")  # every few seconds; not worth a line

logger = logging.getLogger("edgegrasp_service.requests")


@dataclass
class Answered:
    """How a request ends; the transport fills in the code."""

    code: str
    long: bool = False  # a stream, whose duration says nothing


class GivenUp(Exception):  # noqa: N818
    """The grace of a stopping server is over; `reason` tells the caller."""

    reason = NotReady("The server stopped before there was an answer. Try another one.")


class Edge:
    """Who may ask, what a request is called, and what is counted and logged of it.

    Attributes:
        tokens: Replaced when they are read anew.
        draining: Whether the server is stopping.
    """

    def __init__(self, tokens: Tokens, metrics: Metrics, max_header_bytes: int) -> None:
        self.max_header_bytes = max_header_bytes
        self.tokens = tokens
        self.metrics = metrics
        self.draining = False
        self.unanswered = 0  # streams are not counted: they may never end
        self._given_up = False
        self._tasks: set[asyncio.Task[object]] = set()

    @contextmanager
    def request(
        self, transport: str, method: str, headers: dict[str, str], answered: Answered
    ) -> Iterator[str]:
        """Name, count and log one request.

        Args:
            transport: "grpc" or "http".
            method: For metrics and the log.
            headers: By their lower-case names.
            answered: Read when the request ends.

        Yields:
            The request's id.
        """
        request_id = usable_request_id(headers.get(HEADER))
        REQUEST_ID.set(request_id)  # of the request's own task
        TRACEPARENT.set(headers.get("traceparent", ""))
        start = time.monotonic()
        self._count(answered, 1)
        try:
            yield request_id
        finally:
            seconds = time.monotonic() - start
            # Once the answer is on its way; in this task's context, which knows the request's id.
            loop = asyncio.get_running_loop()
            loop.call_soon(self._ended, transport, method, answered, seconds)

    def _ended(self, transport: str, method: str, answered: Answered, seconds: float) -> None:
        self._count(answered, -1)
        timed = None if answered.long else seconds
        self.metrics.request(transport, method, answered.code, timed)
        fields = {"transport": transport, "method": method, "code": answered.code}
        level = logging.DEBUG if method in PROBES else logging.INFO
        if logger.isEnabledFor(level):
            logger.log(level, "request", extra={"fields": fields | {"seconds": round(seconds, 6)}})

    @contextmanager
    def until_given_up(self) -> Iterator[None]:
        """Do what the running task does, until `give_up`; raises GivenUp then."""
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            yield
        except asyncio.CancelledError:
            if not self._given_up:
                raise
            task.uncancel()
            raise GivenUp from None
        finally:
            self._tasks.discard(task)

    def give_up(self) -> None:
        """End what is still under way; those who wait for it are told."""
        self._given_up = True
        for task in self._tasks:
            task.cancel()

    def _count(self, answered: Answered, change: int) -> None:
        if not answered.long:
            self.unanswered += change
            self.metrics.in_flight(change)


def check_headers(kind: str, count: int, size: int = 0, most: int = 0) -> None:
    """Pass where headers are few and short; what they are read with bounds them only roughly.

    Args:
        kind: What they are called.
        count: How many.
        size: Bytes of them all.
        most: Bytes accepted.

    Raises:
        HeadersTooLarge: They are more than MAX_HEADERS, or larger than `most`.
    """
    if count > MAX_HEADERS:
        raise HeadersTooLarge(kind, f"{count} entries", f"Send at most {MAX_HEADERS}.")
    if size > most:
        raise HeadersTooLarge(kind, f"{size} bytes", f"Send at most {most}.")
