"""The HTTP transport: routes, problem documents, probes."""

import http
import logging
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.body_limit import BodyLimit
from edgegrasp_service.core import GraspService
from edgegrasp_service.errors import NotReady, report
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
)
from edgegrasp_service.http_openapi import OPENAPI_DETECT, OPENAPI_SCORE
from edgegrasp_service.http_problem import problem_response
from edgegrasp_service.http_request import read_request, read_score_request

logger = logging.getLogger(__name__)

DESCRIPTION = """Grasp detection as a service: point clouds in, scored 6-DoF grasps out.

Metres, radians, seconds. Positions and directions are in the frame of the cloud sent;
`T_cloud_hand` maps hand coordinates to cloud coordinates. Errors are problem documents that name
the field, the value received and the fix."""

PROBLEM = {"content": {"application/problem+json": {"schema": ProblemBody.model_json_schema()}}}

PROBLEMS: dict[int | str, dict[str, Any]] = {
    400: {"description": "The cloud or an option is wrong.", **PROBLEM},
    404: {"description": "No weights of that name.", **PROBLEM},
    413: {"description": "Over the server's limits.", **PROBLEM},
    415: {"description": "A body the server does not read.", **PROBLEM},
    503: {"description": "Weights are loading, or the server is stopping.", **PROBLEM},
}


def create_app(service: GraspService, max_body_bytes: int) -> FastAPI:
    """The ASGI application over a service core."""
    app = FastAPI(title="EdgeGrasp", version="v1", description=DESCRIPTION, redoc_url=None)
    app.add_middleware(BodyLimit, max_body_bytes=max_body_bytes)
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
    async def detect_grasps(request: Request) -> JSONResponse:
        _require_ready(service)
        detection = await service.detect(await read_request(request))
        return JSONResponse(detection_body(detection))

    @app.post(
        "/v1/grasps:score",
        summary="Score edges or hand poses in one cloud",
        response_model=ScoringBody,
        responses=PROBLEMS,
        openapi_extra=OPENAPI_SCORE,
    )
    async def score_grasps(request: Request) -> JSONResponse:
        _require_ready(service)
        scoring = await service.score(await read_score_request(request))
        return JSONResponse(scoring_body(scoring))

    @app.get("/v1/models", summary="List the loaded weights", response_model=ModelsBody)
    async def list_models() -> JSONResponse:
        return JSONResponse(models_body(service.models()))

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


def _require_ready(service: GraspService) -> None:
    """Raise NotReady before reading what would be read in vain."""
    if not service.ready:
        raise NotReady("Weights are still loading, or the server is stopping.")


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
    }
    return JSONResponse(
        body, error.status_code, headers=error.headers, media_type="application/problem+json"
    )
