"""The edge of the gRPC transport: tokens, request ids, metrics, and a log line for each request."""

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any, NoReturn

import grpc
from grpc import aio

from edgegrasp.v1 import grasp_pb2
from edgegrasp_service.edge import Answered, Edge, check_headers
from edgegrasp_service.errors import ErrorReport, ServiceError, report
from edgegrasp_service.grpc_decoding import Decoded, Undecodable, tolerant
from edgegrasp_service.grpc_messages import ERROR_METADATA, error_message
from edgegrasp_service.request_id import HEADER, REQUEST_ID
from edgegrasp_service.tokens import HEADER as AUTHORIZATION

HEALTH = "grpc.health.v1.Health"

_SERVICE = grasp_pb2.DESCRIPTOR.services_by_name["GraspService"]

# Values of the label `method`.
METHODS = {
    **{f"/{_SERVICE.full_name}/{name}": name for name in _SERVICE.methods_by_name},
    **{f"/{HEALTH}/{name}": f"Health{name}" for name in ("Check", "Watch", "List")},
    "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": "Reflection",
}

Handler = Any  # grpc.RpcMethodHandler, of which the stubs know no fields


class GrpcEdge(aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in its stubs only
    """Interceptor before every method, those of health checks and reflection included.

    Args:
        edge: What is the same for both transports.
        max_body_bytes: Of a single message; those of streams are refused one by one.
    """

    def __init__(self, edge: Edge, max_body_bytes: int) -> None:
        self._edge = edge
        self._max_body_bytes = max_body_bytes
        self._around: dict[str, tuple[Handler, Handler]] = {}  # by path: a handler, and its own

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler:
        """The method's handler, named, counted and logged; or one that refuses."""
        path: str = handler_call_details.method
        entries = list(handler_call_details.invocation_metadata or ())
        headers = _headers(entries)
        method = METHODS.get(path, "other")
        try:
            check_headers("metadata", len(entries))
            if not path.startswith(f"/{HEALTH}/"):
                admin = method == "ReloadModels"
                self._edge.tokens.check(headers.get(AUTHORIZATION), admin=admin)
        except ServiceError as error:
            # As a stream, it refuses before the request is read.
            return self._around_writer(method, refusal(error), "stream_stream", None)
        handler = await continuation(handler_call_details)
        if handler is None:
            self._edge.metrics.request("grpc", method, "UNIMPLEMENTED", None)
            return None
        known, around = self._around.get(path, (None, None))
        if known is not handler:
            around = self._handler_around(method, handler)
            self._around[path] = handler, around  # of paths that have one, so there are few
        return around

    def _handler_around(self, method: str, handler: Handler) -> Handler:
        kinds = ("unary_unary", "unary_stream", "stream_unary", "stream_stream")
        kind = next(kind for kind in kinds if getattr(handler, kind) is not None)
        behavior = getattr(handler, kind)
        if inspect.isasyncgenfunction(behavior):
            return self._around_generator(method, behavior, kind, handler)
        return self._around_writer(method, behavior, kind, handler)

    def _around_writer(self, method: str, behavior: Any, kind: str, handler: Handler) -> Handler:
        """A handler that returns its answer, or writes it to the context."""

        async def named(request: Any, context: Any) -> Any:
            answered = Answered("UNKNOWN", long=not kind.endswith("unary"))
            headers = _headers(context.invocation_metadata())
            with self._edge.request("grpc", method, headers, answered) as request_id:
                try:
                    # Of a single answer, with it: by itself it takes a quarter of a millisecond.
                    context.set_trailing_metadata(((HEADER, request_id),))
                    if answered.long:
                        await context.send_initial_metadata(((HEADER, request_id),))
                    if isinstance(request, Undecodable):
                        await refusal(request.error)(request, context)
                    answer = await behavior(_checked(request, kind), context)
                    answered.code = "OK"
                except BaseException as error:
                    answered.code = _code(error, context)
                    raise
                return answer

        return self._handler(kind, named, handler)

    def _around_generator(self, method: str, behavior: Any, kind: str, handler: Handler) -> Handler:
        """A handler that yields its answers."""

        async def named(request: Any, context: Any) -> AsyncIterator[Any]:
            answered = Answered("UNKNOWN", long=True)
            headers = _headers(context.invocation_metadata())
            with self._edge.request("grpc", method, headers, answered) as request_id:
                try:
                    await context.send_initial_metadata(((HEADER, request_id),))
                    if isinstance(request, Undecodable):
                        await refusal(request.error)(request, context)
                    async for answer in behavior(_checked(request, kind), context):
                        yield answer
                    answered.code = "OK"
                except BaseException as error:
                    answered.code = _code(error, context)
                    raise

        return self._handler(kind, named, handler)

    def _handler(self, kind: str, behavior: Any, original: Handler) -> Handler:
        make = getattr(grpc, f"{kind}_rpc_method_handler")
        if original is None:
            return make(behavior)
        longest = self._max_body_bytes if kind.startswith("unary") else None
        return make(
            behavior,
            request_deserializer=tolerant(original.request_deserializer, longest),
            response_serializer=original.response_serializer,
        )


def refusal(error: Exception) -> Callable[[Any, Any], Awaitable[None]]:
    """A behaviour that aborts with an error."""

    async def refuse(request: Any, context: Any) -> None:
        await abort(context, report(error))

    return refuse


async def abort(context: Any, problem: ErrorReport) -> NoReturn:
    """End a call with an error, and the request's id beside it."""
    detail = error_message(problem).SerializeToString()
    trailing = ((ERROR_METADATA, detail), (HEADER, REQUEST_ID.get()))
    await context.abort(problem.code, problem.detail, trailing)
    raise AssertionError("abort raises")


def _headers(metadata: Any) -> dict[str, str]:
    return {name: value for name, value in metadata or () if isinstance(value, str)}


def _checked(request: Any, kind: str) -> Any:
    return Decoded(request) if kind.startswith("stream") else request


def _code(error: BaseException, context: Any) -> str:
    if isinstance(error, asyncio.CancelledError | GeneratorExit):
        return "CANCELLED"
    code = context.code()
    return code.name if isinstance(code, grpc.StatusCode) else "UNKNOWN"
