"""The HTTP transport: the middleware around every request, routes, and limits on connections."""

import asyncio
import json
import logging
import math
import re
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

from fastapi.encoders import jsonable_encoder
from fastapi.openapi.docs import get_swagger_ui_html
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route, Router
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, brief
from edgegrasp_model.gripper import gripper_names, load_gripper
from edgegrasp_service import errors
from edgegrasp_service.front.service import MAX_HEADERS, EvictingLimiter, GraspService, Permit
from edgegrasp_service.observability import REQUEST_ID_HEADER, Call, Metrics, network_of
from edgegrasp_service.worker.process import PIECE_BYTES, Job, Method

logger = logging.getLogger(__name__)

# Connections
LINGER_SECONDS = 5.0  # seconds for a refused client to read its answer
MANY_PIECES, SMALL_PIECE = 1024, 16  # more chunks than this, if smaller on average, are refused

# Pages
MAX_PAGES_AT_ONCE = 16  # pages sent at a time
PAGE_GRACE_SECONDS = 10.0  # seconds after which a page yields its place to another one

ASSETS = "/docs/assets"  # of fastapi_offline
PLAYGROUND = "/playground/"
PLAYGROUND_FILES = Path(__file__).parents[1] / "playground"
UPGRADE = re.compile(rb"\r\nupgrade:", re.IGNORECASE)  # as Java's HttpClient sends
CONTENT_POLICY = (  # what a page may load, and which sites may embed it
    "default-src 'none'; script-src 'self'{0}; style-src 'self'{0}; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# The page that documents the interface has an inline script; it loads nothing from elsewhere.
POLICIES = {"/docs": CONTENT_POLICY.format(" 'unsafe-inline'")}
POLICY = CONTENT_POLICY.format("")
CHALLENGE = 'Bearer realm="edgegrasp"'
TIMEOUT_HEADER = "X-Request-Timeout"
TIMEOUT_NUMBER = re.compile(r"\d{1,9}(\.\d*)?|\.\d+|\d{1,9}(\.\d*)?[eE][+-]?\d{1,2}", re.ASCII)

WORK: dict[str, Method] = {  # answered by workers
    "/v1/grasps": "DetectGrasps",
    "/v1/grasps:score": "ScoreGrasps",
    "/v1/outcomes": "RecordOutcome",
}
# Values of the label `method`: the gRPC method's name where there is one.
METHODS = {
    **WORK,
    "/v1/models": "ListModels",
    "/v1/models:reload": "ReloadModels",
    "/v1/robots": "ListRobots",
    "/health/live": "Live",
    "/health/ready": "Ready",
    "/metrics": "Metrics",
    "/": "Docs",
    PLAYGROUND.rstrip("/"): "Docs",
    "/docs": "Docs",
    "/openapi.json": "Docs",
}
# Without a token: probes need none, and the pages hold no secrets.
PUBLIC_METHODS = ("Live", "Ready", "Docs")

# The contract, written by hand as grasp.proto is.
OPENAPI_DOCUMENT = json.loads(Path(grasp_pb2.__file__).with_name("openapi.json").read_text("utf-8"))


class HttpMiddleware:
    """ASGI middleware around the routes: request ids, tokens, header limits, errors."""

    def __init__(self, app: ASGIApp, service: GraspService) -> None:
        self._app = app
        self._service = service
        self._pages = EvictingLimiter(MAX_PAGES_AT_ONCE, PAGE_GRACE_SECONDS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        headers, path = Headers(scope=scope), scope["path"]
        page = path.startswith((f"{ASSETS}/", PLAYGROUND))
        method = METHODS.get(path, "Docs" if page else "other")
        peer = scope["client"][0] if scope["client"] else ""
        has_body = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
        call = Call("http", method, headers.get(REQUEST_ID_HEADER, ""), peer)
        with self._service.observe(call):

            async def send_with_headers(message: Message) -> None:
                body = message.get("body", b"")
                if message["type"] == "http.response.start":
                    call.code = str(message["status"])
                    extra = [
                        (REQUEST_ID_HEADER.encode(), call.request_id.encode()),
                        (b"content-security-policy", POLICIES.get(path, POLICY).encode()),
                        (b"x-content-type-options", b"nosniff"),
                    ]
                    # If the answer comes before the end of the body, do not wait for the rest.
                    if arriving := has_body and "read" not in call.stages:
                        scope["state"]["linger"]()
                    if arriving or self._service.stopping.is_set():
                        extra.append((b"connection", b"close"))
                    message = {**message, "headers": [*message.get("headers", []), *extra]}
                async with self._service.sending(len(body)):
                    # In pieces: each is sent once the client has taken most of those before.
                    for place in range(0, len(body), PIECE_BYTES):
                        piece = body[place : place + PIECE_BYTES]
                        await send({**message, "body": piece, "more_body": True})
                    await send({**message, "body": b""} if body else message)

            # With an app in the scope, the router raises HTTPException for an unknown path.
            scope = {**scope, "app": self, "call": call}
            try:
                self._check(scope, call, headers)
                async with self._pages.hold(call.client) if method == "Docs" else nullcontext():
                    await self._app(scope, receive, send_with_headers)
            except Exception as error:
                if not isinstance(error, EdgeGraspError | HTTPException):
                    logger.exception("%s failed", method)
                if call.code:  # the answer has begun: the client must see that it is incomplete
                    call.problem, call.code = errors.to_problem(error), ""
                    scope["state"]["abort"]()
                    await _disconnected(receive, call)
                else:
                    await _error_response(call, scope, error)(scope, receive, send_with_headers)

    def _check(self, scope: Scope, call: Call, headers: Headers) -> None:
        """Refuse headers that are too large, a foreign host, a wrong token, a compressed body."""
        size = sum(len(name) + len(value) for name, value in scope["headers"])
        size += len(scope["raw_path"]) + len(scope["query_string"])
        settings, count = self._service.settings, len(scope["headers"])
        most = settings.max_header_bytes
        if count > MAX_HEADERS or size > most:
            fix = f"Send at most {MAX_HEADERS}, of {most} bytes."
            raise errors.HeadersTooLarge("headers", f"{count} entries of {size} bytes", fix)
        # Prevent DNS rebinding: refuse names that a web page could have pointed at this server.
        # Nobody can register a name without a dot, or one that ends in a number.
        host = headers.get("host", "")
        name = re.sub(r":\d*$", "", host).strip("[]").lower()
        allowed = [one.lower() for one in settings.allowed_hosts]
        unregistered = "." not in name or name.rpartition(".")[2].isdecimal()
        served = name in (*allowed, settings.host.lower()) or "*" in allowed
        served |= not allowed and (self._service.tokens.required or unregistered)
        if not served and call.method not in ("Live", "Ready"):
            fix = "Use an address of the server, or name it in the setting allowed_hosts."
            raise InvalidRequest("Host", brief(host), fix)
        if call.method not in PUBLIC_METHODS:
            self._service.authorize(call, headers.get("authorization"))
        if (encoding := headers.get("content-encoding", "identity").lower()) != "identity":
            fix = "Send the body as it is; .npz and .pcd files may be compressed inside."
            raise errors.UnsupportedMediaType("Content-Encoding", repr(encoding[:40]), fix)


def create_router(service: GraspService, metrics: Metrics) -> Router:
    """The routes, in plain Starlette: workers parse the bodies, and openapi.json exists already."""
    settings = service.settings

    async def listed(name: str, request: Request) -> Response:
        return JSONResponse({name: getattr(service.require_pool(), name)})

    async def reload(request: Request) -> Response:
        return JSONResponse({"models": await service.reload(request.scope["call"])})

    async def ready(request: Request) -> Response:
        status = "ready" if service.ready else "not ready"
        return JSONResponse({"status": status}, status_code=200 if service.ready else 503)

    async def read_metrics(request: Request) -> Response:
        return Response(metrics.page(), media_type="text/plain; version=0.0.4")

    page = get_swagger_ui_html(
        openapi_url="/openapi.json",
        title="EdgeGrasp",
        swagger_js_url=f"{ASSETS}/swagger-ui-bundle.js",
        swagger_css_url=f"{ASSETS}/swagger-ui.css",
        swagger_favicon_url=f"{ASSETS}/favicon.png",
    )
    index = RedirectResponse(PLAYGROUND if settings.playground else "/docs")
    routes: list[BaseRoute] = [
        *(Route(path, _WorkerRoute(service, WORK[path]), methods=["POST"]) for path in WORK),
        Route("/v1/models", partial(listed, "models")),
        Route("/v1/robots", partial(listed, "robots")),
        Route("/v1/models:reload", reload, methods=["POST"]),
        Route("/health/live", JSONResponse({"status": "live"}), methods=["GET"]),
        Route("/health/ready", ready),
        Route("/metrics", read_metrics),
        Route("/openapi.json", JSONResponse(OPENAPI_DOCUMENT), methods=["GET"]),
        Route("/docs", page, methods=["GET"]),
        Route("/", index, methods=["GET"]),
        Mount(ASSETS, StaticFiles(packages=[("fastapi_offline", "static")])),
    ]
    if settings.playground:
        found = {name: load_gripper(name) for name in gripper_names()}
        found |= {file.stem: load_gripper(file) for file in settings.grippers}
        grippers = JSONResponse(jsonable_encoder(found))
        routes += [
            Route(PLAYGROUND.rstrip("/"), index, methods=["GET"]),
            Route(f"{PLAYGROUND}grippers.json", grippers, methods=["GET"]),
        ]
        if (folder := settings.samples) is not None:
            if not folder.is_dir():
                why = f"samples: got {str(folder)!r}, which is not a folder."
                raise errors.InvalidSettings(why)
            routes.append(Mount(f"{PLAYGROUND}samples", StaticFiles(directory=folder)))
        routes.append(Mount(PLAYGROUND, StaticFiles(directory=PLAYGROUND_FILES, html=True)))
    return Router(routes, redirect_slashes=False)


@dataclass
class _WorkerRoute:
    """A route to the workers: reads a body once there is room, and sends their answer."""

    service: GraspService
    method: Method

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; raises the errors of `GraspService`."""
        service, call, headers = self.service, scope["call"], Headers(scope=scope)
        size = int(headers.get("content-length", service.settings.max_body_bytes))
        async with service.admit(call, size, requested_timeout(headers)):
            body, more = bytearray(), True
            start = asyncio.get_running_loop().time()
            while more:
                message = await service.receive(receive(), len(body), start)
                if message["type"] == "http.disconnect":
                    raise errors.Cancelled("The client left before its request was complete.")
                body += message.get("body", b"")
                service.check_size(len(body))
                more = message.get("more_body", False)
            content_type = headers.get("content-type", "")
            query = scope["query_string"].decode("latin-1")
            job = Job(self.method, "http", cast(bytes, body), 0.0, content_type, query)  # no copy
            leaving = asyncio.create_task(_disconnected(receive, call))
            try:
                answer = await service.answer(call, job)
            finally:
                leaving.cancel()
            response = Response(answer.body, media_type="application/json")
            if answer.error is not None:
                response = _problem_response(call, answer.error)
            await response(scope, receive, send)


async def _disconnected(receive: Receive, call: Call) -> None:
    """Wait until the client has disconnected, then end its request."""
    while (await receive())["type"] != "http.disconnect":
        pass
    call.refuse(errors.Cancelled("The client left."))


def requested_timeout(headers: Headers) -> float:
    """The timeout in the header, seconds; infinity without one."""
    text = headers.get(TIMEOUT_HEADER)
    if text is None:
        return math.inf
    timeout = float(text) if TIMEOUT_NUMBER.fullmatch(text) else math.nan
    if not 0.0 < timeout < math.inf:
        raise InvalidRequest(TIMEOUT_HEADER, brief(text), "Send seconds, such as 2.5, or none.")
    return timeout


def _problem_response(call: Call, problem: errors.Problem) -> Response:
    call.problem = problem
    headers = {}
    if problem.retry_after is not None:
        headers["retry-after"] = str(math.ceil(problem.retry_after))
    if problem.status == 401:
        headers["www-authenticate"] = CHALLENGE
    document = errors.problem_document(problem)
    return Response(document, problem.status, headers, "application/problem+json")


def _error_response(call: Call, scope: Scope, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        return _problem_response(call, errors.to_problem(error))
    # Raised by the router: no such path, or no such method.
    detail = f"{scope['method']} {scope['path']}: {error.detail}. See /docs."
    problem = errors.Problem("http", detail, "", "", "", "", error.status_code)
    response = _problem_response(call, problem)
    response.headers.update(error.headers or {})
    return response


# Connections


class HttpProtocol(HttpToolsProtocol):
    """Closes connections whose headers arrive too slowly; refused clients can still read why."""

    def __init__(self, service: GraspService, limiter: EvictingLimiter, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._service, self._settings = service, service.settings
        self._limiter = limiter
        self._header_timer: asyncio.TimerHandle | None = None  # while headers arrive
        self._header_bytes = 0
        self._permit = Permit("", lambda: None)

    def connection_made(self, transport: Any) -> None:
        """Take a permit, and wait for the first headers."""
        super().connection_made(transport)
        transport.max_size = PIECE_BYTES  # read in one turn of the event loop
        self.on_message_begin()  # starts the timer for the first headers
        try:
            owner = network_of(self.client[0] if self.client else "")
            self._permit = self._limiter.acquire(owner, transport.abort)
        except errors.Overloaded as error:
            self._refuse(error)

    def data_received(self, data: bytes) -> None:
        """Parse received bytes, unless the connection is closing."""
        if self.transport.is_closing():
            return
        self._header_bytes += len(data)
        self._limiter.use(self._permit, self._permit.idle)
        if self._header_timer is not None:  # httptools would read no body after this header
            head, end, rest = data.partition(b"\r\n\r\n")
            data = UPGRADE.sub(b"\r\nignored:", head) + end + rest
        super().data_received(data)
        if self._header_bytes > self._settings.max_header_bytes:  # trailers of a body too
            most = f"Send at most {self._settings.max_header_bytes}."
            self._refuse(errors.HeadersTooLarge("headers", f"{self._header_bytes} bytes", most))

    def on_message_begin(self) -> None:
        """Prepare for a new request, whose headers must arrive in time."""
        super().on_message_begin()
        self.scope["state"] |= {"abort": self.transport.abort, "linger": self._linger}
        self._pieces = self._body_bytes = 0
        if self._header_timer is None:
            seconds = self._settings.read_seconds
            late = "headers", f"not complete after {seconds:g} s", "Send them at once."
            self._header_timer = self.loop.call_later(
                seconds, lambda: self._refuse(errors.RequestTimeout(*late))
            )

    def on_headers_complete(self) -> None:
        """Mark the connection as busy for requests to /v1/."""
        self._header_bytes = 0
        self._limiter.use(self._permit, idle=not self.url.startswith(b"/v1/"))
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Refuse bodies in very small chunks."""
        self._header_bytes = 0
        self._pieces += 1
        self._body_bytes += len(body)
        if self._pieces > MANY_PIECES and self._body_bytes < self._pieces * SMALL_PIECE:
            value = f"{self._body_bytes} bytes in {self._pieces} pieces"
            raise InvalidRequest("body", value, "Send larger pieces.")
        super().on_body(body)

    def on_response_complete(self) -> None:
        """Mark the connection as idle."""
        self._limiter.use(self._permit)
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer and return the permit."""
        if self._header_timer is not None:
            self._header_timer.cancel()
        self._limiter.release(self._permit)
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Answer a malformed request, or one for which a callback of the parser raised an error."""
        raised = getattr(sys.exception(), "__context__", None)  # where httptools keeps it
        if not isinstance(raised, EdgeGraspError):
            raised = InvalidRequest("request", "malformed HTTP", "Send an HTTP/1.1 request.")
        self._refuse(raised)

    def _refuse(self, error: EdgeGraspError) -> None:
        """Send an error, bypassing the application, and close; does nothing if already closing."""
        if self.transport.is_closing():
            return
        pending = self.cycle is not None and not self.cycle.response_complete
        if pending and self.cycle.response_started:
            self.transport.abort()  # the client already has part of an answer
            return
        problem = errors.to_problem(error)
        body = errors.problem_document(problem)
        head = (
            f"HTTP/1.1 {problem.status} {problem.kind}\r\n"
            "content-type: application/problem+json\r\n"
            f"content-length: {len(body)}\r\nconnection: close\r\n"
        )
        if pending:  # the application counts this call
            self.cycle.disconnected = True  # it can send nothing more
            self.cycle.message_event.set()
        else:
            call = Call("http", "other", "", self.client[0] if self.client else "")
            with self._service.observe(call):
                call.problem, call.code = problem, str(problem.status)
            head += f"{REQUEST_ID_HEADER}: {call.request_id}\r\n"
        self.transport.write(f"{head}\r\n".encode() + body)
        self._linger()
        self.transport.close()

    def _linger(self) -> None:
        """Give the client time to read its answer while the rest of its request still arrives."""
        self.transport = _LingeringTransport(self.transport)  # type: ignore[assignment]
        if self.cycle is not None:
            self.cycle.transport = self.transport


@dataclass
class _LingeringTransport:
    """A transport whose `close` leaves the client a few seconds to read its answer.

    A socket that is closed while bytes arrive is reset, and the answer may be lost.
    """

    transport: asyncio.Transport
    closing: bool = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.transport, name)

    def is_closing(self) -> bool:
        """Whether it is closed or closing."""
        return self.closing or self.transport.is_closing()

    def close(self) -> None:
        """Send what is buffered, discard what is received, and close."""
        if self.is_closing():
            return
        self.closing = True
        if self.transport.can_write_eof():
            self.transport.write_eof()
            self.transport.resume_reading()
        else:
            self.transport.close()
        asyncio.get_running_loop().call_later(LINGER_SECONDS, self.transport.abort)
