"""What the server tells of its work, to whoever counts, logs or traces it."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from edgegrasp_model.results import Detection, Scoring
from edgegrasp_service.call import Call
from edgegrasp_service.errors import Cancelled, ErrorReport, report


class Observer:
    """Told of everything that happens; this one ignores it. Override what is of interest.

    Methods come from any thread, `started` first and `finished` last for each call, and must
    return at once and raise nothing.
    """

    def started(self, call: Call) -> None:
        """A request came in."""

    def stage(self, call: Call, name: str, seconds: float) -> None:
        """A stage of a request ended, now, after so many seconds.

        Args:
            call: The request.
            name: One of STAGES.
            seconds: How long it took.
        """

    def places(self, active: int, waiting: int) -> None:
        """The number of requests that are worked on, or that wait for it, changed."""

    def batched(self, requests: int, balls: int, points: int) -> None:
        """One forward pass begins: requests that share it, their balls, the balls' points."""

    def answered(self, call: Call, answer: Detection | Scoring) -> None:
        """There is an answer; `counts`, `seconds` and `model` of it are of interest."""

    def worker_replaced(self, reason: str) -> None:
        """The network's thread died or ran out of memory, and there is a new one."""

    def finished(self, call: Call, problem: ErrorReport | None) -> None:
        """A request ended: with an answer, or with a problem; `call.seconds` is its duration."""


# In order. Scoring has decode, wait and score.
STAGES = ("admission", "decode", "prepare", "wait", "network", "finish", "score")


@contextmanager
def observed(observer: Observer, call: Call) -> Iterator[None]:
    """Tell of a call's start, and of its end however it comes, once its answer is on its way."""
    observer.started(call)
    problem = None
    try:
        yield
    except Exception as error:
        problem = report(error)
        raise
    except BaseException:
        problem = report(Cancelled("The caller cancelled the request."))
        raise
    finally:
        asyncio.get_running_loop().call_soon(observer.finished, call, problem)
