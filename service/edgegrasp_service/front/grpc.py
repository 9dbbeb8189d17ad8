"""The gRPC transport: methods on raw messages, health, reflection, checks around each call, limits.

Every method is registered as a bidirectional stream, which looks the same on the wire. A unary
method can then read its message when there is room for it, and knows when its answer was read.
"""

import asyncio
import contextlib
import logging
import math
import os
import socket
import struct
import urllib.parse
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Sized
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import grpc
from google.protobuf import any as any_message
from google.protobuf import duration
from google.protobuf.message import DecodeError
from google.protobuf.wrappers_pb2 import BytesValue
from google.rpc import error_details_pb2, status_pb2  # type: ignore[import-untyped]
from grpc import aio
from grpc.aio import EOF  # type: ignore[attr-defined]  # not in its stubs
from grpc_health.v1 import health, health_pb2
from grpc_reflection.v1alpha import reflection, reflection_pb2

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest
from edgegrasp_service import errors
from edgegrasp_service.front.service import MAX_HEADERS, EvictingLimiter, GraspService
from edgegrasp_service.observability import REQUEST_ID_HEADER, UNTIMED_METHODS, Call, network_of
from edgegrasp_service.settings import UNIX_PREFIX, Settings
from edgegrasp_service.worker.process import Job, Method

logger = logging.getLogger(__name__)

SERVICE = grasp_pb2.DESCRIPTOR.services_by_name["GraspService"]
HEALTH_SERVICE = health.SERVICE_NAME
HEALTH_CHECK = f"/{HEALTH_SERVICE}/Check"
STATES = health_pb2.HealthCheckResponse.ServingStatus
REFLECTION = tuple(f"grpc.reflection.{version}.ServerReflection" for version in ("v1", "v1alpha"))

MAX_WATCHERS = 64  # open health watches and reflection streams
WATCH_SECONDS = 1.0  # seconds between two checks of the health
STREAM_IDLE_SECONDS = 300.0  # seconds that a stream may stay open without a message
STREAM_GRACE_SECONDS = 10.0  # seconds after which an idle stream yields its place to another one
MAX_STREAM_FIELDS = 16  # fields read from one message of a stream; only three are defined
# The fields of a DetectGraspsStreamRequest, by tag.
STREAM_FIELDS = {0x0A: "request_id", 0x12: "request", 0x19: "timeout"}

# Connections
MAX_CALLS_PER_CONNECTION = 100  # calls of one connection at a time; further ones wait in the client
LOOKAHEAD_BYTES = 2**20  # buffered bytes of a message that is not being read yet; 87,000 points
SPARE_BYTES = 2**20  # a message too long by up to this gets an error with field, value and fix
SPARE_CONNECTIONS = 4  # gRPC accepts this many times max_connections; `trim` closes the surplus
TRIM_SECONDS = 0.05  # seconds between two checks for too many connections
DESCRIPTORS = Path("/proc/self/fd")
LAST_RECEIVED = struct.Struct("52xI")  # of struct tcp_info: tcpi_last_data_recv, milliseconds

ERROR_DOMAIN = "edgegrasp"  # of google.rpc.ErrorInfo
ERROR_METADATA = "edgegrasp-error-bin"  # trailing: an ErrorDetail
STATUS_METADATA = "grpc-status-details-bin"  # trailing: a google.rpc.Status

Behaviour = Callable[[Call, Any], Awaitable[None]]  # takes the call and its context


class GrpcServer(grpc.GenericRpcHandler):  # type: ignore[type-arg]  # generic in its stubs only
    """A grpc.aio server with the grasp service, health checks and reflection.

    Each call gets a request id and is counted and logged. Create it in the running event loop.

    Raises:
        AddressInUse: The port cannot be bound.
    """

    def __init__(self, service: GraspService) -> None:
        self._service = service
        names = (SERVICE.full_name, HEALTH_SERVICE, *REFLECTION)
        self._reflection = reflection.aio.ReflectionServicer(names)  # type: ignore[attr-defined]
        self._watchers = EvictingLimiter(MAX_WATCHERS)
        self._streams = EvictingLimiter(service.settings.max_streams, STREAM_GRACE_SECONDS)
        ours: dict[str, Behaviour] = {
            "DetectGrasps": partial(self._answer, "DetectGrasps"),
            "ScoreGrasps": partial(self._answer, "ScoreGrasps"),
            "DetectGraspsStream": self._stream,
            "ListModels": partial(self._list, "models"),
            "ListRobots": partial(self._list, "robots"),
            "ReloadModels": self._reload_models,
        }
        # By path: the method's name in metrics and the log, and its implementation.
        self._behaviours: dict[str, tuple[str, Behaviour]] = {
            **{f"/{SERVICE.full_name}/{name}": (name, does) for name, does in ours.items()},
            HEALTH_CHECK: ("HealthCheck", self._check_health),
            f"/{HEALTH_SERVICE}/Watch": ("HealthWatch", self._watch_health),
        }
        for name in REFLECTION:
            self._behaviours[f"/{name}/ServerReflectionInfo"] = "Reflection", self._reflect
        self.server = aio.server(options=_bounds(service.settings))
        self.server.add_generic_rpc_handlers((self,))
        # The health check has its own queue, so that it does not wait for other calls.
        self.server.add_registered_method_handlers(  # type: ignore[attr-defined]
            HEALTH_SERVICE, {"Check": self._handler(HEALTH_CHECK)}
        )
        self.address, self._port = self._listen()

    def _listen(self) -> tuple[str, int]:
        """Open the port; returns its address and number, 0 for a socket."""
        settings, tls = self._service.settings, self._service.tls
        sockets = settings.host.startswith(UNIX_PREFIX)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        place = f"{settings.host}/grpc.sock" if sockets else f"{host}:{settings.grpc_port}"
        try:
            if tls is None:
                port = self.server.add_insecure_port(place)
            else:
                port = self.server.add_secure_port(place, tls.grpc)
        except RuntimeError as error:
            raise errors.AddressInUse("gRPC", place, str(error)) from None
        return (place, 0) if sockets else (f"{host}:{port}", port)

    async def trim(self, others: Sized) -> None:
        """Keep closing surplus connections, which gRPC cannot limit by client.

        Descriptors of `others`, connections to other ports, do not count.
        """
        most = self._service.settings.max_connections
        while True:
            await asyncio.sleep(TRIM_SECONDS)
            with contextlib.suppress(OSError), contextlib.ExitStack() as duplicates:
                if len([*DESCRIPTORS.iterdir()]) - len(others) > most:
                    _trim(self._port, most, duplicates)

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> Any:
        """The handler of a path, known or not."""
        return self._handler(handler_call_details.method)

    def _handler(self, path: str) -> Any:
        handle = partial(self._handle, path)
        return grpc.stream_stream_rpc_method_handler(handle, response_serializer=_serialized)

    async def _handle(self, path: str, messages: Any, context: Any) -> None:
        metadata = context.invocation_metadata() or ()
        headers = {name: value for name, value in metadata if isinstance(value, str)}
        method, behave = self._behaviours.get(path, ("other", _unimplemented))
        # A peer is e.g. ipv4:127.0.0.1:5000, or ipv6:[::1]:5000 with encoded brackets.
        _, _, peer = urllib.parse.unquote(context.peer()).partition(":")
        address, _, port = peer.rpartition(":")
        address = address.strip("[]")
        call = Call("grpc", method, headers.get(REQUEST_ID_HEADER, ""), address)
        with self._service.observe(call):
            name = ((REQUEST_ID_HEADER, call.request_id),)
            try:
                context.set_trailing_metadata(name)
                if len(metadata) > MAX_HEADERS:
                    value, fix = f"{len(metadata)} entries", f"Send at most {MAX_HEADERS}."
                    raise errors.HeadersTooLarge("metadata", value, fix)
                if not path.startswith(f"/{HEALTH_SERVICE}/"):
                    self._service.authorize(call, headers.get("authorization"))
                if method in UNTIMED_METHODS:
                    await context.send_initial_metadata(name)
                await behave(call, context)
            except errors.Cancelled as error:
                call.problem = errors.to_problem(error)
                # Otherwise gRPC would keep the answer until the connection closes.
                _disconnect(self._port, network_of(address), port)
                raise asyncio.CancelledError from None
            except aio.AbortError:
                raise
            except aio.InternalError:  # the connection broke while an answer was sent
                raise asyncio.CancelledError from None
            except Exception as error:
                if not isinstance(error, EdgeGraspError):
                    logger.exception("%s failed", method)
                try:
                    await _abort(call, context, errors.to_problem(error))
                except aio.InternalError:  # an answer is being sent, and the deadline has passed
                    if call.bytes_out and context.time_remaining() is None:
                        _disconnect(self._port, network_of(address), port)
                    raise asyncio.CancelledError from None

    async def _answer(self, method: Method, call: Call, context: Any) -> None:
        service, remaining = self._service, context.time_remaining()
        timeout = math.inf if remaining is None else remaining
        async with service.admit(call, service.settings.max_body_bytes, timeout):
            body = await service.receive(context.read())
            if body is EOF:
                raise InvalidRequest("request", "nothing", "Send one message.")
            answer = await service.answer(call, Job(method, "grpc", body))
            if answer.error is not None:
                await _abort(call, context, answer.error)
            async with service.sending(call.bytes_out):
                await context.write(answer.body)

    async def _stream(self, call: Call, context: Any) -> None:
        """Answer the requests of one stream in their order; several are processed in parallel.

        A request is read only when fewer than `max_stream_requests` are unanswered; flow control
        makes the client wait. When it disconnects, requests in progress are cancelled.

        Raises:
            NotReady: The server is stopping; requests already read are answered first.
            InvalidRequest: A message is not a DetectGraspsStreamRequest.
            RequestTimeout: No message arrived for STREAM_IDLE_SECONDS.
            Overloaded: There is no place for the stream, or another client got its place.
        """
        service = self._service
        ahead: deque[asyncio.Task[bytes]] = deque()  # unanswered requests
        stopping = asyncio.create_task(service.stopping.wait())
        unreadable: BaseException | None = None  # raised once earlier requests are answered
        reading: asyncio.Task[Any] | None = asyncio.create_task(_next_request(context))
        try:
            async with self._streams.hold(call.client) as permit:
                while reading or ahead:
                    self._streams.use(permit, idle=not ahead)
                    waiting: set[asyncio.Task[Any]] = {ahead[0]} if ahead else set()
                    if reading and len(ahead) < service.settings.max_stream_requests:
                        waiting |= {reading, stopping}
                    timeout = None if ahead else STREAM_IDLE_SECONDS
                    done, _ = await asyncio.wait(
                        waiting, timeout=timeout, return_when=asyncio.FIRST_COMPLETED
                    )
                    if not done:
                        value = f"no message in {timeout:.0f} s"
                        raise errors.RequestTimeout("request", value, "Open another stream.")
                    if ahead and ahead[0].done():
                        response = ahead.popleft().result()
                        async with service.sending(len(response)):
                            await context.write(response)
                    elif reading and reading.done():
                        unreadable = reading.exception()
                        request = None if unreadable else reading.result()
                        if request is not None:
                            ahead.append(asyncio.create_task(_answer(service, call, request)))
                        last = request is None or stopping.done()
                        reading = None if last else asyncio.create_task(_next_request(context))
                    elif reading:  # the server is stopping
                        reading.cancel()
                        reading = None
                if unreadable is not None:
                    raise unreadable
                if stopping.done():
                    raise errors.NotReady(errors.STOPPING_MESSAGE)
        finally:
            for task in (stopping, reading, *ahead):
                if task is not None:
                    task.cancel()

    async def _list(self, name: str, call: Call, context: Any) -> None:
        response = getattr(grasp_pb2, f"List{name.capitalize()}Response")
        await context.write(response(**{name: getattr(self._service.require_pool(), name)}))

    async def _reload_models(self, call: Call, context: Any) -> None:
        models: Any = await self._service.reload(call)
        await context.write(grasp_pb2.ReloadModelsResponse(models=models))

    async def _check_health(self, call: Call, context: Any) -> None:
        """Answer without reading the message: all services have the same status."""
        status = STATES.SERVING if self._service.ready else STATES.NOT_SERVING
        await context.write(health_pb2.HealthCheckResponse(status=status))

    async def _watch_health(self, call: Call, context: Any) -> None:
        """Send the health status and each change; raises NotReady once the server is stopping."""
        told: bool | None = None
        async with self._watchers.hold(call.client):
            while told is not False or not self._service.stopping.is_set():
                if told != self._service.ready:
                    told = self._service.ready
                    await self._check_health(call, context)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(WATCH_SECONDS):
                        await self._service.stopping.wait()
        raise errors.NotReady(errors.STOPPING_MESSAGE)

    async def _reflect(self, call: Call, context: Any) -> None:
        async def requests() -> AsyncIterator[Any]:
            while (data := await self._service.receive(context.read())) is not EOF:
                try:
                    request = reflection_pb2.ServerReflectionRequest.FromString(data)
                except DecodeError:
                    raise errors.unreadable_message(data) from None
                yield request

        async with self._watchers.hold(call.client):
            async for answer in self._reflection.ServerReflectionInfo(requests(), context):
                await context.write(answer)


async def _unimplemented(call: Call, context: Any) -> None:
    problem = errors.Problem("grpc", "Method not found!", "", "", "", "UNIMPLEMENTED", 404)
    await _abort(call, context, problem)


def _serialized(message: Any) -> bytes:
    data: bytes = message if isinstance(message, bytes) else message.SerializeToString()
    return data


async def _abort(call: Call, context: Any, problem: errors.Problem) -> NoReturn:
    """End a call with an error: our ErrorDetail, google.rpc's details and the request id."""
    call.problem = problem
    code = grpc.StatusCode[problem.code]
    reason = problem.kind.upper().replace("-", "_")
    details: list[Any] = [error_details_pb2.ErrorInfo(reason=reason, domain=ERROR_DOMAIN)]
    if problem.retry_after is not None:
        delay = duration.from_milliseconds(int(problem.retry_after * 1000))
        details.append(error_details_pb2.RetryInfo(retry_delay=delay))
    if problem.field:
        violation = {"field": problem.field, "description": problem.detail}
        details.append(error_details_pb2.BadRequest(field_violations=[violation]))
    packed = [any_message.pack(detail) for detail in details]
    status = status_pb2.Status(code=code.value[0], message=problem.detail, details=packed)
    trailing = (
        (ERROR_METADATA, error_detail(problem).SerializeToString()),
        (STATUS_METADATA, status.SerializeToString()),
        (REQUEST_ID_HEADER, call.request_id),
    )
    await context.abort(code, problem.detail, trailing)
    raise AssertionError("abort raises")


def error_detail(problem: errors.Problem) -> grasp_pb2.ErrorDetail:
    """An error as the message of edgegrasp.v1."""
    names = [field.name for field in grasp_pb2.ErrorDetail.DESCRIPTOR.fields]
    return grasp_pb2.ErrorDetail(**{name: getattr(problem, name) for name in names})


# Streams


async def _next_request(context: Any) -> dict[str, Any] | None:
    """The fields of the next DetectGraspsStreamRequest; None at the end.

    Not parsed by protobuf, which takes seconds for millions of fields. Raises InvalidRequest.
    """
    data = await context.read()
    if data is EOF:
        return None
    fields: dict[str, Any] = {"request_id": b"", "request": b""}
    place = 0
    try:
        for _ in range(MAX_STREAM_FIELDS):
            if place == len(data):
                return fields | {"request_id": fields["request_id"].decode()}
            name, place = STREAM_FIELDS[data[place]], place + 1
            size = 8
            if name != "timeout":
                size, place = _varint(data, place)
            if place + size > len(data):
                break
            fields[name] = data[place : place + size]
            place += size
    except (LookupError, UnicodeDecodeError):
        pass
    raise errors.unreadable_message(data)


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """The number at a position, and the position after it."""
    value = shift = 0
    while data[place] & 128 and shift < 63:
        value |= (data[place] & 127) << shift
        place, shift = place + 1, shift + 7
    return value | data[place] << shift, place + 1


async def _answer(service: GraspService, stream: Call, request: dict[str, Any]) -> bytes:
    """A serialized DetectGraspsStreamResponse."""
    request_id, body = request["request_id"], request["request"]
    call = Call("grpc", stream.method, request_id, stream.peer, stream.token, in_stream=True)
    detection = b""
    try:
        with service.observe(call):
            async with service.admit(call, len(body), _timeout(request)):
                answer = await service.answer(call, Job("DetectGrasps", "grpc", body))
                detection = answer.body
    except Exception as error:
        if not isinstance(error, EdgeGraspError):
            logger.exception("a request of a stream failed")
    response = grasp_pb2.DetectGraspsStreamResponse(request_id=request_id)
    if (problem := call.problem) is None:
        # Field 2 as it is on the wire: field 1 of BytesValue, under another number.
        return _serialized(response) + b"\x12" + _serialized(BytesValue(value=detection))[1:]
    response.error.code = grpc.StatusCode[problem.code].value[0]
    response.error.message = problem.detail
    response.error.detail.CopyFrom(error_detail(problem))
    return _serialized(response)


def _timeout(request: dict[str, Any]) -> float:
    """The timeout in seconds; raises InvalidRequest unless it is positive and finite, or absent."""
    if "timeout" not in request:
        return math.inf
    timeout: float = struct.unpack("<d", request["timeout"])[0]
    if not 0.0 < timeout < math.inf:
        raise InvalidRequest("timeout", str(timeout), "Send seconds, or leave it out.")
    return timeout


# Connections


def _bounds(settings: Settings) -> list[tuple[str, int]]:
    """Options of the server: limits on connections and messages."""
    return [
        ("grpc.max_receive_message_length", settings.max_body_bytes + SPARE_BYTES),
        ("grpc.max_metadata_size", settings.max_header_bytes),
        ("grpc.absolute_max_metadata_size", settings.max_header_bytes),
        # Compressed messages are unpacked before their size is known: none are accepted.
        ("grpc.compression_enabled_algorithms_bitset", 1),
        ("grpc.so_reuseport", 0),
        # One call is accepted per turn of the event loop; a health check waits for those ahead.
        ("grpc.max_concurrent_streams", MAX_CALLS_PER_CONNECTION),
        ("grpc.max_allowed_incoming_connections", SPARE_CONNECTIONS * settings.max_connections),
        ("grpc.server_handshake_timeout_ms", int(settings.read_seconds * 1000)),
        ("grpc.max_connection_idle_ms", 300_000),
        # A cloud arrives without waiting for window updates.
        ("grpc.http2.lookahead_bytes", LOOKAHEAD_BYTES),
        ("grpc.http2.bdp_probe", 0),  # would buffer whole messages that nobody reads yet
        # Clients that vanished are noticed, and their streams end.
        ("grpc.keepalive_time_ms", 30_000),
        ("grpc.keepalive_timeout_ms", 10_000),
        # Clients resolve the name again from time to time, and find new servers.
        ("grpc.max_connection_age_ms", 300_000),
        ("grpc.http2.min_ping_interval_without_data_ms", 20_000),
    ]


def _connections(
    port: int, duplicates: contextlib.ExitStack
) -> list[tuple[str, int, socket.socket]]:
    """Duplicates of the connections to a port, each with its client's network and port."""
    found = []
    for link in DESCRIPTORS.iterdir():
        with contextlib.suppress(OSError):
            if not link.is_socket():
                continue
            one = duplicates.enter_context(socket.socket(fileno=os.dup(int(link.name))))
            if one.family != socket.AF_UNIX and one.getsockname()[1] == port:
                host, its_port = one.getpeername()[:2]  # OSError for the listening socket
                found.append((network_of(host), its_port, one))
    return found


def _disconnect(port: int, owner: str, its_port: str) -> None:
    """Shut down one client's connection to a port; over a Unix socket this does nothing."""
    with contextlib.ExitStack() as duplicates:
        for network, number, one in _connections(port, duplicates):
            if (network, str(number)) == (owner, its_port):
                _shut_down(one)


def _shut_down(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it is closed already
        connection.shutdown(socket.SHUT_RDWR)


def _trim(port: int, most: int, duplicates: contextlib.ExitStack) -> None:
    """Shut down surplus connections to a port: the longest silent of the clients with the most."""
    found: defaultdict[str, list[tuple[int, socket.socket]]] = defaultdict(list)
    for owner, _, one in _connections(port, duplicates):
        info = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, LAST_RECEIVED.size)
        found[owner].append((*LAST_RECEIVED.unpack(info), one))
    for rows in found.values():
        rows.sort(key=lambda row: row[0])
    for _ in range(sum(map(len, found.values())) - most):
        _shut_down(max(found.values(), key=len).pop()[1])
