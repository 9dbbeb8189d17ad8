"""The door of the gRPC transport: a full server refuses before it reads the message."""

from collections.abc import Awaitable, Callable
from typing import Any

import grpc
from grpc import aio

from edgegrasp_service.core import GraspService
from edgegrasp_service.errors import ServiceError
from edgegrasp_service.grpc_edge import METHODS, refusal

GUARDED = ("DetectGrasps", "ScoreGrasps")  # each request of a stream is admitted by itself


class GrpcDoor(aio.ServerInterceptor):  # type: ignore[type-arg]  # none at run time
    """Interceptor, inside of the one that knows who may ask."""

    def __init__(self, service: GraspService) -> None:
        self._service = service

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """The method's handler, or one that refuses."""
        if METHODS.get(handler_call_details.method) in GUARDED:
            try:
                self._service.check_open()
            except ServiceError as error:
                # As a stream, it does not wait for the message.
                return grpc.stream_stream_rpc_method_handler(refusal(error))
        return await continuation(handler_call_details)
