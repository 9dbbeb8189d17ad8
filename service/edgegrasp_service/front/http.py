"""The HTTP transport: routes, and the middleware around every request."""

import asyncio
import math
from collections.abc import Coroutine
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from fastapi_offline import FastAPIOffline
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, brief
from edgegrasp_service.errors import Cancelled, Problem, UnsupportedMediaType, report
from edgegrasp_service.front.problems import problem_response
from edgegrasp_service.front.service import GraspService, Reloader, check_headers
from edgegrasp_service.observability import REQUEST_ID_HEADER, Call, Metrics, current_call
from edgegrasp_service.schemas import (
    TIMEOUT,
    DetectionBody,
    HealthBody,
    ModelsBody,
    ProblemBody,
    ScoringBody,
    openapi_detect,
    openapi_score,
)
from edgegrasp_service.worker.job import Answer, Method

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

DESCRIPTION = """Grasp detection as a service: point clouds in, scored 6-DoF grasps out.

Metres, radians, seconds. Positions and directions are in the frame of the cloud sent;
`T_cloud_hand` maps hand coordinates to cloud coordinates. Errors are problem documents that name
the field, the value received and the fix."""

PROBLEM = {"content": {"application/problem+json": {"schema": ProblemBody.model_json_schema()}}}
PROBLEMS = {
    400: "The cloud or an option is wrong.",
    401: "No token, or none that the server knows.",
    403: "A token for detection, or a server without admin tokens.",
    404: "No weights of that name.",
    408: "The body arrives too slowly.",
    409: "New weights cannot be used; the old ones still serve.",
    413: "Over the server's limits.",
    415: "A body the server does not read.",
    429: "The server is full; Retry-After says for how long.",
    431: "Headers over the server's limits.",
    500: "The server failed; its log says why.",
    501: "The format's reader is not installed on the server.",
    503: "Weights are loading, the server is stopping, or the worker of the request died.",
    504: "The deadline passed before there was an answer.",
}
OF_REQUESTS = (400, 401, 404, 408, 413, 415, 429, 431, 500, 501, 503, 504)


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


def create_app(service: GraspService, metrics: Metrics, reloader: Reloader) -> FastAPI:
    """The application, without its middleware.

    Args:
        service: What answers.
        metrics: What /metrics shows.
        reloader: What reloads.
    """
    app: FastAPI = FastAPIOffline(
        title="EdgeGrasp",
        version="v1",
        description=DESCRIPTION,
        redoc_url=None,
        static_url=ASSETS,
        redirect_slashes=False,
    )
    for kind in (EdgeGraspError, Exception):
        app.add_exception_handler(kind, _answer_error)
    app.add_exception_handler(HTTPException, _answer_http_error)

    @app.post(
        "/v1/grasps",
        summary="Find grasps in one cloud",
        response_model=DetectionBody,
        responses=_problems(*OF_REQUESTS),
        openapi_extra=openapi_detect(),
    )
    async def detect_grasps() -> Response:
        return _GraspResponse(service, "DetectGrasps")

    @app.post(
        "/v1/grasps:score",
        summary="Score edges or hand poses in one cloud",
        response_model=ScoringBody,
        responses=_problems(*OF_REQUESTS),
        openapi_extra=openapi_score(),
    )
    async def score_grasps() -> Response:
        return _GraspResponse(service, "ScoreGrasps")

    @app.get(
        "/v1/models",
        summary="List the loaded weights",
        response_model=ModelsBody,
        responses=_problems(401, 503),
    )
    async def list_models() -> JSONResponse:
        return JSONResponse({"models": [vars(model) for model in service.models()]})

    @app.post(
        "/v1/models:reload",
        summary="Load weights, tokens and certificates anew; needs an admin token",
        response_model=ModelsBody,
        responses=_problems(401, 403, 409, 503),
    )
    async def reload() -> JSONResponse:
        models = await reloader.reload(current_call())
        return JSONResponse({"models": [vars(model) for model in models]})

    @app.get("/health/live", summary="Does the process answer?", response_model=HealthBody)
    async def live() -> JSONResponse:
        return JSONResponse({"status": "live"})

    @app.get(
        "/health/ready",
        summary="Are weights loaded and warmed up?",
        response_model=HealthBody,
        responses={503: {"description": "Not yet, or no longer.", "model": HealthBody}},
    )
    async def ready() -> JSONResponse:
        status = "ready" if service.ready else "not ready"
        return JSONResponse({"status": status}, status_code=200 if service.ready else 503)

    @app.get("/metrics", include_in_schema=False)
    async def read_metrics(request: Request) -> Response:
        body, content_type = metrics.page(request.headers.get("accept", ""))
        return PlainTextResponse(body, headers={"content-type": content_type})

    @app.get("/", include_in_schema=False)
    async def index() -> Response:
        return RedirectResponse("/docs")

    return app


def _problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    return {status: {"description": PROBLEMS[status], **PROBLEM} for status in statuses}


class _GraspResponse(Response):
    """Takes a ticket, receives the request, has it answered, and sends the answer."""

    def __init__(self, service: GraspService, method: Method) -> None:
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
