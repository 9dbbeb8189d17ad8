"""The gRPC transport: servicer, health, reflection."""

import logging
from typing import Any, NoReturn

from google.protobuf.message import Message
from grpc import aio
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.body_limit import MAX_DROPPED_BYTES, too_large
from edgegrasp_service.core import GraspService
from edgegrasp_service.errors import AddressInUse, report
from edgegrasp_service.grpc_messages import (
    detection_message,
    error_message,
    models_message,
    request_from_message,
    score_request_from_message,
    scoring_message,
)

logger = logging.getLogger(__name__)

SERVICE_NAME = grasp_pb2.DESCRIPTOR.services_by_name["GraspService"].full_name
ERROR_METADATA = "edgegrasp-error-bin"


class GraspServicer(grasp_pb2_grpc.GraspServiceServicer):
    """edgegrasp.v1.GraspService over a service core."""

    def __init__(self, service: GraspService, max_body_bytes: int) -> None:
        self._service = service
        self._max_body_bytes = max_body_bytes

    async def DetectGrasps(  # noqa: N802
        self, request: grasp_pb2.DetectGraspsRequest, context: Any
    ) -> grasp_pb2.DetectGraspsResponse:
        """Find grasps in one cloud."""
        try:
            self._check_size(request)
            return detection_message(await self._service.detect(request_from_message(request)))
        except Exception as error:
            await _abort(context, error)

    async def ScoreGrasps(  # noqa: N802
        self, request: grasp_pb2.ScoreGraspsRequest, context: Any
    ) -> grasp_pb2.ScoreGraspsResponse:
        """Score given edges or hand poses."""
        try:
            self._check_size(request)
            return scoring_message(await self._service.score(score_request_from_message(request)))
        except Exception as error:
            await _abort(context, error)

    async def ListModels(  # noqa: N802
        self, request: grasp_pb2.ListModelsRequest, context: Any
    ) -> grasp_pb2.ListModelsResponse:
        """List the loaded weights."""
        try:
            return models_message(self._service.models())
        except Exception as error:
            await _abort(context, error)

    def _check_size(self, request: Message) -> None:
        if (size := request.ByteSize()) > self._max_body_bytes:
            raise too_large(size, self._max_body_bytes)


class GrpcServer:
    """A grpc.aio server with the grasp service, health checks and reflection.

    Must be made in the running event loop.

    Args:
        service: The core.
        host: Address to bind to.
        port: 0: any free port.
        max_body_bytes: Largest request message accepted.

    Raises:
        AddressInUse: The port cannot be bound.
    """

    def __init__(self, service: GraspService, host: str, port: int, max_body_bytes: int) -> None:
        # Messages somewhat over the limit come in to be refused with field, value and fix.
        longest = max_body_bytes + MAX_DROPPED_BYTES
        options = [("grpc.max_receive_message_length", longest), ("grpc.so_reuseport", 0)]
        self._server = aio.server(options=options)
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]  # not in its stubs
        servicer = GraspServicer(service, max_body_bytes)
        grasp_pb2_grpc.add_GraspServiceServicer_to_server(servicer, self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        names = (SERVICE_NAME, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, self._server)
        address = f"[{host}]" if ":" in host else host
        try:
            self.port = self._server.add_insecure_port(f"{address}:{port}")
        except RuntimeError as error:
            raise AddressInUse(f"gRPC: cannot listen on {address}:{port} ({error})") from None
        self.address = f"{address}:{self.port}"

    async def start(self) -> None:
        """Open for requests, as not serving yet."""
        await self.set_serving(False)
        await self._server.start()

    async def set_serving(self, serving: bool) -> None:
        """Tell health checks."""
        states = health_pb2.HealthCheckResponse.ServingStatus
        status = states.SERVING if serving else states.NOT_SERVING
        for name in ("", SERVICE_NAME):
            await self._health.set(name, status)

    async def stop(self, grace_seconds: float) -> None:
        """Refuse new requests, and wait for those in flight."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(grace_seconds)


async def _abort(context: Any, error: Exception) -> NoReturn:
    problem = report(error)
    if problem.status >= 500:
        logger.warning("gRPC: %s", problem.detail)
    detail = error_message(problem).SerializeToString()
    await context.abort(problem.code, problem.detail, ((ERROR_METADATA, detail),))
    raise AssertionError("abort raises")
