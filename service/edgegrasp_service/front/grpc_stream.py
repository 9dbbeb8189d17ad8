"""DetectGraspsStream: requests of one stream at work side by side, answered in their order."""

import asyncio
import logging
import math
from collections import deque
from collections.abc import AsyncIterator
from typing import Any, NamedTuple

import grpc
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from grpc.aio import EOF  # type: ignore[attr-defined]  # not in its stubs

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest
from edgegrasp_service.call import Call
from edgegrasp_service.errors import NotReady, Problem, report
from edgegrasp_service.front.problems import error_detail
from edgegrasp_service.front.service import STOPPING, GraspService

logger = logging.getLogger(__name__)


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
    reading: asyncio.Task[Any] | None = asyncio.create_task(_read(context))
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
                reading = None if last else asyncio.create_task(_read(context))
            elif stopping.done() and reading:
                reading.cancel()
                reading = None
        if stopping.done():
            raise NotReady(STOPPING)
    finally:
        for task in (stopping, reading, *(request.work for request in ahead)):
            if task is not None:
                task.cancel()


async def _read(context: Any) -> Any:
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
