"""The HTTP transport: routes, and the middleware around every request."""

import asyncio
import ipaddress
import json
import math
import re
from collections.abc import Coroutine
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from fastapi_offline import FastAPIOffline
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.routing import Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, brief
from edgegrasp_model.gripper import gripper_names, load_gripper
from edgegrasp_service.errors import (
    Cancelled,
    Problem,
    UnsupportedMediaType,
    problem_document,
    report,
)
from edgegrasp_service.front import connections
from edgegrasp_service.front.connections import PAGE_GRACE_SECONDS, PAGES, Places
from edgegrasp_service.front.service import GraspService, Reloader, check_headers
from edgegrasp_service.observability import REQUEST_ID_HEADER, Call, Metrics, current_call
from edgegrasp_service.worker.job import Answer, Job, Method

ASSETS = "/docs/assets"
PLAYGROUND = "/playground/"
PLAYGROUND_FILES = Path(__file__).parents[1] / "playground"
OWN_ONLY = (  # what a page may load, and who may show it
    "default-src 'none'; script-src 'self'{0}; style-src 'self'{0}; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# The page of the interface has a script inside, and nothing of a stranger's.
POLICIES = {"/docs": OWN_ONLY.format(" 'unsafe-inline'")}
POLICY = OWN_ONLY.format("")
CHALLENGE = 'Bearer realm="edgegrasp"'
TIMEOUT = "X-Request-Timeout"
NUMBER = re.compile(r"\d{1,9}(\.\d*)?|\.\d+|\d{1,9}(\.\d*)?[eE][+-]?\d{1,2}", re.ASCII)

WORK: dict[str, Method] = {  # what workers do
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
    "/docs": "Docs",
    "/openapi.json": "Docs",
}
# Without a token: whoever restarts a server need not know one, and the pages tell no secret.
OPEN = ("Live", "Ready", "Docs")

# The contract, written by hand as grasp.proto is.
DOCUMENT = json.loads(Path(grasp_pb2.__file__).with_name("openapi.json").read_text())


class HttpMiddleware:
    """ASGI middleware outside of everything else: request ids, tokens, limits of headers."""

    def __init__(self, app: ASGIApp, service: GraspService) -> None:
        self._app = app
        self._service = service
        self._pages = Places(PAGES, PAGE_GRACE_SECONDS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        headers = {
            name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]
        }
        path = scope["path"]
        page = path.startswith((f"{ASSETS}/", PLAYGROUND))
        method = METHODS.get(path, "Docs" if page else "other")
        peer = scope["client"][0] if scope["client"] else ""
        whole = headers.get("content-length", "0") == "0" and "transfer-encoding" not in headers
        call = Call("http", method, headers.get(REQUEST_ID_HEADER, ""), peer)
        with self._service.observe(call):

            async def receive_noting() -> Message:
                nonlocal whole
                message = await receive()
                whole = whole or not message.get("more_body", False)
                return message

            async def send_named(message: Message) -> None:
                if message["type"] == "http.response.start":
                    call.code = str(message["status"])
                    extra = [
                        (REQUEST_ID_HEADER.encode(), call.request_id.encode()),
                        (b"content-security-policy", POLICIES.get(path, POLICY).encode()),
                        (b"x-content-type-options", b"nosniff"),
                    ]
                    # What still comes in of a request that is answered is not waited for.
                    if not whole or self._service.stopping.is_set():
                        extra.append((b"connection", b"close"))
                    message = {**message, "headers": [*message.get("headers", []), *extra]}
                await send(message)

            if scope["method"] == "HEAD":  # the protocol leaves the body out
                scope = {**scope, "method": "GET"}
            try:
                self._check(scope, call, headers)
                async with self._pages.hold(call.client) if method == "Docs" else nullcontext():
                    await self._app(scope, receive_noting, send_named)
            except EdgeGraspError as error:
                if call.code:
                    await _break_off(call, error, scope, receive)
                else:
                    await _problem_response(call, report(error))(scope, receive, send_named)

    def _check(self, scope: Scope, call: Call, headers: dict[str, str]) -> None:
        size = sum(len(name) + len(value) for name, value in scope["headers"])
        size += len(scope["raw_path"]) + len(scope["query_string"])
        most = self._service.settings.max_header_bytes
        check_headers("headers", len(scope["headers"]), size, most)
        if call.method not in ("Live", "Ready"):
            self._check_host(headers.get("host", ""))
        if call.method not in OPEN:
            self._service.authorize(call, headers.get("authorization"))
        if (encoding := headers.get("content-encoding", "identity").lower()) != "identity":
            fix = "Send the body as it is; .npz and .pcd files may be compressed inside."
            raise UnsupportedMediaType("Content-Encoding", repr(encoding[:40]), fix)

    def _check_host(self, host: str) -> None:
        """Refuse names that a stranger's web page may have pointed here, to read the answers."""
        name = re.sub(r":\d*$", "", host).strip("[]").lower()
        allowed = self._service.settings.allowed_hosts
        if not allowed and (self._service.tokens.required or "." not in name or is_address(name)):
            return  # nobody can register a name without a dot, nor an address
        if name not in allowed and "*" not in allowed and name != self._service.settings.host:
            fix = "Use an address of the server, or name it in the setting allowed_hosts."
            raise InvalidRequest("Host", brief(host), fix)


def is_address(name: str) -> bool:
    """Whether it is an IP address."""
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def create_app(service: GraspService, metrics: Metrics, reloader: Reloader) -> FastAPI:
    """The application, without its middleware."""
    settings = service.settings
    app: FastAPI = FastAPIOffline(
        title="EdgeGrasp", redoc_url=None, static_url=ASSETS, redirect_slashes=False
    )
    app.openapi = lambda: DOCUMENT  # type: ignore[method-assign]
    for kind in (EdgeGraspError, Exception):
        app.add_exception_handler(kind, _answer_error)
    app.add_exception_handler(HTTPException, _answer_http_error)

    for path, method in WORK.items():
        if method != "RecordOutcome" or settings.outcomes_file is not None:
            app.router.routes.append(Route(path, _Work(service, method), methods=["POST"]))

    @app.get("/v1/models")
    async def list_models() -> Response:
        return JSONResponse({"models": service.loaded().models})

    @app.get("/v1/robots")
    async def list_robots() -> Response:
        return JSONResponse({"robots": service.loaded().robots})

    @app.post("/v1/models:reload")
    async def reload() -> Response:
        return JSONResponse({"models": await reloader.reload(current_call())})

    @app.get("/health/live")
    async def live() -> Response:
        return JSONResponse({"status": "live"})

    @app.get("/health/ready")
    async def ready() -> Response:
        status = "ready" if service.ready else "not ready"
        return JSONResponse({"status": status}, status_code=200 if service.ready else 503)

    @app.get("/metrics")
    async def read_metrics(request: Request) -> Response:
        body, content_type = metrics.page(request.headers.get("accept", ""))
        return PlainTextResponse(body, headers={"content-type": content_type})

    @app.get("/")
    async def index() -> Response:
        return RedirectResponse(PLAYGROUND if settings.playground else "/docs")

    if settings.playground:
        grippers = {name: load_gripper(name) for name in gripper_names()}
        grippers |= {file.stem: load_gripper(file) for file in settings.grippers}

        @app.get(f"{PLAYGROUND}grippers.json")
        async def show_grippers() -> dict[str, Any]:
            return grippers

        samples = settings.samples or PLAYGROUND_FILES / "samples"
        app.mount(f"{PLAYGROUND}samples", StaticFiles(directory=samples))
        app.mount(PLAYGROUND.rstrip("/"), StaticFiles(directory=PLAYGROUND_FILES, html=True))
    return app


class _Work:
    """A route to the workers: receives a body once there is room, and sends what they answer."""

    def __init__(self, service: GraspService, method: Method) -> None:
        self._service = service
        self._method = method

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; raises the errors of `GraspService`."""
        service, call, headers = self._service, current_call(), Headers(scope=scope)
        call.limit(requested_timeout(headers))
        size = int(headers.get("content-length", service.settings.max_body_bytes))
        try:
            async with service.admit(call, size) as ticket:
                job = self._read_job(scope, headers, receive)
                answer = await _unless_gone(receive, service.answer(call, ticket, await job))
                await connections.send(
                    service.settings, _send_answer(call, answer, send), call.bytes_out
                )
        except EdgeGraspError as error:
            if not call.code:
                raise
            await _break_off(call, error, scope, receive)

    async def _read_job(self, scope: Scope, headers: Headers, receive: Receive) -> Job:
        pieces: list[bytes] = []
        received, more = 0, True
        start = asyncio.get_running_loop().time()
        while more:
            message = await connections.receive(self._service.settings, receive(), received, start)
            if message["type"] == "http.disconnect":
                raise Cancelled("The client left before its request was whole.")
            pieces.append(message.get("body", b""))
            received += len(pieces[-1])
            self._service.check_size(received)
            more = message.get("more_body", False)
        query = scope["query_string"].decode("latin-1")
        content_type = headers.get("content-type", "")
        return Job(self._method, "http", b"".join(pieces), 0.0, content_type, query)


async def _send_answer(call: Call, answer: Answer, send: Send) -> None:
    """Send an answer; returns once the client has taken most of it."""
    if answer.error is not None:
        response = _problem_response(call, answer.error)
    else:
        response = Response(answer.body, media_type="application/json")
    start = {"type": "http.response.start", "status": response.status_code}
    await send({**start, "headers": response.raw_headers})
    await send({"type": "http.response.body", "body": response.body, "more_body": True})
    await send({"type": "http.response.body"})


async def _break_off(call: Call, error: EdgeGraspError, scope: Scope, receive: Receive) -> None:
    """Close a connection whose client has half an answer, which is none."""
    call.problem, call.code = report(error), ""
    scope["state"]["abort"]()
    await _gone(receive)


async def _unless_gone(receive: Receive, work: Coroutine[Any, Any, Answer]) -> Answer:
    """What the work gives; once the client closes, it is cancelled, and Cancelled raised."""
    working = asyncio.create_task(work)
    gone = asyncio.create_task(_gone(receive))
    try:
        await asyncio.wait({working, gone}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise Cancelled("The client left.")
        return working.result()
    finally:
        gone.cancel()
        working.cancel()


async def _gone(receive: Receive) -> None:
    """Return once the client has closed the connection."""
    while (await receive())["type"] != "http.disconnect":
        pass


def requested_timeout(headers: Headers) -> float:
    """Seconds that the caller waits; infinity: it does not say."""
    text = headers.get(TIMEOUT)
    if text is None:
        return math.inf
    timeout = float(text) if NUMBER.fullmatch(text) else math.nan
    if not 0.0 < timeout < math.inf:
        raise InvalidRequest(TIMEOUT, brief(text), "Send seconds, such as 2.5, or leave it out.")
    return timeout


def _problem_response(call: Call, problem: Problem) -> Response:
    """The answer that tells of an error."""
    call.problem = problem
    headers = {}
    if problem.retry_after is not None:
        headers["retry-after"] = str(math.ceil(problem.retry_after))
    if problem.status == 401:
        headers["www-authenticate"] = CHALLENGE
    document = problem_document(problem)
    return Response(document, problem.status, headers, "application/problem+json")


async def _answer_error(request: Request, error: Exception) -> Response:
    return _problem_response(current_call(), report(error))


async def _answer_http_error(request: Request, error: Exception) -> Response:
    """Errors of the routing itself: no such path, no such method."""
    assert isinstance(error, HTTPException)
    detail = f"{request.method} {request.url.path}: {error.detail}. See /docs."
    problem = Problem("http", detail, "", "", "", "", error.status_code)
    response = _problem_response(current_call(), problem)
    response.headers.update(error.headers or {})
    return response
