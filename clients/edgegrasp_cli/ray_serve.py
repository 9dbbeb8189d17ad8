"""A worker as a Ray Serve application, for several machines.

serve run docker/ray/serve.yaml

docs/containers.md says when to use it. Ray replaces `edgegrasp_service.front`: it admits and queues
requests, and chooses, adds and replaces replicas. It has no streams, tokens or TLS.
"""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, cast, get_args

from grpc import StatusCode
from ray import serve
from ray.serve.grpc_util import RayServegRPCContext
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import problem_document, to_problem
from edgegrasp_service.front.grpc import ERROR_METADATA, error_detail
from edgegrasp_service.front.http import METHODS, requested_timeout
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import answer, load_catalogue, load_robots
from edgegrasp_service.worker.process import Answer, Facts, Job, Method

LIST_METHODS = ("ListModels", "ListRobots")


def _rpc(method: str) -> Callable[..., Awaitable[Any]]:
    """A method of Grasps that answers over gRPC."""

    async def rpc(self: Any, request: Any, grpc_context: RayServegRPCContext) -> Any:
        response = getattr(grasp_pb2, f"{method}Response")
        if method in LIST_METHODS:
            return response(**self._listed(method))
        seconds, body = self._settings.max_request_seconds, request.SerializeToString()
        found = await self._answer(Job(cast(Method, method), "grpc", body, seconds))
        if (problem := found.error) is not None:
            grpc_context.set_code(StatusCode[problem.code])
            grpc_context.set_details(problem.detail)
            trailing = [(ERROR_METADATA, error_detail(problem).SerializeToString())]
            grpc_context.set_trailing_metadata(trailing)  # type: ignore[arg-type]
        return response.FromString(found.body)

    return rpc


@serve.deployment(max_ongoing_requests=1, user_config={})
class Grasps:
    """A worker: one request at a time, bytes in and bytes out."""

    async def reconfigure(self, settings: dict[str, Any]) -> None:
        """Load the weights of these settings; called by Ray at start and on changes."""
        given = Settings(**settings)
        self._catalogue = await asyncio.to_thread(load_catalogue, given)
        self._settings = given

    async def __call__(self, request: Request) -> Response:
        """Answer over HTTP."""
        method = METHODS.get(request.url.path, "")
        if method in ("Live", "Ready"):
            return JSONResponse({"status": method.lower()})
        if method in LIST_METHODS:
            return JSONResponse(self._listed(method))
        if method not in get_args(Method) or request.method != "POST":
            return Response(status_code=404)
        content_type = request.headers.get("content-type", "")
        body, query = await request.body(), request.url.query
        try:
            seconds = min(requested_timeout(request.headers), self._settings.max_request_seconds)
            job = Job(cast(Method, method), "http", body, seconds, content_type, query)
            found = await self._answer(job)
        except EdgeGraspError as error:
            found = Answer(b"", Facts(), to_problem(error))
        if found.error is None:
            return Response(found.body, media_type="application/json")
        document = problem_document(found.error)
        return Response(document, found.error.status, media_type="application/problem+json")

    DetectGrasps, ScoreGrasps = _rpc("DetectGrasps"), _rpc("ScoreGrasps")
    ListModels, ListRobots = map(_rpc, LIST_METHODS)

    def _listed(self, method: str) -> dict[str, Any]:
        if method == "ListModels":
            return {"models": self._catalogue.describe()}
        return {"robots": [robot.describe() for robot in load_robots(self._settings).values()]}

    async def _answer(self, job: Job) -> Answer:
        return await asyncio.to_thread(answer, job, self._catalogue, self._settings)


app = Grasps.bind()  # type: ignore[attr-defined]  # the decorator makes it a deployment
