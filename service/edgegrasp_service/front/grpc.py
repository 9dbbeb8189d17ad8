"""The gRPC transport: methods on raw messages, health, reflection, and what is around each call.

Every method is served as a stream of messages in and out, which is the same on the wire: a unary
method then reads its message once there is room for it, and knows when its answer was taken.
"""

import asyncio
import inspect
import logging
import math
import urllib.parse
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any, NamedTuple

import grpc
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from grpc import aio
from grpc.aio import EOF  # type: ignore[attr-defined]  # not in its stubs
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection, reflection_pb2

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest
from edgegrasp_service.errors import AddressInUse, Cancelled, NotReady, Overloaded, Problem, report
from edgegrasp_service.front.problems import abort, error_detail
from edgegrasp_service.front.service import STOPPING, GraspService, Reloader, check_headers
from edgegrasp_service.observability import REQUEST_ID_HEADER, Call, current_call
from edgegrasp_service.worker.job import Method

logger = logging.getLogger(__name__)

SERVICE = grasp_pb2.DESCRIPTOR.services_by_name["GraspService"]
HEALTH = health.SERVICE_NAME
REFLECTION = tuple(f"grpc.reflection.{version}.ServerReflection" for version in ("v1", "v1alpha"))

# Values of the label `method`.
METHODS = {
    **{f"/{SERVICE.full_name}/{name}": name for name in SERVICE.methods_by_name},
    **{f"/{HEALTH}/{name}": f"Health{name}" for name in ("Check", "Watch", "List")},
    **{f"/{name}/ServerReflectionInfo": "Reflection" for name in REFLECTION},
}
LOOKAHEAD_BYTES = 2**20  # of a message, while nobody reads it yet; 87,000 points
SPARE_BYTES = 2**20  # a message so much over the limit is refused with field, value and fix
SMALL_READS = 8  # messages of health checks and reflection read at a time
SMALL_READ_SECONDS = 2.0

Behaviour = Callable[[Any, Any], Awaitable[None]]  # request iterator, context
Handler = Any  # grpc.RpcMethodHandler, of which the stubs know no fields


class GrpcServer:
    """A grpc.aio server with the grasp service, health checks and reflection.

    Must be made in the running event loop.

    Args:
        service: What answers.
        reloader: What reloads.
        credentials: For TLS; None: without.

    Raises:
        AddressInUse: The port cannot be bound.
    """

    def __init__(
        self,
        service: GraspService,
        reloader: Reloader,
        credentials: grpc.ServerCredentials | None = None,
    ) -> None:
        settings = service.settings
        options = [
            ("grpc.max_receive_message_length", settings.max_body_bytes + SPARE_BYTES),
            ("grpc.max_metadata_size", settings.max_header_bytes),
            ("grpc.absolute_max_metadata_size", settings.max_header_bytes),
            # What is compressed is unpacked before its length is known: none of it.
            ("grpc.compression_enabled_algorithms_bitset", 1),
            ("grpc.so_reuseport", 0),
            # A cloud comes in one go, without waiting for leave to send the rest of it.
            ("grpc.http2.lookahead_bytes", LOOKAHEAD_BYTES),
            ("grpc.http2.bdp_probe", 0),  # it would let all of a message in that nobody reads
            # A client that vanished without a word is found out, and its streams end.
            ("grpc.keepalive_time_ms", 30_000),
            ("grpc.keepalive_timeout_ms", 10_000),
            ("grpc.http2.min_recv_ping_interval_without_data_ms", 20_000),
        ]
        self._server = aio.server(interceptors=[_Interceptor(service)], options=options)
        methods = _Methods(service, reloader).handlers()
        self._add(SERVICE.full_name, methods)
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]  # not in its stubs
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        names = (SERVICE.full_name, HEALTH, *REFLECTION)
        reflect = grpc.stream_stream_rpc_method_handler(
            reflection.aio.ReflectionServicer(names).ServerReflectionInfo,  # type: ignore[attr-defined]
            reflection_pb2.ServerReflectionRequest.FromString,
            reflection_pb2.ServerReflectionResponse.SerializeToString,
        )
        for name in REFLECTION:  # the same messages under both names
            self._add(name, {"ServerReflectionInfo": reflect})
        host = settings.host
        address = f"[{host}]" if ":" in host else host
        try:
            if credentials is None:
                self.port = self._server.add_insecure_port(f"{address}:{settings.grpc_port}")
            else:
                self.port = self._server.add_secure_port(
                    f"{address}:{settings.grpc_port}", credentials
                )
        except RuntimeError as error:
            place = f"{address}:{settings.grpc_port}"
            raise AddressInUse(f"gRPC: cannot listen on {place} ({error})") from None
        self.address = f"{address}:{self.port}"

    def _add(self, name: str, handlers: dict[str, Handler]) -> None:
        self._server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler(name, handlers),)
        )

    async def start(self) -> None:
        """Open for requests, as not serving yet."""
        await self.set_serving(False)
        await self._server.start()

    async def set_serving(self, serving: bool) -> None:
        """Tell health checks."""
        states = health_pb2.HealthCheckResponse.ServingStatus
        status = states.SERVING if serving else states.NOT_SERVING
        for name in ("", SERVICE.full_name):
            await self._health.set(name, status)

    async def stop_serving(self) -> None:
        """Tell health checks that the server is stopping."""
        await self._health.enter_graceful_shutdown()

    async def stop(self, grace_seconds: float) -> None:
        """Refuse new requests, and wait for those in flight."""
        await self._server.stop(grace_seconds)


class _Methods:
    """The methods of edgegrasp.v1.GraspService."""

    def __init__(self, service: GraspService, reloader: Reloader) -> None:
        self._service = service
        self._reloader = reloader
        self._streams = 0

    def handlers(self) -> dict[str, Handler]:
        """By the methods' names."""
        return {
            "DetectGrasps": _handler(partial(self._answer, "DetectGrasps")),
            "ScoreGrasps": _handler(partial(self._answer, "ScoreGrasps")),
            "DetectGraspsStream": _handler(self._stream),
            "ListModels": _handler(self._list_models),
            "ReloadModels": _handler(self._reload_models),
        }

    async def _answer(self, method: Method, messages: Any, context: Any) -> None:
        service, call = self._service, current_call()
        async with service.admit(call, service.settings.max_body_bytes) as ticket:
            body = await self._read(context)
            work = service.answer(call, ticket, method, body)
            del body  # the job has it until a worker has
            answer = await work
            if answer.error is not None:
                await abort(context, answer.error)
            await _write(context, answer.body, service.time_to_write(len(answer.body)))
            call.end_stage("write")

    async def _read(self, context: Any) -> bytes:
        try:
            async with asyncio.timeout(self._service.time_to_read(0)):
                message = await context.read()
        except TimeoutError:
            raise self._service.too_slow(0) from None
        if message is EOF:
            raise InvalidRequest("request", "nothing", "Send one message.")
        self._service.check_size(len(message))
        body: bytes = message
        return body

    async def _stream(self, messages: Any, context: Any) -> None:
        most = self._service.settings.max_streams
        if self._streams >= most:
            raise Overloaded(f"The server has {most} streams open. Try again in 1 s.")
        self._streams += 1
        try:
            async for response in answer_stream(self._service, current_call(), context):
                await _write(context, response, self._service.time_to_write(len(response)))
        finally:
            self._streams -= 1

    async def _list_models(self, messages: Any, context: Any) -> None:
        models = [grasp_pb2.Model(**vars(model)) for model in self._service.models()]
        await context.write(grasp_pb2.ListModelsResponse(models=models).SerializeToString())

    async def _reload_models(self, messages: Any, context: Any) -> None:
        loaded = await self._reloader.reload(current_call())
        models = [grasp_pb2.Model(**vars(model)) for model in loaded]
        await context.write(grasp_pb2.ReloadModelsResponse(models=models).SerializeToString())


def _handler(behaviour: Behaviour) -> Handler:
    return grpc.stream_stream_rpc_method_handler(behaviour)


async def _write(context: Any, message: bytes, seconds: float) -> None:
    """Send a message; a client that does not take it loses its call."""
    try:
        async with asyncio.timeout(seconds):
            await context.write(message)
    except TimeoutError:
        logger.warning("a client did not take its answer of %d bytes", len(message))
        raise asyncio.CancelledError from None


class _Interceptor(aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in its stubs only
    """Before every method, those of health checks and reflection included."""

    def __init__(self, service: GraspService) -> None:
        self._service = service
        self._small_reads = asyncio.Semaphore(SMALL_READS)
        self._around: dict[str, tuple[Handler, Handler]] = {}  # by path: a handler, and its own

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler:
        """The method's handler, named, counted and logged."""
        path: str = handler_call_details.method
        handler = await continuation(handler_call_details) or _handler(_unimplemented)
        known, around = self._around.get(path, (None, None))
        if known is not handler:
            around = self._handler_around(path, handler)
            if path in METHODS:
                self._around[path] = handler, around
        return around

    def _handler_around(self, path: str, handler: Handler) -> Handler:
        method = METHODS.get(path, "other")
        small = not path.startswith(f"/{SERVICE.full_name}/")
        behaviour = self._on_messages(handler) if small else handler.stream_stream

        async def named(messages: Any, context: Any) -> None:
            headers = _headers(context.invocation_metadata())
            with self._service.call("grpc", method, headers, _address(context.peer())) as call:
                call.long = method in ("DetectGraspsStream", "HealthWatch", "Reflection")
                if (remaining := context.time_remaining()) is not None:
                    call.limit(remaining)
                try:
                    context.set_trailing_metadata(((REQUEST_ID_HEADER, call.request_id),))
                    self._check(path, call, context, headers)
                    if call.long:
                        await context.send_initial_metadata(((REQUEST_ID_HEADER, call.request_id),))
                    await behaviour(messages, context)
                    call.code = "OK"
                except EdgeGraspError as error:
                    await abort(context, report(error))
                except BaseException as error:
                    call.code = call.code or _code(error, context)
                    raise

        return grpc.stream_stream_rpc_method_handler(
            named, response_serializer=handler.response_serializer
        )

    def _check(self, path: str, call: Call, context: Any, headers: dict[str, str]) -> None:
        check_headers("metadata", len(context.invocation_metadata() or ()))
        if not path.startswith(f"/{HEALTH}/"):
            self._service.authorize(call, headers.get("authorization"))

    def _on_messages(self, handler: Handler) -> Behaviour:
        """A method of small messages, whatever its kind, as one of streams."""
        decode = handler.request_deserializer or (lambda data: data)

        async def read(context: Any) -> Any:
            """The next message; None: there are no more."""
            try:
                async with self._small_reads, asyncio.timeout(SMALL_READ_SECONDS):
                    data = await context.read()
                return None if data is EOF else decode(data)
            except TimeoutError:
                raise Cancelled("The message did not arrive.") from None
            except DecodeError:
                fix = "Send a message as the .proto file has it."
                raise InvalidRequest("request", "bytes that are no message", fix) from None

        async def requests(context: Any) -> AsyncIterator[Any]:
            while (message := await read(context)) is not None:
                yield message

        async def behave(messages: Any, context: Any) -> None:
            if handler.request_streaming:
                method, given = handler.stream_stream, requests(context)
            else:
                method = handler.unary_stream or handler.unary_unary
                given = await read(context)
            if inspect.isasyncgenfunction(method):
                async for answer in method(given, context):
                    await context.write(answer)
            elif (answer := await method(given, context)) is not None:
                await context.write(answer)

        return _unimplemented if handler.stream_stream is _unimplemented else behave


async def _unimplemented(messages: Any, context: Any) -> None:
    await context.abort(grpc.StatusCode.UNIMPLEMENTED, "Method not found!")


def _headers(metadata: Any) -> dict[str, str]:
    return {name: value for name, value in metadata or () if isinstance(value, str)}


def _address(peer: str) -> str:
    """The address in e.g. "ipv4:127.0.0.1:5000" or "ipv6:[::1]:5000", whose [ and ] are encoded."""
    return urllib.parse.unquote(peer).partition(":")[2].rpartition(":")[0].strip("[]")


def _code(error: BaseException, context: Any) -> str:
    if isinstance(error, asyncio.CancelledError | GeneratorExit):
        return "CANCELLED"
    code = context.code()
    return code.name if isinstance(code, grpc.StatusCode) else "UNKNOWN"


# Streams: requests of one at work side by side, answered in their order


class _Ahead(NamedTuple):
    """A request of the stream that is not answered yet."""

    request_id: bytes
    work: asyncio.Task[bytes | Problem]


async def answer_stream(service: GraspService, stream: Call, context: Any) -> AsyncIterator[bytes]:
    """Answer the requests of one stream.

    A request is read only when fewer than `max_stream_requests` are unanswered; what the client
    sends beyond that stays with it. Where this is closed early, what is under way is cancelled.

    Args:
        service: What answers.
        stream: The call of the stream itself.
        context: Of gRPC; read from.

    Yields:
        Serialized DetectGraspsStreamResponses.

    Raises:
        NotReady: The server is stopping; what was read is answered before.
        InvalidRequest: A message is no DetectGraspsStreamRequest.
    """
    ahead: deque[_Ahead] = deque()
    stopping = asyncio.create_task(service.stopping.wait())
    reading: asyncio.Task[Any] | None = asyncio.create_task(_next_envelope(context))
    try:
        while reading or ahead:
            if reading and len(ahead) < service.settings.max_stream_requests:
                waiting = {reading, stopping} | ({ahead[0].work} if ahead else set())
            else:
                waiting = {ahead[0].work}
            await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            if ahead and ahead[0].work.done():
                request_id, work = ahead.popleft()
                yield _response(request_id, work.result())
            elif reading and reading.done():
                request = reading.result()
                if request is not None:
                    work = asyncio.create_task(_answer(service, stream, request))
                    ahead.append(_Ahead(request.request_id, work))
                last = request is None or stopping.done()
                reading = None if last else asyncio.create_task(_next_envelope(context))
            elif stopping.done() and reading:
                reading.cancel()
                reading = None
        if stopping.done():
            raise NotReady(STOPPING)
    finally:
        for task in (stopping, reading, *(request.work for request in ahead)):
            if task is not None:
                task.cancel()


async def _next_envelope(context: Any) -> Any:
    """The next envelope; None: there are no more."""
    data = await context.read()
    if data is EOF:
        return None
    try:
        envelope = _RequestEnvelope.FromString(data)
        envelope.request_id.decode()
    except (DecodeError, UnicodeDecodeError):
        value = f"{len(data)} bytes that are no message of this method"
        fix = "Send a message as the .proto file has it."
        raise InvalidRequest("request", value, fix) from None
    return envelope


async def _answer(service: GraspService, stream: Call, envelope: Any) -> bytes | Problem:
    """A serialized DetectGraspsResponse, or why there is none."""
    try:
        with service.stream_call(stream, envelope.request_id.decode()) as call:
            _check(envelope)
            if envelope.HasField("timeout"):
                call.limit(envelope.timeout)
            body: bytes = envelope.request
            service.check_size(len(body))
            async with service.admit(call, len(body)) as ticket:
                answer = await service.answer(call, ticket, "DetectGrasps", body)
            return answer.error or answer.body
    except EdgeGraspError as error:
        return report(error)
    except Exception as error:
        logger.exception("a request of a stream failed")
        return report(error)


def _check(envelope: Any) -> None:
    if envelope.HasField("timeout") and not 0.0 < envelope.timeout < math.inf:
        fix = "Send seconds, or leave it out."
        raise InvalidRequest("timeout", str(envelope.timeout), fix)
    size = envelope.ByteSize()
    envelope.DiscardUnknownFields()
    if envelope.ByteSize() != size:
        fix = "Send the fields of this server's .proto file only."
        raise InvalidRequest("request", "a field that this server does not know", fix)


def _response(request_id: bytes, answer: bytes | Problem) -> bytes:
    if isinstance(answer, bytes):
        envelope = _ResponseEnvelope(request_id=request_id, detection=answer)
    else:
        number = grpc.StatusCode[answer.code].value[0]
        detail = error_detail(answer)
        error = grasp_pb2.StreamError(code=number, message=answer.detail, detail=detail)
        envelope = _ResponseEnvelope(request_id=request_id, error=error.SerializeToString())
    data: bytes = envelope.SerializeToString()
    return data


def _envelope(name: str, **fields: int) -> Any:
    """A class for messages with these fields, numbered from 1; messages inside stay bytes.

    Bytes and a message are the same on the wire, so what a request holds is left to the workers.
    """
    file = descriptor_pb2.FileDescriptorProto(name=f"{name}.proto", package="edgegrasp.envelopes")
    message = file.message_type.add(name=name)
    for number, (field, kind) in enumerate(fields.items(), 1):
        message.field.add(name=field, number=number, type=kind, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(
        pool.FindMessageTypeByName(f"edgegrasp.envelopes.{name}")
    )


_BYTES = descriptor_pb2.FieldDescriptorProto.TYPE_BYTES
_DOUBLE = descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE
_RequestEnvelope = _envelope(
    "DetectGraspsStreamRequest", request_id=_BYTES, request=_BYTES, timeout=_DOUBLE
)
_ResponseEnvelope = _envelope(
    "DetectGraspsStreamResponse", request_id=_BYTES, detection=_BYTES, error=_BYTES
)
