"""The gRPC transport: servicer, health, reflection."""

import logging
from collections.abc import AsyncIterator, Sequence
from functools import partial
from typing import Any, NoReturn

import grpc
from grpc import aio
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.body_limit import MAX_DROPPED_BYTES
from edgegrasp_service.call import Call
from edgegrasp_service.core import GraspService
from edgegrasp_service.errors import AddressInUse, report
from edgegrasp_service.grpc_door import GrpcDoor
from edgegrasp_service.grpc_edge import GrpcEdge, abort
from edgegrasp_service.grpc_messages import (
    models_message,
    reloaded_message,
    score_request_from_message,
    scoring_message,
)
from edgegrasp_service.grpc_stream import answer_stream, detect
from edgegrasp_service.observer import observed
from edgegrasp_service.reload import Reloader, reload_models
from edgegrasp_service.request_id import REQUEST_ID

logger = logging.getLogger(__name__)

LOOKAHEAD_BYTES = 2**20  # of a message, while nobody reads it yet; 87,000 points

SERVICE_NAME = grasp_pb2.DESCRIPTOR.services_by_name["GraspService"].full_name


class GraspServicer(grasp_pb2_grpc.GraspServiceServicer):
    """edgegrasp.v1.GraspService over a service core."""

    def __init__(self, service: GraspService, reloader: Reloader | None = None) -> None:
        self._service = service
        self._reloader = reloader

    async def DetectGrasps(  # noqa: N802
        self, request: grasp_pb2.DetectGraspsRequest, context: Any
    ) -> grasp_pb2.DetectGraspsResponse:
        """Find grasps in one cloud."""
        call = _call("DetectGrasps", context)
        try:
            return await detect(self._service, request, call)
        except Exception as error:
            await _abort(context, error)

    async def ScoreGrasps(  # noqa: N802
        self, request: grasp_pb2.ScoreGraspsRequest, context: Any
    ) -> grasp_pb2.ScoreGraspsResponse:
        """Score given edges or hand poses."""
        call = _call("ScoreGrasps", context)
        try:
            with observed(self._service.observer, call), self._service.admit(call) as place:
                read = partial(score_request_from_message, request)
                return await self._service.score(read, place, scoring_message)
        except Exception as error:
            await _abort(context, error)

    async def DetectGraspsStream(  # noqa: N802
        self, request_iterator: AsyncIterator[grasp_pb2.DetectGraspsStreamRequest], context: Any
    ) -> AsyncIterator[grasp_pb2.DetectGraspsStreamResponse]:
        """Find grasps in one cloud after the other."""
        try:
            async for answer in answer_stream(self._service, request_iterator):
                yield answer
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

    async def ReloadModels(  # noqa: N802
        self, request: grasp_pb2.ReloadModelsRequest, context: Any
    ) -> grasp_pb2.ReloadModelsResponse:
        """Load weights, tokens and certificates anew."""
        try:
            return reloaded_message(await reload_models(self._reloader))
        except Exception as error:
            await _abort(context, error)


class GrpcServer:
    """A grpc.aio server with the grasp service, health checks and reflection.

    Must be made in the running event loop.

    Args:
        service: The core.
        host: Address to bind to.
        port: 0: any free port.
        interceptors: Around every method, the first outermost.
        credentials: For TLS; None: without.
        reloader: None: nobody may reload.

    Raises:
        AddressInUse: The port cannot be bound.
    """

    def __init__(
        self,
        service: GraspService,
        host: str,
        port: int,
        *,
        interceptors: Sequence[GrpcEdge] = (),
        credentials: grpc.ServerCredentials | None = None,
        reloader: Reloader | None = None,
    ) -> None:
        # Messages somewhat over the limit come in to be refused with field, value and fix.
        longest = service.settings.max_body_bytes + MAX_DROPPED_BYTES
        most_metadata = service.settings.max_header_bytes
        options = [
            ("grpc.max_receive_message_length", longest),
            ("grpc.max_metadata_size", most_metadata),
            ("grpc.absolute_max_metadata_size", most_metadata),
            # What is compressed is unpacked before its length is known: none of it.
            ("grpc.compression_enabled_algorithms_bitset", 1),
            ("grpc.so_reuseport", 0),
            # A cloud comes in one go, without waiting for leave to send the rest of it.
            ("grpc.http2.lookahead_bytes", LOOKAHEAD_BYTES),
            # A client that vanished without a word is found out, and its streams end.
            ("grpc.keepalive_time_ms", 30_000),
            ("grpc.keepalive_timeout_ms", 10_000),
            ("grpc.http2.min_recv_ping_interval_without_data_ms", 20_000),
        ]
        every = (*interceptors, GrpcDoor(service))
        self._server = aio.server(interceptors=every, options=options)
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]  # not in its stubs
        servicer = GraspServicer(service, reloader)
        grasp_pb2_grpc.add_GraspServiceServicer_to_server(servicer, self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        names = (SERVICE_NAME, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, self._server)
        address = f"[{host}]" if ":" in host else host
        try:
            if credentials is None:
                self.port = self._server.add_insecure_port(f"{address}:{port}")
            else:
                self.port = self._server.add_secure_port(f"{address}:{port}", credentials)
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

    async def stop_serving(self) -> None:
        """Tell health checks that the server is stopping."""
        await self._health.enter_graceful_shutdown()

    async def stop(self, grace_seconds: float) -> None:
        """Refuse new requests, and wait for those in flight."""
        await self._server.stop(grace_seconds)


def _call(method: str, context: Any) -> Call:
    timeout: float | None = context.time_remaining()
    return Call("grpc", method, request_id=REQUEST_ID.get(), timeout=timeout)


async def _abort(context: Any, error: Exception) -> NoReturn:
    problem = report(error)
    if problem.status >= 500:
        logger.warning("gRPC: %s", problem.detail)
    await abort(context, problem)
