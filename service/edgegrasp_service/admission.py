"""The door: how many requests are in the server, how many wait, and who is refused at once."""

import asyncio
import contextlib
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from types import TracebackType
from typing import Any, Self, TypeVar

from edgegrasp_service.call import Call
from edgegrasp_service.errors import Overloaded
from edgegrasp_service.observer import Observer

Result = TypeVar("Result")

SMOOTHING = 0.2  # weight of the latest request in the pace
MARGIN = 1.5  # a wait is told from a mean; half of them are longer


class Admission:
    """Lets so many requests work and so many wait; used in the event loop only.

    A request whose deadline would pass while it waits is refused too: computing nothing for it
    leaves time for those that can be answered.
    """

    def __init__(
        self,
        max_active: int,
        max_waiting: int,
        observer: Observer | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._max_active = max_active
        self._max_places = max_active + max_waiting
        self._observer = observer or Observer()
        self._clock = clock
        self._places = 0
        self._active = 0
        self._turns: deque[asyncio.Future[None]] = deque()
        self._pace: float | None = None  # seconds from answer to answer while there is work
        self._last = 0.0  # when a place was last left, or taken in an empty server
        self._empty = asyncio.Event()
        self._empty.set()

    def check_room(self) -> None:
        """Raise Overloaded unless there is a place for one more."""
        if self._places >= self._max_places:
            raise Overloaded(
                f"The server is full: {self._places} requests are in it. "
                f"Try again in {_whole_seconds(self._wait)} s.",
                _whole_seconds(self._wait),
            )

    @property
    def _wait(self) -> float:
        """Seconds that those who are in take, at the latest pace."""
        return self._places * (self._pace or 0.0)

    def enter(self, call: Call) -> "Place":
        """Take a place, to be used as a context manager.

        Raises:
            Overloaded: There is none, or its turn would come after its deadline.
        """
        self.check_room()
        wait = self._wait
        if call.remaining is not None and self._places and wait * MARGIN > call.remaining:
            raise Overloaded(
                f"The deadline is {call.remaining:.3g} s away, and {self._places} requests come "
                f"first, which take about {wait:.3g} s. Try again in {_whole_seconds(wait)} s.",
                _whole_seconds(wait),
            )
        if not self._places:
            self._last = self._clock()
        self._places += 1
        self._empty.clear()
        self._tell()
        return Place(self, call)

    async def turn(self) -> None:
        """Wait until fewer than `max_active` requests are worked on; first come, first served."""
        if self._active < self._max_active:
            self._active += 1
        else:
            turn = asyncio.get_running_loop().create_future()
            self._turns.append(turn)
            try:
                await turn
            except asyncio.CancelledError:
                if turn in self._turns:
                    self._turns.remove(turn)
                elif not turn.cancelled():  # it was this one's turn just now: the next, please
                    self._pass_on()
                raise
        self._tell()

    def leave(self, worked: bool) -> None:
        """Give a place back; `worked`: it had its turn."""
        self._places -= 1
        if worked:
            now = self._clock()
            took, self._last = now - self._last, now
            before = took if self._pace is None else self._pace
            self._pace = before + SMOOTHING * (took - before)
            self._pass_on()
        if not self._places:
            self._empty.set()
        self._tell()

    async def empty(self) -> None:
        """Return once no request is in the server."""
        await self._empty.wait()

    def _pass_on(self) -> None:
        while self._turns:
            turn = self._turns.popleft()
            if not turn.done():
                turn.set_result(None)  # `active` stays: one leaves, one begins
                return
        self._active -= 1

    def _tell(self) -> None:
        self._observer.places(self._active, self._places - self._active)


class Place:
    """The place of one request; left when its context ends and no thread works on it any more."""

    def __init__(self, admission: Admission, call: Call) -> None:
        self.call = call
        self._admission = admission
        self._had_turn = False
        self._work: Future[Any] | None = None

    async def begin(self, work: Callable[[], Future[Result]]) -> Result:
        """Wait for the turn, then for the work that is begun.

        Where this is cancelled, the work goes on to the end of its stage, and keeps the place.

        Args:
            work: Begins it; what it gives back runs, so that nobody can cancel it.
        """
        await self._admission.turn()
        self._had_turn = True
        self._work = work()
        await _done(self._work)
        return self._work.result()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave, now or when the work ends."""
        if self._work is None or self._work.done():
            self._admission.leave(self._had_turn)
        else:
            loop = asyncio.get_running_loop()
            leave = partial(self._admission.leave, self._had_turn)
            self._work.add_done_callback(lambda work: loop.call_soon_threadsafe(leave))


async def _done(work: Future[Any]) -> None:
    """Wait for work; less than asyncio.wrap_future does, which would also try to cancel it."""
    loop = asyncio.get_running_loop()
    ended: asyncio.Future[None] = loop.create_future()

    def tell() -> None:
        if not ended.done():
            ended.set_result(None)

    def wake(work: Future[Any]) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits
            loop.call_soon_threadsafe(tell)

    work.add_done_callback(wake)
    await ended


def _whole_seconds(wait: float) -> int:
    """As in the header Retry-After: whole, and never none."""
    return max(1, math.ceil(wait))
