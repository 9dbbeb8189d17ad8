"""Admission: how many requests and bytes the server holds, shared fairly between clients."""

import asyncio
import math
import statistics
from collections import Counter, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from edgegrasp_service.errors import DeadlineExceeded, Overloaded, ServiceError

LATEST = 15  # latest service times, whose median is the pace; one slow request does not change it
MARGIN = 1.5  # the wait is estimated from a median, and half of the requests take longer


@dataclass(eq=False)
class Ticket:
    """The slot of one request in the server."""

    client: str
    timeout: asyncio.Timeout  # that ends it
    whole: bool = False  # whether its body has arrived
    at_work: bool = False  # whether a worker has started it
    bytes: int = 0
    left: bool = False
    reason: ServiceError | None = None  # why it was refused

    def refuse(self, reason: ServiceError) -> None:
        """End the request with an error, at any stage."""
        self.reason = reason
        if not self.timeout.expired():
            self.timeout.reschedule(asyncio.get_running_loop().time())


class Admission:
    """Limits the requests and bytes in the server; used in the event loop only.

    A single client may use all slots and half of the bytes. When the server is full, the client
    that holds the most loses a request to a client that would still hold fewer.

    Args:
        workers: Requests worked on at a time.
        max_waiting: Requests in the server beside those.
        max_bytes: Of bodies held; a client holds at most half of them.
    """

    def __init__(self, workers: int, max_waiting: int, max_bytes: int) -> None:
        self.held_bytes = 0
        self._workers = workers
        self._max_tickets = workers + max_waiting
        self._max_bytes = max_bytes
        self._tickets: list[Ticket] = []  # in the order they came
        self._client_bytes: Counter[str] = Counter()
        self._waiting: deque[asyncio.Future[None]] = deque()  # for bytes
        self.took: deque[float] = deque(maxlen=LATEST)  # seconds of the latest jobs of workers
        self._empty = asyncio.Event()
        self._empty.set()

    @property
    def tickets(self) -> int:
        """Requests in the server."""
        return len(self._tickets)

    @asynccontextmanager
    async def admit(self, client: str, deadline: float, size: int) -> AsyncIterator[Ticket]:
        """Hold a place in the server for a client: its token's name, or else its address.

        The body of the context is cancelled at the deadline, on the event loop's clock. Waits until
        there is room for `size`, the most bytes of the body.

        Raises:
            Overloaded: There is no place, or its turn would come after its deadline.
            DeadlineExceeded: The deadline passed inside.
        """
        remaining = deadline - asyncio.get_running_loop().time()
        if remaining <= 0.0:
            raise DeadlineExceeded()
        wait = self._wait
        if self._tickets and wait * MARGIN > remaining:
            raise self._full(
                f"{len(self._tickets)} requests come first, which take about {wait:.3g} s, and "
                f"the deadline is {remaining:.3g} s away"
            )
        if len(self._tickets) >= self._max_tickets:
            counts = Counter(ticket.client for ticket in self._tickets)
            holder, count = counts.most_common(1)[0]
            if count <= counts[client] + 1 or not self._give_up(holder):
                raise self._full(f"it holds {len(self._tickets)} requests")
        ticket = Ticket(client, asyncio.timeout_at(deadline))
        self._tickets.append(ticket)
        self._empty.clear()
        try:
            async with ticket.timeout:
                await self._reserve(ticket, size)
                yield ticket
        except TimeoutError:
            if not ticket.timeout.expired():
                raise
            raise ticket.reason or DeadlineExceeded() from None
        finally:
            self._leave(ticket)

    def _give_up(self, holder: str) -> bool:
        """Refuse the latest request of a client that is not being worked on; false without one."""
        for ticket in reversed(self._tickets):
            if ticket.client == holder and not ticket.at_work:
                held = sum(one.client == holder for one in self._tickets)
                why = f"this client holds {held} of {self._max_tickets} places, and others wait"
                ticket.refuse(self._full(why))
                self._leave(ticket)
                return True
        return False

    def resize(self, ticket: Ticket, size: int) -> None:
        """Set the number of bytes that a request holds."""
        if not ticket.left:
            self.held_bytes += size - ticket.bytes
            self._client_bytes[ticket.client] += size - ticket.bytes
            ticket.bytes = size
            self._wake()

    def hold(self, size: int) -> bool:
        """Reserve bytes outside of requests, or free them (negative); returns whether they fit."""
        if size > 0 and self.held_bytes + size > self._max_bytes:
            return False
        self.held_bytes += size
        if size < 0:
            self._wake()
        return True

    def _wake(self) -> None:
        for waiting in self._waiting:
            if not waiting.done():
                waiting.set_result(None)
        self._waiting.clear()

    def refuse_all(self, reason: ServiceError) -> None:
        """End every request with an error."""
        for ticket in self._tickets:
            ticket.refuse(reason)

    async def empty(self) -> None:
        """Return once no request is in the server."""
        await self._empty.wait()

    @property
    def _wait(self) -> float:
        """Estimated seconds until a worker begins a new request."""
        pace = statistics.median(self.took) if self.took else 0.0
        ahead = sum(ticket.whole for ticket in self._tickets)  # others' bodies may be late
        return max(0, ahead + 1 - self._workers) * pace / self._workers

    def _full(self, why: str) -> Overloaded:
        seconds = max(1, math.ceil(self._wait))  # as the header Retry-After has them
        return Overloaded(f"The server is busy: {why}. Try again in {seconds} s.", seconds)

    async def _reserve(self, ticket: Ticket, size: int) -> None:
        """Wait until the limits of all clients and of this client leave room for so many bytes."""
        while (self.held_bytes and self.held_bytes + size > self._max_bytes) or (
            self._client_bytes[ticket.client]
            and self._client_bytes[ticket.client] + size > self._max_bytes // 2
        ):
            holder, most = max(self._client_bytes.items(), key=lambda row: row[1], default=("", 0))
            several = sum(held.client == holder and held.bytes > 0 for held in self._tickets) > 1
            greedy = several and most > self._client_bytes[ticket.client] + size
            if not (greedy and self._give_up(holder)):
                waiting = asyncio.get_running_loop().create_future()
                self._waiting.append(waiting)
                await waiting
        self.resize(ticket, size)

    def _leave(self, ticket: Ticket) -> None:
        if ticket.left:
            return
        self.resize(ticket, 0)
        ticket.left = True
        self._tickets.remove(ticket)
        if not self._client_bytes[ticket.client]:
            del self._client_bytes[ticket.client]
        if not self._tickets:
            self._empty.set()
