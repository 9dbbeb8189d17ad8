"""DetectGraspsStream: requests of one stream at work side by side, answered in their order."""

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator
from typing import NamedTuple

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_service.body_limit import too_large
from edgegrasp_service.call import Call
from edgegrasp_service.core import GraspService
from edgegrasp_service.errors import STOPPING, ErrorReport, NotReady, report
from edgegrasp_service.grpc_messages import (
    detection_message,
    request_from_message,
    stream_response,
)
from edgegrasp_service.observer import observed
from edgegrasp_service.option_messages import refuse_unknown_fields

Requests = AsyncIterator[grasp_pb2.DetectGraspsStreamRequest]
Response = grasp_pb2.DetectGraspsStreamResponse


class _Ahead(NamedTuple):
    """A request of the stream that is not answered yet."""

    request_id: str
    work: asyncio.Task[grasp_pb2.DetectGraspsResponse | ErrorReport]


async def detect(
    service: GraspService, message: grasp_pb2.DetectGraspsRequest, call: Call
) -> grasp_pb2.DetectGraspsResponse:
    """Answer one message; raises an error of the table in `edgegrasp_service.errors`."""
    with observed(service.observer, call), service.admit(call) as place:
        return await service.detect(lambda: request_from_message(message), place, detection_message)


async def answer_stream(service: GraspService, requests: Requests) -> AsyncIterator[Response]:
    """Answer the requests of one stream.

    A request is read only when fewer than `max_stream_requests` are unanswered; what the client
    sends beyond that stays with it. Where this is closed early, what is under way is cancelled.

    Raises:
        NotReady: The server is stopping; what was read is answered before.
    """
    ahead: deque[_Ahead] = deque()
    stopping = asyncio.create_task(service.stopping.wait())
    reading = _read(requests)
    try:
        while reading or ahead:
            if reading and len(ahead) < service.settings.max_stream_requests:
                waiting = {reading, stopping} | ({ahead[0].work} if ahead else set())
            else:
                waiting = {ahead[0].work}
            await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            if ahead and ahead[0].work.done():
                request_id, work = ahead.popleft()
                yield stream_response(request_id, work.result())
            elif reading and reading.done():
                request = reading.result()
                if request is not None:
                    work = asyncio.create_task(_answer(service, request))
                    ahead.append(_Ahead(request.request_id, work))
                last = request is None or stopping.done()
                reading = None if last else _read(requests)
            elif stopping.done() and reading:
                reading.cancel()
                reading = None
        if stopping.done():
            raise NotReady(STOPPING)
    finally:
        for task in (stopping, reading, *(request.work for request in ahead)):
            if task is not None:
                task.cancel()


def _read(
    requests: Requests,
) -> asyncio.Task[grasp_pb2.DetectGraspsStreamRequest | None] | None:
    async def read() -> grasp_pb2.DetectGraspsStreamRequest | None:
        return await anext(requests, None)

    return asyncio.create_task(read())


async def _answer(
    service: GraspService, request: grasp_pb2.DetectGraspsStreamRequest
) -> grasp_pb2.DetectGraspsResponse | ErrorReport:
    """A detection, or why there is none."""
    call = Call("grpc", "DetectGraspsStream", request_id=request.request_id)
    try:
        refuse_unknown_fields(request, "request")
        if request.HasField("timeout"):
            call.limit(_checked(request.timeout))
        if (size := request.request.ByteSize()) > service.settings.max_body_bytes:
            raise too_large(size, service.settings.max_body_bytes)
        return await detect(service, request.request, call)
    except Exception as error:
        return report(error)


def _checked(timeout: float) -> float:
    if not 0.0 < timeout < math.inf:
        raise InvalidRequest("timeout", str(timeout), "Send seconds, or leave it out.")
    return timeout
