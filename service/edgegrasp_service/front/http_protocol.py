"""HTTP/1.1 as uvicorn speaks it with httptools, with the bounds that uvicorn leaves open."""

import asyncio
from collections.abc import Callable
from typing import Any

import orjson
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from edgegrasp_model.errors import EdgeGraspError, InvalidRequest
from edgegrasp_service.errors import HeadersTooLarge, Overloaded, Problem, RequestTimeout, report
from edgegrasp_service.front.admission import Place, Places
from edgegrasp_service.observability import network_of
from edgegrasp_service.settings import Settings

LINGER_SECONDS = 5.0  # for a client to take what is not sent yet, though it may still send
MANY_PIECES, SMALL_PIECE = 1024, 16  # so many chunks of so few bytes are no body of a cloud


class HttpProtocol(HttpToolsProtocol):
    """Ends connections whose headers do not come or whose answers nobody takes; closes gently."""

    def __init__(self, settings: Settings, places: Places, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._settings = settings
        self._places = places
        self._write_timer: asyncio.TimerHandle | None = None
        self._header_timer: asyncio.TimerHandle | None = None
        self._header_bytes = 0
        self._in_headers = self._receiving = True
        self._pieces = self._body_bytes = 0
        self._refusal: EdgeGraspError | None = None  # why the parser is ended
        self._place = Place("", lambda: None)

    def connection_made(self, transport: Any) -> None:
        """Wait for the first header."""
        super().connection_made(transport)
        self.transport = _GentleTransport(  # type: ignore[assignment]
            transport, lambda: self._receiving
        )
        self._await_headers()
        try:
            owner = network_of(self.client[0] if self.client else "")
            self._place = self._places.take(owner, transport.abort)
        except Overloaded as error:
            self._refuse(error)

    def data_received(self, data: bytes) -> None:
        """Take a part of a request; nothing of one that was refused."""
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
        """A request begins."""
        super().on_message_begin()
        self.scope["state"]["abort"] = self.transport.abort
        self._receiving = True
        self._pieces = self._body_bytes = 0
        self._await_headers()

    def on_headers_complete(self) -> None:
        """Its headers are there."""
        self._in_headers = False
        self._stop_timer()
        # How many of these there are is bounded elsewhere, and somebody waits for each.
        try:
            self._places.use(self._place, idle=not self.url.startswith(b"/v1/"))
        except Overloaded as error:
            self._refusal = error
            raise  # ends the parser too
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """It is answered."""
        self._places.use(self._place)
        super().on_response_complete()

    def pause_writing(self) -> None:
        """The client takes its answer more slowly than it is made: for some time only."""
        super().pause_writing()
        seconds = self._settings.write_seconds
        seconds += self.transport.get_write_buffer_size() / self._settings.min_bytes_per_second
        self._write_timer = self.loop.call_later(seconds, self.transport.abort)

    def resume_writing(self) -> None:
        """It has taken most of it."""
        if self._write_timer is not None:
            self._write_timer.cancel()
        super().resume_writing()

    def on_body(self, body: bytes) -> None:
        """A piece of its body."""
        self._pieces += 1
        self._body_bytes += len(body)
        if self._pieces > MANY_PIECES and self._body_bytes < self._pieces * SMALL_PIECE:
            value = f"{self._body_bytes} bytes in {self._pieces} pieces"
            self._refusal = InvalidRequest("body", value, "Send larger pieces.")
            raise self._refusal  # ends the parser too
        super().on_body(body)

    def on_message_complete(self) -> None:
        """It is all there."""
        self._receiving = False
        super().on_message_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """The end."""
        self._stop_timer()
        self.resume_writing()
        self._places.leave(self._place)
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Say why what came is no request."""
        fix = "Send an HTTP/1.1 request."
        self._refuse(self._refusal or InvalidRequest("request", "malformed HTTP", fix))

    def _refuse(self, error: EdgeGraspError) -> None:
        """Answer past the application, and close."""
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
            self.cycle.disconnected = True  # the application answers nothing any more
            self.cycle.message_event.set()
        self.transport.write(head.encode() + body)
        self.transport.close()

    def _await_headers(self) -> None:
        self._in_headers = True
        if self._header_timer is None:
            seconds = self._settings.read_seconds
            self._header_timer = self.loop.call_later(seconds, self._headers_late)

    def _headers_late(self) -> None:
        if not self.transport.is_closing():
            value = f"not whole in {self._settings.read_seconds:g} s"
            self._refuse(RequestTimeout("headers", value, "Send them at once."))

    def _stop_timer(self) -> None:
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None


class _GentleTransport:
    """A transport whose `close` lets the client read its answer, but not hold the connection.

    A socket that is closed while bytes arrive is reset, and an answer on its way may be lost.
    """

    def __init__(self, transport: asyncio.Transport, receiving: Callable[[], bool]) -> None:
        self._transport = transport
        self._receiving = receiving
        self._closing = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def is_closing(self) -> bool:
        """Whether it is closed, or soon will be."""
        return self._closing or self._transport.is_closing()

    def write(self, data: bytes) -> None:
        """Send, unless nothing more can be."""
        if not self._closing:
            self._transport.write(data)

    def close(self) -> None:
        """Send what is written, drop what comes in, and close."""
        if self.is_closing():
            return
        self._closing = True
        if self._receiving() and self._transport.can_write_eof():
            self._transport.write_eof()
            self._transport.resume_reading()
        else:
            self._transport.close()
        asyncio.get_running_loop().call_later(LINGER_SECONDS, self._transport.abort)


def problem_document(problem: Problem) -> bytes:
    """An error as a problem document (RFC 9457)."""
    title = problem.kind.replace("-", " ").capitalize()
    document = {"type": f"urn:edgegrasp:error:{problem.kind}", "title": title} | vars(problem)
    del document["kind"], document["code"]
    return orjson.dumps(document)
