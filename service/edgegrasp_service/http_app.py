"""The HTTP transport: routes, problem documents, probes."""

import asyncio
import http
import logging
from collections.abc import Awaitable, Callable, Coroutine
from functools import partial
from typing import Any, TypeVar

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.admission import Place
from edgegrasp_service.body_limit import BodyLimit
from edgegrasp_service.call import Call
from edgegrasp_service.core import GraspService, in_time
from edgegrasp_service.errors import Cancelled, report
from edgegrasp_service.http_bodies import (
    KIND_PREFIX,
    DetectionBody,
    HealthBody,
    ModelsBody,
    ProblemBody,
    ScoringBody,
    detection_body,
    models_body,
    scoring_body,
    written,
)
from edgegrasp_service.http_openapi import OPENAPI_DETECT, OPENAPI_SCORE
from edgegrasp_service.http_problem import problem_response
from edgegrasp_service.http_request import read_timeout, receive_request, receive_score_request
from edgegrasp_service.observer import observed
from edgegrasp_service.reload import Reloader, reload_models
from edgegrasp_service.request_id import REQUEST_ID

logger = logging.getLogger(__name__)

Asked = TypeVar("Asked")

DESCRIPTION = """Grasp detection as a service: point clouds in, scored 6-DoF grasps out.

Metres, radians, seconds. Positions and directions are in the frame of the cloud sent;
`T_cloud_hand` maps hand coordinates to cloud coordinates. Errors are problem documents that name
the field, the value received and the fix."""

PROBLEM = {"content": {"application/problem+json": {"schema": ProblemBody.model_json_schema()}}}

PROBLEMS: dict[int | str, dict[str, Any]] = {
    400: {"description": "The cloud or an option is wrong.", **PROBLEM},
    401: {"description": "No token, or none that the server knows.", **PROBLEM},
    404: {"description": "No weights of that name.", **PROBLEM},
    413: {"description": "Over the server's limits.", **PROBLEM},
    415: {"description": "A body the server does not read.", **PROBLEM},
    429: {"description": "The server is full; Retry-After says for how long.", **PROBLEM},
    431: {"description": "Headers over the server's limits.", **PROBLEM},
    500: {"description": "The server failed; its log says why.", **PROBLEM},
    501: {"description": "The format's reader is not installed on the server.", **PROBLEM},
    503: {"description": "Weights are loading, or the server is stopping.", **PROBLEM},
    504: {"description": "The deadline passed before there was an answer.", **PROBLEM},
}

RELOAD_PROBLEMS: dict[int | str, dict[str, Any]] = {
    401: {"description": "No token, or none that the server knows.", **PROBLEM},
    403: {"description": "A token for detection, or a server without admin tokens.", **PROBLEM},
    409: {"description": "New weights cannot be used; the old ones still serve.", **PROBLEM},
    503: PROBLEMS[503],
}


def create_app(service: GraspService, reloader: Reloader | None = None) -> FastAPI:
    """The ASGI application over a service core; without a reloader, nobody may reload."""
    app = FastAPI(title="EdgeGrasp", version="v1", description=DESCRIPTION, redoc_url=None)
    app.add_middleware(BodyLimit, max_body_bytes=service.settings.max_body_bytes)
    for error in (EdgeGraspError, Exception):
        app.add_exception_handler(error, _answer_error)
    app.add_exception_handler(HTTPException, _answer_http_error)

    @app.post(
        "/v1/grasps",
        summary="Find grasps in one cloud",
        response_model=DetectionBody,
        responses=PROBLEMS,
        openapi_extra=OPENAPI_DETECT,
    )
    async def detect_grasps(request: Request) -> Response:
        call = Call("http", "DetectGrasps", request_id=REQUEST_ID.get())
        work = partial(service.detect, write=lambda answer: written(detection_body(answer)))
        return await _answer(service, request, call, receive_request, work)

    @app.post(
        "/v1/grasps:score",
        summary="Score edges or hand poses in one cloud",
        response_model=ScoringBody,
        responses=PROBLEMS,
        openapi_extra=OPENAPI_SCORE,
    )
    async def score_grasps(request: Request) -> Response:
        call = Call("http", "ScoreGrasps", request_id=REQUEST_ID.get())
        work = partial(service.score, write=lambda answer: written(scoring_body(answer)))
        return await _answer(service, request, call, receive_score_request, work)

    @app.get("/v1/models", summary="List the loaded weights", response_model=ModelsBody)
    async def list_models() -> JSONResponse:
        return JSONResponse(models_body(service.models()))

    @app.post(
        "/v1/models:reload",
        summary="Load weights, tokens and certificates anew; needs an admin token",
        response_model=ModelsBody,
        responses=RELOAD_PROBLEMS,
    )
    async def reload() -> JSONResponse:
        return JSONResponse(models_body(await reload_models(reloader)))

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
        if service.ready:
            return JSONResponse({"status": "ready"})
        return JSONResponse({"status": "not ready"}, status_code=503)

    return app


async def _answer(
    service: GraspService,
    request: Request,
    call: Call,
    receive: Callable[[Request], Coroutine[Any, Any, Callable[[], Asked]]],
    work: Callable[[Callable[[], Asked], Place], Coroutine[Any, Any, bytes]],
) -> Response:
    """Take a place, receive the request, and work on it while the client is there."""
    with observed(service.observer, call):
        if (timeout := read_timeout(request)) is not None:
            call.limit(timeout)
        with service.admit(call) as place:
            try:
                read = await in_time(call, receive(request))
            except ClientDisconnect:
                raise Cancelled("The client left before its request was whole.") from None
            body = await _unless_gone(request, work(read, place))
            return Response(body, media_type="application/json")


async def _unless_gone(request: Request, work: Coroutine[Any, Any, bytes]) -> bytes:
    """What the work gives; once the client closes, it is cancelled, and Cancelled raised."""
    working = asyncio.create_task(work)
    gone = asyncio.create_task(_gone(request.receive))
    try:
        await asyncio.wait({working, gone}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise Cancelled("The client left.")
        return working.result()
    finally:
        gone.cancel()
        working.cancel()


async def _gone(receive: Callable[[], Awaitable[Any]]) -> None:
    """Return once the client has closed the connection."""
    while (await receive())["type"] != "http.disconnect":
        pass


async def _answer_error(request: Request, error: Exception) -> JSONResponse:
    problem = report(error)
    if problem.status >= 500:
        logger.warning("%s %s: %s", request.method, request.url.path, problem.detail)
    return problem_response(problem)


async def _answer_http_error(request: Request, error: Exception) -> JSONResponse:
    """Errors of the routing itself: no such path, no such method."""
    assert isinstance(error, HTTPException)
    body = {
        "type": KIND_PREFIX + "http",
        "title": http.HTTPStatus(error.status_code).phrase,
        "status": error.status_code,
        "detail": f"{request.method} {request.url.path}: {error.detail}. See /docs.",
        "field": "",
        "value": "",
        "fix": "",
        "retry_after": None,
    }
    return JSONResponse(
        body, error.status_code, headers=error.headers, media_type="application/problem+json"
    )
