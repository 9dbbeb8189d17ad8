"""Limits on connections: their number, idle time and least speed.

This module holds the defences against slow and silent clients. `Places` limits the number of
connections, streams, pages and reads; `HttpProtocol` adds to uvicorn the limits that it lacks;
`grpc_bounds` and `trim_grpc` do the same for gRPC.
"""

import asyncio
import contextlib
import os
import socket
import struct
import time
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Sized
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from edgegrasp_model.errors import EdgeGraspError, InvalidRequest
from edgegrasp_service.errors import (
    HeadersTooLarge,
    Overloaded,
    RequestTimeout,
    problem_document,
    report,
)
from edgegrasp_service.observability import network_of
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.process import PIECE

# Connections of HTTP
LINGER_SECONDS = 5.0  # seconds for a refused client to read its answer
MANY_PIECES, SMALL_PIECE = 1024, 16  # more chunks than this, smaller than this, are refused
MAX_HEADERS = 64  # or entries of gRPC's metadata

# Connections of gRPC
CALLS = 100  # calls of one connection at a time; further ones wait in the client
LOOKAHEAD_BYTES = 2**20  # buffered bytes of a message that is not being read yet; 87,000 points
SPARE_BYTES = 2**20  # an excess up to this is refused with field, value and fix
SPARE_CONNECTIONS = 4  # times max_connections are accepted before the oldest are closed
TRIM_SECONDS = 0.05  # seconds between two checks for too many connections
DESCRIPTORS = Path("/proc/self/fd")
LAST_RECEIVED = struct.Struct("52xI")  # of struct tcp_info: tcpi_last_data_recv, milliseconds


@dataclass(eq=False)
class Place:
    """A slot of `Places`."""

    owner: str
    on_eviction: Callable[[], None]
    idle: bool = True  # can be evicted
    used: float = field(default_factory=time.monotonic)


class Places:
    """A limited number of connections, streams, pages or reads.

    When all places are taken, a newcomer evicts an idle one: the longest idle of the client that
    has most idle places. A place used within the last `grace` seconds is evicted only for a client
    that then still has fewer. `spare` places cannot be busy, so that one is always left.
    """

    def __init__(self, most: int, grace: float = 0.0, spare: int = 0) -> None:
        self._most, self._grace, self._spare = most + spare, grace, spare
        self.taken: dict[Place, None] = {}  # the latest used at the end

    def take(self, owner: str, on_eviction: Callable[[], None]) -> Place:
        """Take a place until `release`, or until it is evicted. Raises Overloaded."""
        if len(self.taken) >= self._most:
            since = time.monotonic() - self._grace
            counts = Counter(one.owner for one in self.taken)
            mine = counts[owner] + 1
            idle = [
                place
                for place in self.taken
                if place.idle and (place.used <= since or counts[place.owner] > mine)
            ]
            if not idle:
                raise Overloaded(f"All {self._most} places are in use. Try again in 1 s.")
            greedy = Counter(place.owner for place in idle).most_common(1)[0][0]
            evicted = next(place for place in idle if place.owner == greedy)
            self.release(evicted)
            evicted.on_eviction()
        place = Place(owner, on_eviction)
        self.taken[place] = None
        return place

    def use(self, place: Place, idle: bool = True) -> None:
        """Mark a place as used now, and as idle or busy. Raises Overloaded."""
        if place.idle and not idle and self._spare:
            busy = sum(not other.idle for other in self.taken)
            if busy >= self._most - self._spare:
                raise Overloaded(f"{busy} connections have requests. Try again in 1 s.")
        place.idle, place.used = idle, time.monotonic()
        if place in self.taken:
            self.taken[place] = self.taken.pop(place)

    def release(self, place: Place) -> None:
        """Return a place."""
        self.taken.pop(place, None)

    @asynccontextmanager
    async def hold(self, owner: str) -> AsyncIterator[Place]:
        """Hold a place; the body of the context is cancelled on eviction.

        Raises:
            Overloaded: There is no place, or it was evicted.
        """
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(None) as eviction:
                place = self.take(owner, lambda: eviction.reschedule(loop.time()))
                try:
                    yield place
                finally:
                    self.release(place)
        except TimeoutError:
            if not eviction.expired():
                raise
            raise Overloaded("Another client got this place. Try again in 1 s.") from None


# HTTP


class HttpProtocol(HttpToolsProtocol):
    """Closes connections whose headers or readers are too slow; refused clients can read why."""

    def __init__(self, settings: Settings, places: Places, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._settings = settings
        self._places = places
        self._write_timer: asyncio.TimerHandle | None = None
        self._header_timer: asyncio.TimerHandle | None = None
        self._header_bytes = 0
        self._refusal: EdgeGraspError | None = None  # why the parser is ended
        self._place = Place("", lambda: None)

    def connection_made(self, transport: Any) -> None:
        """Take a place, and wait for the first headers."""
        super().connection_made(transport)
        transport.max_size = PIECE  # read in one turn of the event loop
        self.transport = _LingeringTransport(  # type: ignore[assignment]
            transport, lambda: self._in_headers or self.cycle is None or self.cycle.more_body
        )
        self._await_headers()
        try:
            owner = network_of(self.client[0] if self.client else "")
            self._place = self._places.take(owner, transport.abort)
        except Overloaded as error:
            self._refuse(error)

    def data_received(self, data: bytes) -> None:
        """Parse received bytes, unless the connection is closing."""
        if self.transport.is_closing():
            return
        self._header_bytes += len(data)
        self._places.use(self._place, self._place.idle)
        super().data_received(data)
        if not self._in_headers:
            self._header_bytes = 0
        elif self._header_bytes > self._settings.max_header_bytes:
            most = f"Send at most {self._settings.max_header_bytes}."
            self._refuse(HeadersTooLarge("headers", f"{self._header_bytes} bytes", most))

    def on_message_begin(self) -> None:
        """Prepare for a new request."""
        super().on_message_begin()
        self.scope["state"]["abort"] = self.transport.abort
        self._pieces = self._body_bytes = 0
        self._await_headers()

    def on_headers_complete(self) -> None:
        """Mark the connection as busy for requests to /v1/."""
        try:
            self._places.use(self._place, idle=not self.url.startswith(b"/v1/"))
        except Overloaded as error:
            self._refusal = error
            raise  # ends the parser too
        self._in_headers = False
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Refuse bodies in very small chunks."""
        self._pieces += 1
        self._body_bytes += len(body)
        if self._pieces > MANY_PIECES and self._body_bytes < self._pieces * SMALL_PIECE:
            value = f"{self._body_bytes} bytes in {self._pieces} pieces"
            self._refusal = InvalidRequest("body", value, "Send larger pieces.")
            raise self._refusal  # ends the parser too
        super().on_body(body)

    def on_response_complete(self) -> None:
        """Mark the connection as idle."""
        self._places.use(self._place)
        super().on_response_complete()

    def pause_writing(self) -> None:
        """Close the connection unless the client reads its answer in time."""
        super().pause_writing()
        seconds = self._settings.write_seconds
        seconds += self.transport.get_write_buffer_size() / self._settings.min_bytes_per_second
        self._write_timer = self.loop.call_later(seconds, self.transport.abort)

    def resume_writing(self) -> None:
        """Cancel the timer of `pause_writing`."""
        if self._write_timer is not None:
            self._write_timer.cancel()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop timers and return the place."""
        if self._header_timer is not None:
            self._header_timer.cancel()
        self.resume_writing()
        self._places.release(self._place)
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Answer a malformed request."""
        fix = "Send an HTTP/1.1 request."
        self._refuse(self._refusal or InvalidRequest("request", "malformed HTTP", fix))

    def _refuse(self, error: EdgeGraspError) -> None:
        """Send an error without the application, and close; no more if it is closing."""
        if self.transport.is_closing():
            return
        pending = self.cycle is not None and not self.cycle.response_complete
        if pending and self.cycle.response_started:
            self.transport.abort()  # it has half an answer
            return
        problem = report(error)
        body = problem_document(problem)
        head = (
            f"HTTP/1.1 {problem.status} {problem.kind}\r\n"
            "content-type: application/problem+json\r\n"
            f"content-length: {len(body)}\r\nconnection: close\r\n\r\n"
        )
        if pending:
            self.cycle.disconnected = True  # the application can send nothing more
            self.cycle.message_event.set()
        self.transport.write(head.encode() + body)
        self.transport.close()

    def _await_headers(self) -> None:
        self._in_headers = True
        if self._header_timer is None:
            seconds = self._settings.read_seconds
            late = "headers", f"not whole in {seconds:g} s", "Send them at once."
            self._header_timer = self.loop.call_later(
                seconds, lambda: self._refuse(RequestTimeout(*late))
            )


@dataclass
class _LingeringTransport:
    """A transport whose `close` leaves the client a few seconds to read its answer.

    A socket that is closed while bytes arrive is reset, and the answer may be lost.
    """

    transport: asyncio.Transport
    receiving: Callable[[], bool]  # whether more of a request is to come
    closing: bool = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.transport, name)

    def is_closing(self) -> bool:
        """Whether it is closed or closing."""
        return self.closing or self.transport.is_closing()

    def write(self, data: bytes) -> None:
        """Send, unless it is closing."""
        if not self.closing:
            self.transport.write(data)

    def close(self) -> None:
        """Send what is buffered, discard what is received, and close."""
        if self.is_closing():
            return
        self.closing = True
        if self.receiving() and self.transport.can_write_eof():
            self.transport.write_eof()
            self.transport.resume_reading()
        else:
            self.transport.close()
        asyncio.get_running_loop().call_later(LINGER_SECONDS, self.transport.abort)


# gRPC


def grpc_bounds(settings: Settings) -> list[tuple[str, int]]:
    """Options of a gRPC server."""
    return [
        ("grpc.max_receive_message_length", settings.max_body_bytes + SPARE_BYTES),
        ("grpc.max_metadata_size", settings.max_header_bytes),
        ("grpc.absolute_max_metadata_size", settings.max_header_bytes),
        # Compressed messages are unpacked before their size is known: none are accepted.
        ("grpc.compression_enabled_algorithms_bitset", 1),
        ("grpc.so_reuseport", 0),
        # One call is accepted per turn of the event loop: few may wait before a health check.
        ("grpc.max_concurrent_streams", CALLS),
        ("grpc.max_allowed_incoming_connections", SPARE_CONNECTIONS * settings.max_connections),
        ("grpc.server_handshake_timeout_ms", int(settings.read_seconds * 1000)),
        ("grpc.max_connection_idle_ms", 300_000),
        # A cloud arrives without waiting for window updates.
        ("grpc.http2.lookahead_bytes", LOOKAHEAD_BYTES),
        ("grpc.http2.bdp_probe", 0),  # would buffer whole messages that nobody reads yet
        # Clients that vanished are noticed, and their streams end.
        ("grpc.keepalive_time_ms", 30_000),
        ("grpc.keepalive_timeout_ms", 10_000),
        # Clients resolve the name again from time to time, and find new servers.
        ("grpc.max_connection_age_ms", 300_000),
        ("grpc.http2.min_recv_ping_interval_without_data_ms", 20_000),
    ]


async def trim_grpc(port: int, most: int, others: Sized) -> None:
    """Keep closing surplus connections to gRPC's port, which gRPC cannot limit by client.

    Args:
        port: Of gRPC.
        most: Connections that may stay.
        others: Connections to other ports, whose descriptors do not count.
    """
    while True:
        await asyncio.sleep(TRIM_SECONDS)
        if len([*DESCRIPTORS.iterdir()]) - len(others) > most:
            with contextlib.ExitStack() as duplicates:
                _trim(port, most, duplicates)


def _trim(port: int, most: int, duplicates: contextlib.ExitStack) -> None:
    """Shut down the longest silent connections to a port of the clients that have most."""
    found: defaultdict[str, list[tuple[int, socket.socket]]] = defaultdict(list)
    for link in DESCRIPTORS.iterdir():
        with contextlib.suppress(OSError):
            if not link.is_socket():
                continue
            one = duplicates.enter_context(socket.socket(fileno=os.dup(int(link.name))))
            if one.family != socket.AF_UNIX and one.getsockname()[1] == port:
                owner = network_of(one.getpeername()[0])  # an OSError for the one that listens
                info = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, LAST_RECEIVED.size)
                found[owner].append((*LAST_RECEIVED.unpack(info), one))
    for rows in found.values():
        rows.sort(key=lambda row: row[0])
    for _ in range(sum(map(len, found.values())) - most):
        _, longest = max(found.values(), key=len).pop()
        with contextlib.suppress(OSError):
            longest.shutdown(socket.SHUT_RDWR)
