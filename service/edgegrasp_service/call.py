"""One request on its way through the server: who asked, by when, and whether anyone waits."""

import re
import time
import uuid
from collections.abc import Callable
from typing import Literal

from edgegrasp_service.errors import Cancelled, DeadlineExceeded

Transport = Literal["grpc", "http"]

_REQUEST_ID = re.compile(r"[\w.:+/=@-]{1,128}", re.ASCII)


class Call:
    """What every stage knows of the request it works on. Safe to use from any thread.

    Attributes:
        transport: The way it came.
        method: The gRPC method's name, e.g. "DetectGrasps", for either transport.
        request_id: The caller's own where it is usable, or else a new one.
    """

    def __init__(
        self,
        transport: Transport,
        method: str,
        *,
        request_id: str = "",
        timeout: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start a call.

        Args:
            transport: The way it came.
            method: The gRPC method's name.
            request_id: What the caller calls it; anything.
            timeout: Seconds the caller waits; None: as long as it takes.
            clock: Seconds that only go forward; the wall clock may jump.
        """
        self.transport = transport
        self.method = method
        usable = _REQUEST_ID.fullmatch(request_id) is not None
        self.request_id = request_id if usable else uuid.uuid4().hex
        self._clock = clock
        self._start = clock()
        self._deadline = None if timeout is None else self._start + timeout
        self._cancelled = False

    @property
    def seconds(self) -> float:
        """Time since it came in."""
        return self._clock() - self._start

    @property
    def remaining(self) -> float | None:
        """Seconds until its deadline, below zero after it; None: it has none."""
        return None if self._deadline is None else self._deadline - self._clock()

    @property
    def cancelled(self) -> bool:
        """Whether nobody waits for the answer any more."""
        return self._cancelled

    @property
    def over(self) -> bool:
        """Whether an answer would come in vain: cancelled, or after the deadline."""
        return self._cancelled or (self._deadline is not None and self._deadline <= self._clock())

    def limit(self, timeout: float) -> None:
        """Bring the deadline forward to `timeout` seconds after it came in, if it is later."""
        deadline = self._start + timeout
        self._deadline = deadline if self._deadline is None else min(self._deadline, deadline)

    def cancel(self) -> None:
        """Say that nobody waits any more; work on it ends at the next stage."""
        self._cancelled = True

    def check(self) -> None:
        """Pass where the answer is still wanted; called before every stage.

        Raises:
            Cancelled: The caller is gone.
            DeadlineExceeded: The deadline is over.
        """
        if self.cancelled:
            raise Cancelled("The caller cancelled the request.")
        if self.over:
            raise deadline_exceeded()


def deadline_exceeded() -> DeadlineExceeded:
    """The error for an answer that comes too late."""
    return DeadlineExceeded("The deadline passed before there was an answer.")
