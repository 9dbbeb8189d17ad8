"""One stream, many clouds: answers in order, errors among them, and no more read than bounded."""

import asyncio
from typing import Any

import grpc
import numpy as np
import pytest

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc


def request(name: str, points: np.ndarray, timeout: float | None = None, **options: Any) -> Any:
    detect = {"points": points.tobytes(), "options": options}
    return grasp_pb2.DetectGraspsStreamRequest(request_id=name, request=detect, timeout=timeout)


async def test_an_error_is_an_answer_and_the_stream_goes_on(running, cloud) -> None:
    stream = running.stub().DetectGraspsStream()
    bad = request("negative", cloud, timeout=-1.0)
    empty = grasp_pb2.DetectGraspsStreamRequest(request_id="empty")
    few = request("few", cloud[:5], num_approach_points=6)
    for message in (request("fine", cloud), empty, bad, few, request("again", cloud)):
        await stream.write(message)
    await stream.done_writing()
    answers = [answer async for answer in stream]
    kinds = [answer.WhichOneof("answer") for answer in answers]
    assert kinds == ["detection", *["error"] * 3, "detection"]
    told = {answer.request_id: answer.error for answer in answers[1:4]}
    named = {name: error.detail.field for name, error in told.items()}
    assert named == {"empty": "cloud", "negative": "timeout", "few": "cloud"}
    for error in told.values():
        assert error.code == grpc.StatusCode.INVALID_ARGUMENT.value[0]
        assert error.detail.kind == "invalid-request"
        assert error.message.startswith(error.detail.field)


async def test_a_request_of_a_stream_has_a_deadline_of_its_own(running, cloud) -> None:
    stream = running.stub().DetectGraspsStream()
    await running.hold(stream.write(request("patient", cloud)))
    await stream.write(request("hasty", cloud, timeout=0.05))
    await running.until(lambda: running.ended == ["deadline-exceeded"])
    running.stages.open("evaluate")
    assert (await stream.read()).WhichOneof("answer") == "detection"
    late = await stream.read()
    assert (late.request_id, late.error.detail.kind) == ("hasty", "deadline-exceeded")
    assert running.stages.begun["prepare"] == 1


async def test_no_more_is_read_than_may_be(serve, cloud) -> None:
    running = await serve(max_stream_requests=3)
    stream = running.stub().DetectGraspsStream()
    running.stages.shut("evaluate")
    for number in range(8):
        await stream.write(request(str(number), cloud))
    await stream.done_writing()
    await running.until(lambda: len(running.server.service.admission.calls) == 3)
    await asyncio.sleep(0.1)
    assert len(running.server.service.admission.calls) == 3
    running.stages.open("evaluate")
    assert [answer.request_id async for answer in stream] == [str(number) for number in range(8)]


async def test_what_the_client_does_not_take_is_not_computed(serve, cloud) -> None:
    """A stream that waits for its client reads nothing; gRPC's flow control does the rest."""
    running = await serve(max_stream_requests=2)
    many = {"num_approach_points": 256, "debug": True}
    crowd = np.tile(cloud, (8, 1))  # 4,000 points in each answer
    channel = running.channel(("grpc.http2.lookahead_bytes", 16384))
    stream = grasp_pb2_grpc.GraspServiceStub(channel).DetectGraspsStream()

    async def send() -> None:
        for _ in range(60):
            await stream.write(request("", crowd, **many))
        await stream.done_writing()

    sending = asyncio.create_task(send())
    await running.until(lambda: len(running.calls) >= 3)
    await asyncio.sleep(0.5)
    assert len(running.calls) < 40
    assert len([answer async for answer in stream]) == 60
    await sending


async def test_streams_are_bounded_and_told_that_the_server_is_full(serve, cloud) -> None:
    running = await serve(max_queue_length=0, max_streams=1)
    stream = running.stub().DetectGraspsStream()
    running.stages.shut("evaluate")
    for name in ("taken", "refused"):
        await stream.write(request(name, cloud))
    await running.until(lambda: running.ended == ["overloaded"])
    running.stages.open("evaluate")
    assert (await stream.read()).WhichOneof("answer") == "detection"
    refused = await stream.read()
    assert refused.error.code == grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]
    assert refused.error.detail.retry_after >= 1.0
    await running.until_idle()
    await stream.write(request("first", cloud))
    assert (await stream.read()).request_id == "first"
    assert await running.stub().DetectGraspsStream().code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    await stream.done_writing()
    assert await stream.code() is grpc.StatusCode.OK


async def test_a_stream_whose_client_left_ends(running, cloud) -> None:
    stream = running.stub().DetectGraspsStream()
    running.stages.shut("evaluate")
    for name in ("first", "second"):
        await stream.write(request(name, cloud))
    await running.until(lambda: running.stages.begun["evaluate"] == 1)
    await running.until(lambda: running.waiting == 1)
    stream.cancel()
    await running.until(lambda: running.ended == ["cancelled", "cancelled"])
    running.stages.open("evaluate")
    await running.until_idle()
    assert running.stages.begun["prepare"] == 1


async def test_a_stopping_server_answers_what_it_read_and_ends_the_stream(running, cloud):
    stream, idle = running.stub().DetectGraspsStream(), running.stub().DetectGraspsStream()
    await running.hold(stream.write(request("read", cloud)))
    running.stop.set()
    await running.until(running.server.service.stopping.is_set)
    running.stages.open("evaluate")
    assert (await stream.read()).WhichOneof("answer") == "detection"
    for each in (stream, idle):
        assert await each.code() is grpc.StatusCode.UNAVAILABLE
    await running.serving


async def test_what_came_before_an_unreadable_message_is_answered(running, cloud) -> None:
    stream = running.stub().DetectGraspsStream()
    await running.hold(stream.write(request("read", cloud)))
    stream._request_serializer = lambda message: message.SerializeToString()
    await stream.write(grasp_pb2.ErrorDetail(fix="x"))  # a field that the stream lacks
    await asyncio.sleep(0.2)
    running.stages.open("evaluate")
    assert (await stream.read()).request_id == "read"
    with pytest.raises(grpc.RpcError, match="not a message"):
        await stream.read()
