"""What is over a bound is refused at the door, and says when to come again."""

import asyncio
import io
from collections.abc import Callable
from concurrent.futures import Future

import grpc
import httpx
import numpy as np
import pytest
from grpc import aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.admission import Admission
from edgegrasp_service.call import Call
from edgegrasp_service.errors import Overloaded

HD = np.random.default_rng(0).uniform(-0.3, 0.3, (720, 1280, 3))


async def test_a_full_server_refuses_at_once(serve, connect, is_error, cloud) -> None:
    running = await serve(max_concurrent_requests=1, max_queue_length=1)
    client = connect(running)
    running.stages.shut("run")
    accepted = [asyncio.create_task(client.detect(cloud))]
    await running.until(lambda: running.stages.begun["run"] == 1)
    accepted.append(asyncio.create_task(client.detect(cloud, seed=1)))
    await running.until(lambda: running.told.waiting == 1)
    refused = await client.detect(cloud)
    assert is_error(refused, "overloaded")
    assert refused.retry_after is not None
    assert refused.retry_after >= 1
    assert is_error(await client.score(cloud), "overloaded")
    running.stages.open("run")
    assert [answer.fine for answer in await asyncio.gather(*accepted)] == [True, True]
    assert (await client.detect(cloud)).fine


async def test_http_refuses_before_the_body_comes(serve) -> None:
    running = await serve(max_concurrent_requests=1, max_queue_length=0)
    running.stages.shut("prepare")
    points = {"points": np.zeros((40, 3)).tolist()}
    async with httpx.AsyncClient(base_url=running.server.http_url) as http:
        accepted = asyncio.create_task(http.post("/v1/grasps", json=points))
        await running.until(lambda: running.stages.begun["prepare"] == 1)
        host, port = running.server.http_url.removeprefix("http://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(b"POST /v1/grasps HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\n")
        assert b" 429 " in await asyncio.wait_for(reader.readline(), 20)
        writer.close()
        running.stages.open("prepare")
        assert (await accepted).status_code == 200


async def test_grpc_refuses_before_the_message_comes(serve, cloud) -> None:
    running = await serve(max_concurrent_requests=1, max_queue_length=0)
    running.stages.shut("prepare")
    points = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
    async with aio.insecure_channel(running.server.grpc_address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        accepted = stub.DetectGrasps(points)
        await running.until(lambda: running.stages.begun["prepare"] == 1)
        # As a stream, this client may send its message whenever it likes: never.
        call = channel.stream_unary("/edgegrasp.v1.GraspService/DetectGrasps")()
        assert await call.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        running.stages.open("prepare")
        assert (await accepted).grasps


async def test_turns_come_in_order(serve, connect, cloud) -> None:
    running = await serve(max_concurrent_requests=1)
    client = connect(running)
    running.stages.shut("run")
    answered: list[int] = []

    async def ask(number: int) -> None:
        assert (await client.detect(cloud)).fine
        answered.append(number)

    asked = [asyncio.create_task(ask(0))]
    await running.until(lambda: running.stages.begun["run"] == 1)
    for number in (1, 2, 3):
        asked.append(asyncio.create_task(ask(number)))
        await running.until(lambda number=number: running.told.waiting == number)
    running.stages.open("run")
    await asyncio.gather(*asked)
    assert answered == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("bound", "option"),
    [("max_balls", "num_approach_points"), ("max_candidates", "num_candidates")],
)
async def test_options_over_a_bound(serve, connect, is_error, cloud, bound, option) -> None:
    running = await serve(**{"max_candidates": 2000, "max_balls": 32} | {bound: 33})
    client = connect(running)
    assert (await client.detect(cloud, num_approach_points=32, num_candidates=33)).fine
    refused = await client.detect(
        cloud, **{"num_candidates": 33, "num_approach_points": 32} | {option: 34}
    )
    assert is_error(refused, "payload-too-large")
    assert refused.field == f"options.{option}"


async def test_edges_over_a_bound(serve, connect, is_error, cloud) -> None:
    running = await serve(max_candidates=2)
    refused = await connect(running).score(cloud)
    assert is_error(refused, "payload-too-large")
    assert refused.field == "edges"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_cloud_of_1280_by_720(dtype: type, raw) -> None:
    file = io.BytesIO()
    np.save(file, HD.astype(dtype))
    answer = raw.file("npy", file.getvalue())
    counts = answer.body["counts"] if raw.name == "rest" else answer.body.counts
    assert counts["points"] == 1280 * 720


def test_packed_points_of_1280_by_720(raw_grpc) -> None:
    answer = raw_grpc.request(points=HD.astype("<f4").tobytes())
    assert answer.body.counts["points"] == 1280 * 720


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def running() -> Future[None]:
    """Work that nobody can cancel."""
    work: Future[None] = Future()
    work.set_running_or_notify_cancel()
    return work


def finished() -> Future[None]:
    work = running()
    work.set_result(None)
    return work


async def one_at_a_time(clock: Clock, seconds: float, count: int = 1) -> Admission:
    """An admission that has seen requests of so many seconds."""
    admission = Admission(max_active=2, max_waiting=10, clock=clock)
    for _ in range(count):
        with admission.enter(Call("grpc", "DetectGrasps", clock=clock)) as place:
            await place.begin(finished)
            clock.now += seconds
    return admission


async def test_a_deadline_that_cannot_be_met_is_refused() -> None:
    clock = Clock()
    admission = await one_at_a_time(clock, seconds=2.0)
    entered = [admission.enter(Call("grpc", "DetectGrasps", clock=clock)) for _ in range(3)]
    assert len(entered) == 3
    with pytest.raises(Overloaded, match="3 requests come first, which take about 6 s") as caught:
        admission.enter(Call("grpc", "DetectGrasps", timeout=5.0, clock=clock))
    assert caught.value.retry_after == 6
    admission.enter(Call("grpc", "DetectGrasps", timeout=50.0, clock=clock))


async def test_an_empty_server_tries_any_deadline() -> None:
    clock = Clock()
    admission = await one_at_a_time(clock, seconds=1000.0)
    admission.enter(Call("grpc", "DetectGrasps", timeout=0.1, clock=clock))


async def test_idle_time_is_not_taken_for_work() -> None:
    clock = Clock()
    admission = await one_at_a_time(clock, seconds=1.0)
    clock.now += 3600.0
    with admission.enter(Call("grpc", "DetectGrasps", clock=clock)) as place:
        await place.begin(finished)
        clock.now += 1.0
    admission.enter(Call("grpc", "DetectGrasps", clock=clock))
    admission.enter(Call("grpc", "DetectGrasps", timeout=1.6, clock=clock))


async def test_a_place_given_up_while_it_waits_goes_to_the_next() -> None:
    admission = Admission(max_active=1, max_waiting=10)
    work = running()
    done: list[int] = []

    async def ask(number: int) -> None:
        with admission.enter(Call("grpc", "DetectGrasps")) as place:
            await place.begin(lambda: work)
            done.append(number)

    asked = [asyncio.create_task(ask(number)) for number in range(4)]
    await asyncio.sleep(0)
    asked[1].cancel()
    asked[2].cancel()
    await asyncio.wait(asked[1:3])
    work.set_result(None)
    await asyncio.gather(asked[0], asked[3])
    assert done == [0, 3]
    await admission.empty()


async def test_a_turn_that_comes_as_its_owner_leaves_is_passed_on() -> None:
    admission = Admission(max_active=1, max_waiting=10)
    work, done = running(), []

    async def ask(number: int, begin: Callable[[], Future[None]]) -> None:
        with admission.enter(Call("grpc", "DetectGrasps")) as place:
            await place.begin(begin)
            done.append(number)

    first, second, third = (
        asyncio.create_task(ask(number, begin))
        for number, begin in enumerate((lambda: work, finished, finished))
    )
    await asyncio.sleep(0)
    first.add_done_callback(lambda _: second.cancel())  # just as its turn came
    work.set_result(None)
    await asyncio.gather(first, third)
    assert done == [0, 2]
    await asyncio.wait([second])
    await admission.empty()


async def test_large_bodies_are_refused_in_words_too(serve, cloud) -> None:
    """A client that sends all of its body before it reads gets the answer, and may go on."""
    running = await serve(max_concurrent_requests=1, max_queue_length=0)
    running.stages.shut("prepare")
    small, large = {"points": cloud.tolist()}, HD.astype(np.float32).tobytes() * 2
    url = running.server.http_url
    async with httpx.AsyncClient(base_url=url) as first, httpx.AsyncClient(base_url=url) as http:
        accepted = asyncio.create_task(first.post("/v1/grasps", json=small, timeout=20))
        await running.until(lambda: running.stages.begun["prepare"] == 1)
        refused = await http.post("/v1/grasps", content=large, timeout=20)
        assert refused.status_code == 429
        running.stages.open("prepare")
        assert (await accepted).status_code == 200
        assert (await http.post("/v1/grasps", json=small)).status_code == 200
