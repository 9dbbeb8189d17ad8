"""One stream, many clouds: answers in order, errors among them, and no more read than bounded."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from grpc import aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.grpc_stream import answer_stream


def request(name: str, points: np.ndarray, **options: Any) -> grasp_pb2.DetectGraspsStreamRequest:
    detect = grasp_pb2.DetectGraspsRequest(
        points=points.tobytes(), options=grasp_pb2.DetectOptions(**options)
    )
    return grasp_pb2.DetectGraspsStreamRequest(request_id=name, request=detect)


@pytest.fixture
async def streams() -> AsyncIterator[Any]:
    channels = []

    def open_stream(running: Any) -> Any:
        channels.append(aio.insecure_channel(running.server.grpc_address))
        return grasp_pb2_grpc.GraspServiceStub(channels[-1]).DetectGraspsStream()

    yield open_stream
    for channel in channels:
        await channel.close(None)


async def test_answers_come_in_order_and_are_those_of_single_calls(serve, streams, cloud) -> None:
    running = await serve()
    stream = streams(running)
    for seed in range(9):
        await stream.write(request(f"cloud {seed}", cloud, seed=seed))
    await stream.done_writing()
    answers = [answer async for answer in stream]
    assert [answer.request_id for answer in answers] == [f"cloud {seed}" for seed in range(9)]
    assert await stream.code() is grpc.StatusCode.OK
    async with aio.insecure_channel(running.server.grpc_address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        for seed, answer in enumerate(answers):
            alone = await stub.DetectGrasps(request("", cloud, seed=seed).request)
            assert answer.detection.grasps == alone.grasps
    assert running.told.ended == [""] * 18


async def test_an_answer_comes_before_the_next_request(serve, streams, cloud) -> None:
    stream = streams(await serve())
    for name in ("a", "b", "a"):
        await stream.write(request(name, cloud))
        assert (await stream.read()).request_id == name
    await stream.done_writing()
    assert await stream.read() is aio.EOF


async def test_an_error_is_an_answer_and_the_stream_goes_on(serve, streams, cloud) -> None:
    running = await serve()
    stream = streams(running)
    bad = request("negative", cloud)
    bad.timeout = -1.0
    empty = grasp_pb2.DetectGraspsStreamRequest(request_id="empty")
    few = request("few", cloud[:5])
    for message in (request("fine", cloud), empty, bad, few, request("again", cloud)):
        await stream.write(message)
    await stream.done_writing()
    answers = [answer async for answer in stream]
    assert [answer.WhichOneof("answer") for answer in answers] == [
        "detection",
        "error",
        "error",
        "error",
        "detection",
    ]
    told = {answer.request_id: answer.error for answer in answers[1:4]}
    assert {name: error.detail.field for name, error in told.items()} == {
        "empty": "cloud",
        "negative": "timeout",
        "few": "cloud",
    }
    for error in told.values():
        assert error.code == grpc.StatusCode.INVALID_ARGUMENT.value[0]
        assert error.detail.kind == "invalid-request"
        assert error.message.startswith(error.detail.field)


async def test_a_request_of_a_stream_has_a_deadline_of_its_own(serve, streams, cloud) -> None:
    running = await serve()
    stream = streams(running)
    running.stages.shut("run")
    await stream.write(request("patient", cloud))
    await running.until(lambda: running.stages.begun["run"] == 1)
    hasty = request("hasty", cloud)
    hasty.timeout = 0.05
    await stream.write(hasty)
    await running.until(lambda: running.told.ended == ["deadline-exceeded"])
    running.stages.open("run")
    assert (await stream.read()).WhichOneof("answer") == "detection"
    late = await stream.read()
    assert (late.request_id, late.error.detail.kind) == ("hasty", "deadline-exceeded")
    assert running.stages.begun["run"] == 1


async def test_no_more_is_at_work_than_may_be(serve, streams, cloud) -> None:
    running = await serve(max_stream_requests=3)
    stream = streams(running)
    at_work, most = 0, 0

    def started(call: object) -> None:
        nonlocal at_work, most
        at_work += 1
        most = max(most, at_work)

    def finished(call: object, problem: object) -> None:
        nonlocal at_work
        at_work -= 1

    running.told.started, running.told.finished = started, finished
    running.stages.shut("run")
    for number in range(8):
        await stream.write(request(str(number), cloud))
    await stream.done_writing()
    await running.until(lambda: running.told.stages["prepare"] == 3)
    running.stages.open("run")
    assert [answer.request_id async for answer in stream] == [str(number) for number in range(8)]
    assert (most, at_work) == (3, 0)


async def test_what_the_client_does_not_take_is_not_computed_ahead(serve, cloud) -> None:
    """A stream that waits for its client reads nothing; gRPC's flow control does the rest."""
    running = await serve(max_stream_requests=2)
    read: list[int] = []

    async def requests() -> AsyncIterator[grasp_pb2.DetectGraspsStreamRequest]:
        for number in range(50):
            read.append(number)
            yield request(str(number), cloud)

    answers = answer_stream(running.service, requests())
    assert (await anext(answers)).request_id == "0"
    await running.until(lambda: len(running.told.ended) >= len(read) - 1)  # one may lie ready
    assert len(read) <= 3
    assert [answer.request_id async for answer in answers] == [str(n) for n in range(1, 50)]


async def test_a_full_server_is_told_of_in_the_stream(serve, streams, cloud) -> None:
    running = await serve(max_concurrent_requests=1, max_queue_length=0)
    stream = streams(running)
    running.stages.shut("run")
    for name in ("taken", "refused"):
        await stream.write(request(name, cloud))
    await running.until(lambda: running.told.ended == ["overloaded"])
    running.stages.open("run")
    assert (await stream.read()).WhichOneof("answer") == "detection"
    refused = await stream.read()
    assert refused.error.code == grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]
    assert refused.error.detail.retry_after >= 1.0


async def test_a_stream_whose_client_left_ends(serve, streams, cloud) -> None:
    running = await serve()
    stream = streams(running)
    running.stages.shut("run")
    for name in ("first", "second"):
        await stream.write(request(name, cloud))
    await running.until(lambda: running.told.stages["prepare"] == 2)
    stream.cancel()
    await running.until(lambda: running.told.ended == ["cancelled", "cancelled"])
    running.stages.open("run")
    await running.until_empty()
    assert (running.stages.begun["run"], running.stages.begun["finish"]) == (1, 0)


async def test_a_stopping_server_answers_what_it_read_and_ends_the_stream(
    serve, streams, cloud
) -> None:
    running = await serve()
    stream, idle = streams(running), streams(running)
    running.stages.shut("run")
    await stream.write(request("read", cloud))
    await running.until(lambda: running.stages.begun["run"] == 1)
    running.stop.set()
    await running.until(running.service.stopping.is_set)
    running.stages.open("run")
    assert (await stream.read()).WhichOneof("answer") == "detection"
    for each in (stream, idle):
        assert await each.code() is grpc.StatusCode.UNAVAILABLE
    await running.serving


async def test_http_connections_are_kept_through_answers_and_errors(serve, cloud) -> None:
    running = await serve(max_concurrent_requests=1, max_queue_length=0)
    running.stages.shut("run")
    body = {"points": cloud.tolist()}
    url = running.server.http_url
    async with httpx.AsyncClient(base_url=url) as first, httpx.AsyncClient(base_url=url) as http:
        taken = asyncio.create_task(first.post("/v1/grasps", json=body))
        await running.until(lambda: running.stages.begun["run"] == 1)
        statuses, streams = [(await http.post("/v1/grasps", json=body)).status_code], set()
        running.stages.open("run")
        assert (await taken).status_code == 200
        for posted in (body, {"points": []}, body, {"nothing": 1}, body):
            response = await http.post("/v1/grasps", json=posted)
            statuses.append(response.status_code)
            streams.add(response.extensions["network_stream"].get_extra_info("client_addr"))
    assert statuses == [429, 200, 400, 200, 400, 200]
    assert len(streams) == 1
