"""What nobody waits for is not computed, or abandoned at the next stage."""

import asyncio

import grpc
import httpx
import pytest
from grpc import aio

from edgegrasp.v1 import grasp_pb2
from edgegrasp_service.call import Call
from edgegrasp_service.core import in_time
from edgegrasp_service.errors import Cancelled, DeadlineExceeded


async def test_a_request_that_expires_while_it_waits_is_never_computed(
    serve, connect, is_error, cloud
) -> None:
    running = await serve()
    client = connect(running)
    running.stages.shut("run")
    first = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.stages.begun["run"] == 1)
    late = await client.detect(cloud, timeout=0.1)
    assert is_error(late, "deadline-exceeded")
    assert is_error(await client.score(cloud, timeout=0.1), "deadline-exceeded")
    running.stages.open("run")
    assert (await first).fine
    await running.until_empty()
    assert running.stages.begun["run"] == running.stages.begun["finish"] == 1
    assert running.stages.begun["score"] == 0


async def test_a_request_that_waits_for_its_turn_is_not_even_decoded(
    serve, connect, is_error, cloud
) -> None:
    running = await serve(max_concurrent_requests=1)
    client = connect(running)
    running.stages.shut("run")
    first = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.stages.begun["run"] == 1)
    assert is_error(await client.detect(cloud, timeout=0.1), "deadline-exceeded")
    running.stages.open("run")
    assert (await first).fine
    await running.until_empty()
    assert running.told.stages["decode"] == running.stages.begun["prepare"] == 1


@pytest.mark.parametrize(("stage", "after"), [("prepare", "run"), ("run", "finish")])
async def test_an_expired_request_is_abandoned_at_the_next_stage(
    serve, connect, is_error, cloud, stage: str, after: str
) -> None:
    running = await serve()
    client = connect(running)
    running.stages.shut(stage)
    assert is_error(await client.detect(cloud, timeout=0.3), "deadline-exceeded")
    await running.until(lambda: running.stages.begun[stage] == 1)
    running.stages.open(stage)
    await running.until_empty()
    assert running.stages.begun[after] == 0


@pytest.mark.parametrize(("stage", "after"), [("prepare", "run"), ("run", "finish")])
async def test_a_request_whose_client_left_is_abandoned_at_the_next_stage(
    serve, connect, cloud, stage: str, after: str
) -> None:
    running = await serve()
    client = connect(running)
    running.stages.shut(stage)
    asked = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.stages.begun[stage] == 1)
    asked.cancel()
    await running.until(lambda: running.told.ended == ["cancelled"])
    assert running.told.active == 1  # a thread still works on it
    running.stages.open(stage)
    await running.until_empty()
    assert running.stages.begun[after] == 0
    assert running.told.active == 0


async def test_a_client_that_left_while_it_waited_is_never_computed(serve, connect, cloud) -> None:
    running = await serve(max_concurrent_requests=1)
    client = connect(running)
    running.stages.shut("run")
    first = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.stages.begun["run"] == 1)
    second = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.told.waiting == 1)
    second.cancel()
    await running.until(lambda: running.told.waiting == 0)
    running.stages.open("run")
    assert (await first).fine
    await running.until_empty()
    assert running.stages.begun["prepare"] == 1


async def test_the_servers_own_limit_holds_without_a_deadline(
    serve, connect, is_error, cloud
) -> None:
    running = await serve(max_request_seconds=0.2)
    running.stages.shut("run")
    assert is_error(await connect(running).detect(cloud), "deadline-exceeded")
    running.stages.open("run")


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "soon", ""])
async def test_a_timeout_that_is_none_is_refused(serve, text: str) -> None:
    running = await serve()
    async with httpx.AsyncClient(base_url=running.server.http_url) as http:
        response = await http.post("/v1/grasps", headers={"X-Request-Timeout": text}, content=b"")
    assert (response.status_code, response.json()["field"]) == (400, "X-Request-Timeout")


HEAD = b"POST /v1/grasps HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
HEAD += b"Content-Length: 1000\r\n"


async def test_a_client_that_vanishes_mid_body_leaves_its_place(serve) -> None:
    running = await serve(max_concurrent_requests=1, max_queue_length=0)
    host, port = running.server.http_url.removeprefix("http://").split(":")
    _, writer = await asyncio.open_connection(host, int(port))
    writer.write(HEAD + b'\r\n{"points": [')
    await writer.drain()
    await running.until(lambda: running.told.waiting == 1)
    writer.close()
    await running.until(lambda: running.told.waiting == 0)
    assert running.told.ended == ["cancelled"]


async def test_a_body_that_never_ends_is_given_up_at_the_deadline(serve) -> None:
    running = await serve()
    host, port = running.server.http_url.removeprefix("http://").split(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(HEAD + b'X-Request-Timeout: 0.2\r\n\r\n{"points": [')
    assert b" 504 " in await asyncio.wait_for(reader.readline(), 20)
    writer.close()
    assert running.told.ended == ["deadline-exceeded"]
    await running.until_empty()


async def test_grpc_clients_hear_of_the_servers_deadline_in_words(serve, cloud) -> None:
    running = await serve(max_request_seconds=0.2)
    running.stages.shut("run")
    async with aio.insecure_channel(running.server.grpc_address) as channel:
        call = channel.unary_unary(
            "/edgegrasp.v1.GraspService/DetectGrasps",
            grasp_pb2.DetectGraspsRequest.SerializeToString,
            grasp_pb2.DetectGraspsResponse.FromString,
        )
        with pytest.raises(aio.AioRpcError) as caught:
            await call(grasp_pb2.DetectGraspsRequest(points=cloud.tobytes()))
    assert caught.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    assert caught.value.details() == "The deadline passed before there was an answer."
    running.stages.open("run")


class Clock:
    now = 5.0

    def __call__(self) -> float:
        return self.now


def test_a_call_and_its_deadline() -> None:
    clock = Clock()
    call = Call("grpc", "DetectGrasps", timeout=10.0, clock=clock)
    call.check()
    call.limit(20.0)
    clock.now += 4.0
    assert (call.remaining, call.seconds) == (6.0, 4.0)
    call.limit(5.0)
    assert call.remaining == 1.0
    clock.now += 1.0
    with pytest.raises(DeadlineExceeded):
        call.check()
    call.cancel()
    with pytest.raises(Cancelled):
        call.check()


def test_a_call_without_a_deadline_waits() -> None:
    call = Call("http", "DetectGrasps")
    assert call.remaining is None
    call.check()


@pytest.mark.parametrize("given", ["a b", "", "x" * 129, "käse", "a\nb"])
def test_an_unusable_request_id_is_replaced(given: str) -> None:
    made = Call("http", "DetectGrasps", request_id=given).request_id
    assert made != given
    assert len(made) == 32
    assert Call("http", "DetectGrasps", request_id="arm-1/7").request_id == "arm-1/7"


async def test_what_is_over_before_it_begins_is_not_waited_for() -> None:
    call = Call("http", "DetectGrasps", timeout=0.0)
    with pytest.raises(DeadlineExceeded):
        await in_time(call, asyncio.sleep(20))
    assert call.cancelled
