"""Who is let in: bounds of requests and bytes, fairness between clients, and honest refusals."""

import asyncio

import grpc
import numpy as np
import pytest

from edgegrasp_client import GraspClient
from edgegrasp_service.errors import DeadlineExceeded, Overloaded
from edgegrasp_service.front.service import Admission
from edgegrasp_service.observability import Call

from .conftest import PATIENCE, is_error


class Inside:
    """Requests in an admission, each in a task of its own that stays until it is let go."""

    def __init__(self, admission: Admission) -> None:
        self.admission = admission
        self.tasks: list[asyncio.Task[None]] = []
        self.calls: list[Call] = []
        self._go = asyncio.Event()

    async def enter(
        self, client: str, seconds: float = 1000.0, size: int = 1
    ) -> "asyncio.Task[None]":
        async def stay() -> None:
            call = Call("http", "DetectGrasps", token=client)
            call.deadline = asyncio.get_running_loop().time() + seconds
            async with self.admission.admit(call, size):
                self.calls.append(call)
                await self._go.wait()

        task = asyncio.create_task(stay())
        self.tasks.append(task)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        return task

    async def leave(self) -> None:
        self._go.set()
        await asyncio.gather(*self.tasks, return_exceptions=True)
        assert self.admission.held_bytes == 0


async def test_a_client_alone_may_have_every_place_and_a_large_body_comes_in_alone() -> None:
    inside = Inside(Admission(workers=2, max_waiting=4, max_bytes=100))
    for _ in range(6):
        assert not (await inside.enter("a")).done()
    with pytest.raises(Overloaded, match="it holds 6 requests"):
        await (await inside.enter("a"))
    await inside.leave()
    await inside.admission.wait_until_empty()
    inside = Inside(Admission(workers=2, max_waiting=0, max_bytes=100))
    await inside.enter("a", size=1000)
    await inside.enter("b", size=1)
    assert len(inside.calls) == 1
    await inside.leave()
    assert len(inside.calls) == 2


async def test_who_holds_most_places_gives_one_up_to_another() -> None:
    inside = Inside(Admission(workers=2, max_waiting=4, max_bytes=100))
    greedy = [await inside.enter("a") for _ in range(6)]
    inside.calls[5].at_work = True  # what a worker has is not taken from it
    modest = [await inside.enter("b") for _ in range(3)]
    assert not any(task.done() for task in modest)
    await asyncio.wait(greedy[2:5])
    assert [task.done() for task in greedy] == [False, False, True, True, True, False]
    assert all(isinstance(task.exception(), Overloaded) for task in greedy[2:5])
    with pytest.raises(Overloaded):
        await (await inside.enter("b"))  # half of them each: nobody gives any up
    await inside.leave()


async def test_bytes_are_waited_for_and_one_client_leaves_some_to_others() -> None:
    inside = Inside(Admission(workers=9, max_waiting=0, max_bytes=100))
    await inside.enter("a", size=40)
    await inside.enter("a", size=40)  # more than half of them: it waits
    await inside.enter("b", size=40)
    assert (len(inside.calls), inside.admission.held_bytes) == (2, 80)
    inside.admission.resize(inside.calls[0], 10)
    await inside.enter("c", size=10)
    assert (len(inside.calls), inside.admission.held_bytes) == (4, 100)
    await inside.leave()


async def test_two_clients_leave_room_to_a_third() -> None:
    """Each of them holds half of the places, or of the bytes: nobody holds more than half."""
    inside = Inside(Admission(workers=2, max_waiting=4, max_bytes=100))
    greedy = [await inside.enter(client, size=15) for client in "aaabbb"]
    modest = [await inside.enter("c", size=15) for _ in range(2)]
    await asyncio.wait([greedy[2], greedy[5]])
    assert not any(task.done() for task in modest)
    assert len(inside.calls) == 8
    assert sum(task.done() for task in greedy) == 2
    assert inside.admission.held_bytes <= 100
    await inside.leave()
    inside = Inside(Admission(workers=9, max_waiting=9, max_bytes=100))
    greedy = [await inside.enter(client, size=25) for client in "aabb"]
    await inside.enter("c", size=20)
    await asyncio.wait(greedy, return_when=asyncio.FIRST_COMPLETED)
    assert len(inside.calls) == 5
    assert sum(task.done() for task in greedy) == 1
    await inside.leave()


def test_all_addresses_of_a_network_are_one_client() -> None:
    def client(address: str) -> str:
        return Call("http", "DetectGrasps", peer=address).client

    assert client("2001:db8::1") == client("2001:db8:0:0:ffff::2") != client("2001:db8:0:1::1")
    assert client("::ffff:10.0.0.1") == client("10.0.0.1") != client("10.0.0.2")


async def test_a_deadline_that_cannot_be_met_is_refused() -> None:
    inside = Inside(Admission(workers=2, max_waiting=10, max_bytes=100))
    inside.admission.service_seconds.append(4.0)
    for _ in range(3):
        await inside.enter("a")
    assert not (await inside.enter("b", seconds=5.0)).done()  # nobody knows when bodies arrive
    for call in inside.calls[:3]:
        call.end_stage("read")
    with pytest.raises(Overloaded, match="4 requests come first, which take about 4 s") as caught:
        await (await inside.enter("a", seconds=5.0))
    assert caught.value.retry_after == 4
    assert not (await inside.enter("a", seconds=50.0)).done()
    with pytest.raises(DeadlineExceeded):
        await (await inside.enter("a", seconds=0.0))
    await inside.leave()


async def test_a_deadline_that_may_be_met_is_let_in() -> None:
    for took, requests, seconds in (
        ([1000.0], 1, 0.5),  # an empty server tries any deadline
        ([0.05, 0.05, 18.0, 0.05], 5, 5.0),  # one slow request does not change the pace
    ):
        inside = Inside(Admission(workers=1, max_waiting=10, max_bytes=100))
        inside.admission.service_seconds.extend(took)
        for _ in range(requests):
            assert not (await inside.enter("a", seconds=seconds)).done()
        await inside.leave()


async def test_a_full_server_refuses_at_once(serve, transport, cloud) -> None:
    running = await serve(max_queue_length=1)
    client = running.connect(transport)
    accepted = [await running.hold(client.detect(cloud))]
    accepted.append(asyncio.create_task(client.detect(cloud, seed=1)))
    await running.until(lambda: running.waiting == 1)
    refused = await client.detect(cloud)
    assert is_error(refused, "overloaded")
    assert refused.retry_after is not None
    assert refused.retry_after >= 1
    assert is_error(await client.score(cloud), "overloaded")
    running.stages.open("evaluate")
    assert [answer.fine for answer in await asyncio.gather(*accepted)] == [True, True]
    assert (await client.detect(cloud)).fine


async def test_nobody_is_read_before_there_is_a_place(serve, cloud) -> None:
    running = await serve(max_queue_length=0)
    client = running.connect("grpc")
    accepted = await running.hold(client.detect(cloud), "prepare")
    # As a stream, this client may send its message whenever it likes: never.
    call = client.channel.stream_unary("/edgegrasp.v1.GraspService/DetectGrasps")()
    assert await call.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    said = b"POST /v1/grasps HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\n"
    reader, writer = await running.speak(said)
    head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE)
    assert b" 429 " in head
    assert b"connection: close" in head
    writer.close()
    running.stages.open("prepare")
    assert (await accepted).fine


async def test_turns_come_in_order(running, cloud) -> None:
    client, answered, asked = running.connect("grpc"), [], []
    stages = running.stages
    stages.shut("prepare")
    stages.shut("evaluate")

    async def ask(number: int) -> None:
        assert (await client.detect(cloud)).fine
        answered.append(number)

    for number in range(4):
        asked.append(asyncio.create_task(ask(number)))
        await running.until(lambda number=number: running.waiting == number)
        await running.until(lambda: stages.begun["prepare"] == 1)
    for turn in range(1, 5):  # one at a time gets through
        await running.until(lambda turn=turn: stages.begun["prepare"] == turn)
        stages.open("prepare")
        await running.until(lambda turn=turn: stages.begun["evaluate"] == turn)
        stages.shut("prepare")
        stages.open("evaluate")
        await running.until(lambda turn=turn: len(answered) == turn)
        stages.shut("evaluate")
    await asyncio.gather(*asked)
    assert answered == [0, 1, 2, 3]


async def test_requests_over_a_bound(serve, transport, cloud) -> None:
    client = (await serve(max_points=600, max_body_bytes=100_000)).connect(transport)
    within = {"num_approach_points": 256, "num_candidates": 16_000}
    assert (await client.detect(cloud, **within)).fine
    for option, most in within.items():
        refused = await client.detect(cloud, **{option: most + 1})
        assert is_error(refused, "invalid-request")
        assert refused.field == f"options.{option}"
    refused = await client.detect(np.tile(cloud, (2, 1)))
    assert is_error(refused, "payload-too-large")
    refused = await client.detect(np.tile(cloud, (20, 1)))
    assert is_error(refused, "payload-too-large")
    assert refused.field == "body"


def test_a_cloud_of_1280_by_720(dummy_server, transport: str) -> None:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (720, 1280, 3))
    with GraspClient(dummy_server.address(transport), timeout=60) as client:
        assert client.detect(points).counts["points"] == 1280 * 720


async def test_http_connections_outlive_errors_but_not_refusals(serve, cloud) -> None:
    """Content-Length alone is refused; a client that sends on all the same gets the answer."""
    running = await serve(max_body_bytes=2**20)
    good, large = {"points": cloud.tolist()}, bytes(4 * 2**20)
    streams, statuses = set(), []

    async def chunks():
        for start in range(0, len(large), 2**18):
            yield large[start : start + 2**18]

    http = running.http()
    for posted in (good, {"points": []}, {"nothing": 1}, good):
        response = await http.post("/v1/grasps", json=posted)
        statuses.append(response.status_code)
        streams.add(response.extensions["network_stream"].get_extra_info("client_addr"))
    assert (statuses, len(streams)) == ([200, 400, 400, 200], 1)
    for content in (large, chunks()):
        refused = await http.post("/v1/grasps", content=content)
        assert (refused.status_code, refused.headers["connection"]) == (413, "close")
    assert (await http.post("/v1/grasps", json=good)).status_code == 200
