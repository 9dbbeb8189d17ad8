"""The HTTP transport: routes, and the middleware around every request."""

import asyncio
import logging
import math
from collections.abc import Coroutine
from typing import Any, Literal

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from fastapi_offline import FastAPIOffline
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, brief
from edgegrasp_service.errors import Cancelled, Problem, UnsupportedMediaType, report
from edgegrasp_service.call import REQUEST_ID_HEADER, Call, current_call
from edgegrasp_service.front.problems import problem_response
from edgegrasp_service.front.service import GraspService, check_headers
from edgegrasp_service.metrics import Metrics
from edgegrasp_service.openapi import Document
from edgegrasp_service.front.reload import Reloader
from edgegrasp_service.worker.job import Answer

TIMEOUT = "X-Request-Timeout"
ASSETS = "/docs/assets"
PIECE = 2**18  # bytes of an answer given to the connection at a time

# Values of the label `method`: the gRPC method's name where there is one.
METHODS = {
    "/v1/grasps": "DetectGrasps",
    "/v1/grasps:score": "ScoreGrasps",
    "/v1/models": "ListModels",
    "/v1/models:reload": "ReloadModels",
    "/health/live": "Live",
    "/health/ready": "Ready",
    "/metrics": "Metrics",
    "/": "Docs",
    "/docs": "Docs",
    "/openapi.json": "Docs",
}
# Without a token: whoever restarts a server need not know one, and the pages tell no secret.
OPEN = ("Live", "Ready", "Docs")
UNANSWERED = "499"  # the caller went away; as nginx logs it

logger = logging.getLogger(__name__)


class HttpMiddleware:
    """ASGI middleware outside of everything else: request ids, tokens, limits of headers."""

    def __init__(self, app: ASGIApp, service: GraspService) -> None:
        self._app = app
        self._service = service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        headers = {
            name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]
        }
        path = scope["path"]
        method = METHODS.get(path, "Docs" if path.startswith(f"{ASSETS}/") else "other")
        peer = scope["client"][0] if scope["client"] else ""
        whole = headers.get("content-length", "0") == "0" and "transfer-encoding" not in headers
        with self._service.call("http", method, headers, peer) as call:
            call.code = UNANSWERED

            async def receive_noting() -> Message:
                nonlocal whole
                message = await receive()
                whole = whole or not message.get("more_body", False)
                return message

            async def send_named(message: Message) -> None:
                if message["type"] == "http.response.start":
                    call.code = str(message["status"])
                    extra = [(REQUEST_ID_HEADER.encode(), call.request_id.encode())]
                    # What still comes in of a request that is answered is not waited for.
                    if not whole or self._service.stopping.is_set():
                        extra.append((b"connection", b"close"))
                    message = {**message, "headers": [*message.get("headers", []), *extra]}
                await send(message)

            try:
                self._check(scope, call, headers)
            except EdgeGraspError as error:
                call.problem = report(error)
                await problem_response(call.problem)(scope, receive, send_named)
                return
            if scope["method"] == "HEAD":  # the protocol leaves the body out
                scope = {**scope, "method": "GET"}
            await self._app(scope, receive_noting, send_named)

    def _check(self, scope: Scope, call: Call, headers: dict[str, str]) -> None:
        size = sum(len(name) + len(value) for name, value in scope["headers"])
        size += len(scope["raw_path"]) + len(scope["query_string"])
        most = self._service.settings.max_header_bytes
        check_headers("headers", len(scope["headers"]), size, most)
        if call.method not in OPEN:
            self._service.authorize(call, headers.get("authorization"))
        if (encoding := headers.get("content-encoding", "identity").lower()) != "identity":
            fix = "Send the body as it is; .npz and .pcd files may be compressed inside."
            raise UnsupportedMediaType("Content-Encoding", repr(encoding[:40]), fix)


def create_app(
    service: GraspService, metrics: Metrics, reloader: Reloader, document: Document
) -> ASGIApp:
    """The ASGI application.

    Args:
        service: What answers.
        metrics: What /metrics shows.
        reloader: What reloads.
        document: The OpenAPI document.
    """
    app: FastAPI = FastAPIOffline(
        title="EdgeGrasp", version="v1", redoc_url=None, static_url=ASSETS, redirect_slashes=False
    )
    app.openapi = document  # type: ignore[method-assign]
    app.add_exception_handler(EdgeGraspError, _answer_error)
    app.add_exception_handler(Exception, _answer_error)
    app.add_exception_handler(HTTPException, _answer_http_error)

    @app.post("/v1/grasps")
    async def detect_grasps() -> Response:
        return _GraspResponse(service, "DetectGrasps")

    @app.post("/v1/grasps:score")
    async def score_grasps() -> Response:
        return _GraspResponse(service, "ScoreGrasps")

    @app.get("/v1/models")
    async def list_models() -> JSONResponse:
        return JSONResponse({"models": [vars(model) for model in service.models()]})

    @app.post("/v1/models:reload")
    async def reload() -> JSONResponse:
        models = await reloader.reload(current_call())
        return JSONResponse({"models": [vars(model) for model in models]})

    @app.get("/health/live")
    async def live() -> JSONResponse:
        return JSONResponse({"status": "live"})

    @app.get("/health/ready")
    async def ready() -> JSONResponse:
        status = "ready" if service.ready else "not ready"
        return JSONResponse({"status": status}, status_code=200 if service.ready else 503)

    @app.get("/metrics")
    async def read_metrics(request: Request) -> Response:
        body, content_type = metrics.page(request.headers.get("accept", ""))
        return PlainTextResponse(body, headers={"content-type": content_type})

    @app.get("/")
    async def index() -> Response:
        return RedirectResponse("/docs")

    return HttpMiddleware(app, service)


class _GraspResponse(Response):
    """Takes a ticket, receives the request, has it answered, and sends the answer."""

    def __init__(
        self, service: GraspService, method: Literal["DetectGrasps", "ScoreGrasps"]
    ) -> None:
        super().__init__()
        self._service = service
        self._method = method
        self._sending = False

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; raises the errors of `GraspService`."""
        service, call = self._service, current_call()
        headers = Headers(scope=scope)
        call.limit(_timeout(headers))
        most = service.settings.max_body_bytes
        size = int(headers.get("content-length", most))
        service.check_size(size)
        try:
            async with service.admit(call, size) as ticket:
                body = await self._receive_body(receive)
                content_type = headers.get("content-type", "")
                query = scope["query_string"].decode("latin-1")
                work = service.answer(call, ticket, self._method, body, content_type, query)
                del body  # the job has it until a worker has
                answer = await _unless_gone(receive, work)
                if answer.error is None:
                    response = Response(answer.body, media_type="application/json")
                else:
                    response = _problem(call, answer.error)
                await self._send(response, send)
                call.end_stage("write")
        except EdgeGraspError:
            if not self._sending:
                raise
            call.code = UNANSWERED
            scope["state"]["abort"]()  # half an answer is none
            await _gone(receive)

    async def _receive_body(self, receive: Receive) -> bytes:
        """The body; raises RequestTimeout where it arrives too slowly."""
        pieces: list[bytes] = []
        received, more = 0, True
        start = asyncio.get_running_loop().time()
        while more:
            try:
                async with asyncio.timeout_at(start + self._service.time_to_read(received)):
                    message = await receive()
            except TimeoutError:
                raise self._service.too_slow(received) from None
            if message["type"] == "http.disconnect":
                raise Cancelled("The client left before its request was whole.")
            pieces.append(message.get("body", b""))
            received += len(pieces[-1])
            self._service.check_size(received)
            more = message.get("more_body", False)
        return b"".join(pieces)

    async def _send(self, response: Response, send: Send) -> None:
        """Send an answer in pieces; raises Cancelled where the client does not take them."""
        body = bytes(response.body)
        start = {"type": "http.response.start", "status": response.status_code}
        self._sending = True
        try:
            async with asyncio.timeout(self._service.time_to_write(len(body))):
                await send({**start, "headers": response.raw_headers})
                for begin in range(0, len(body), PIECE):
                    piece = body[begin : begin + PIECE]
                    await send({"type": "http.response.body", "body": piece, "more_body": True})
                await send({"type": "http.response.body"})
        except TimeoutError:
            raise Cancelled(f"The client did not take {len(body)} bytes.") from None


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


def _timeout(headers: Headers) -> float:
    """Seconds that the caller waits; infinity: it does not say."""
    text = headers.get(TIMEOUT)
    if text is None:
        return math.inf
    try:
        timeout = float(text)
    except ValueError:
        timeout = math.nan
    if not 0.0 < timeout < math.inf:
        raise InvalidRequest(TIMEOUT, brief(text), "Send seconds, such as 2.5, or leave it out.")
    return timeout


def _problem(call: Call, problem: Problem) -> Response:
    call.problem = problem
    if problem.status >= 500:
        logger.warning("%s: %s", call.method, problem.detail)
    return problem_response(problem)


async def _answer_error(request: Request, error: Exception) -> Response:
    return _problem(current_call(), report(error))


async def _answer_http_error(request: Request, error: Exception) -> Response:
    """Errors of the routing itself: no such path, no such method."""
    assert isinstance(error, HTTPException)
    detail = f"{request.method} {request.url.path}: {error.detail}. See /docs."
    response = problem_response(Problem("http", detail, "", "", "", "", error.status_code))
    response.headers.update(error.headers or {})
    return response
