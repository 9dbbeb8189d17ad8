"""One thread goes with a request that finds it idle; others go from pool to pool."""

import asyncio
import threading
import time
from collections.abc import AsyncIterator

import numpy as np
import pytest

from edgegrasp_model.results import Detection
from edgegrasp_service.batching import BatchPolicy
from edgegrasp_service.call import Call
from edgegrasp_service.core import DetectRequest, GraspService
from edgegrasp_service.dummy import DummyBatch, DummyCatalogue, DummyDetector
from edgegrasp_service.errors import NotReady, WorkerLost
from edgegrasp_service.network_worker import Job, NetworkWorker
from edgegrasp_service.observer import Observer
from edgegrasp_service.sent_cloud import PackedCloud, SentCloud
from edgegrasp_service.settings import Settings
from edgegrasp_service.stage_pools import Room

CALL = Call("grpc", "DetectGrasps")


class Noted:
    """Hook of the dummy detector: which thread does what, and faults of the network."""

    def __init__(self) -> None:
        self.threads: list[threading.Thread] = []
        self.faults: list[BaseException] = []
        self.may_run = threading.Event()
        self.may_run.set()

    def __call__(self, stage: str, subject: object) -> None:
        self.threads.append(threading.current_thread())
        if stage == "run":
            assert self.may_run.wait(20)
            if self.faults:
                raise self.faults.pop()


@pytest.fixture
def noted() -> Noted:
    return Noted()


@pytest.fixture
async def service(noted: Noted) -> AsyncIterator[GraspService]:
    service = GraspService(lambda: DummyCatalogue(0.0, noted), Settings())
    await service.start()
    yield service
    service.close()


async def ask(service: GraspService, cloud: np.ndarray) -> Detection:
    with service.admit(Call("grpc", "DetectGrasps")) as place:
        sent = SentCloud(PackedCloud(cloud.tobytes()))
        return await service.detect(lambda: DetectRequest(sent), place)


async def test_a_request_alone_keeps_its_thread(service, noted, cloud) -> None:
    for _ in range(3):
        await ask(service, cloud)
    assert len(noted.threads) == 9
    assert {thread.name for thread in noted.threads} == {"companion"}


async def test_a_companion_that_is_lost_is_replaced(service, noted, cloud) -> None:
    noted.faults = [SystemExit()]
    with pytest.raises(WorkerLost):
        await ask(service, cloud)
    await ask(service, cloud)
    before, after = noted.threads[0], noted.threads[-1]
    assert before is not after
    assert after.name == "companion"


async def test_another_request_does_not_wait_for_the_companion(service, noted, cloud) -> None:
    noted.may_run.clear()
    first = asyncio.create_task(ask(service, cloud))
    while len(noted.threads) < 2:  # it is in the network
        await asyncio.sleep(0.002)
    second = asyncio.create_task(ask(service, cloud))
    while len(noted.threads) < 3:
        await asyncio.sleep(0.002)
    assert noted.threads[2].name.startswith("prepare")
    noted.may_run.set()
    await asyncio.gather(first, second)
    assert "network" in {thread.name for thread in noted.threads}


async def test_stages_are_bounded_for_companion_and_pools_together(serve, connect, cloud) -> None:
    running = await serve(prepare_threads=1)
    client = connect(running)
    running.stages.shut("prepare")
    asked = [asyncio.create_task(client.detect(cloud)) for _ in range(2)]
    await running.until(lambda: running.told.stages["decode"] == 2)
    await asyncio.sleep(0.05)
    assert running.stages.begun["prepare"] == 1
    running.stages.open("prepare")
    assert all(answer.fine for answer in await asyncio.gather(*asked))


def test_who_comes_again_waits_behind_who_waited() -> None:
    room, order = Room(1), []

    def wait() -> None:
        with room:
            order.append("waited")

    with room:
        waiting = threading.Thread(target=wait)
        waiting.start()
        while not room._turns:
            time.sleep(0.001)
    with room:
        order.append("came again")
    waiting.join(20)
    assert order == ["waited", "came again"]


def batch() -> DummyBatch:
    return DummyBatch(np.zeros((2, 3), np.float32), np.array([0.5, 0.25], np.float32))


def test_a_job_runs_where_it_is_brought_unless_others_come_first() -> None:
    begun, release, threads = threading.Event(), threading.Event(), []

    def hold() -> None:
        begun.set()
        assert release.wait(20)

    worker = NetworkWorker(BatchPolicy(), Observer())
    worker.start()
    detector = DummyDetector(begin=lambda *_: threads.append(threading.current_thread().name))
    assert worker.here(Job(CALL, detector, batch()))[0].tolist() == [0.5, 0.25]
    running = worker.submit(Job(CALL, work=hold))
    assert begun.wait(20)
    release_soon = threading.Timer(0.05, release.set)
    release_soon.start()
    assert worker.here(Job(CALL, detector, batch()))[0].tolist() == [0.5, 0.25]
    assert running.done()
    assert threads == [threading.current_thread().name, "network"]
    worker.close()
    with pytest.raises(NotReady):
        worker.here(Job(CALL, detector, batch()))


def test_the_networks_thread_waits_while_a_job_runs_elsewhere() -> None:
    order: list[str] = []
    worker = NetworkWorker(BatchPolicy(), Observer())
    worker.start()

    def first() -> None:
        worker.submit(Job(CALL, work=lambda: order.append("second"))).add_done_callback(
            lambda _: done.set()
        )
        done.wait(0.05)
        order.append("first")

    done = threading.Event()
    worker.here(Job(CALL, work=first))
    assert done.wait(20)
    assert order == ["first", "second"]
    worker.close()
