"""A stage that fails, or a worker that dies, ends its own requests only."""

import asyncio
import threading

import numpy as np
import pytest

from edgegrasp_service.batching import BatchPolicy
from edgegrasp_service.call import Call
from edgegrasp_service.dummy import DummyBatch, DummyDetector
from edgegrasp_service.errors import NotReady, WorkerLost
from edgegrasp_service.network_worker import Job, NetworkWorker
from edgegrasp_service.observer import Observer

FAULTS = [
    (ValueError("secret"), "detector-failed"),
    (MemoryError("secret"), "worker-lost"),
    (RuntimeError("DefaultCPUAllocator: can't allocate memory: secret"), "worker-lost"),
    (SystemExit("secret"), "worker-lost"),
]


@pytest.mark.parametrize("stage", ["prepare", "run", "finish"])
@pytest.mark.parametrize(("fault", "kind"), FAULTS, ids=lambda value: type(value).__name__)
async def test_a_stage_that_fails(serve, connect, is_error, cloud, stage, fault, kind) -> None:
    running = await serve()
    client = connect(running)
    running.stages.faults[stage] = [fault]
    assert is_error(await client.detect(cloud), kind)
    assert (await client.detect(cloud)).fine
    assert running.told.ended == [kind, ""]
    dies = stage == "run" and kind == "worker-lost"
    assert running.told.replaced == ([type(fault).__name__] if dies else [])


@pytest.mark.parametrize(("fault", "kind"), FAULTS, ids=lambda value: type(value).__name__)
async def test_scoring_that_fails(serve, connect, is_error, cloud, fault, kind) -> None:
    running = await serve()
    client = connect(running)
    running.stages.faults["score"] = [fault]
    assert is_error(await client.score(cloud), kind)
    assert (await client.score(cloud)).fine


async def test_a_dead_worker_ends_its_own_request_only(serve, connect, is_error, cloud) -> None:
    running = await serve()
    client = connect(running)
    running.stages.shut("run")
    first = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.stages.begun["run"] == 1)
    second = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.told.stages["prepare"] == 2)
    running.stages.faults["run"] = [SystemExit()]
    running.stages.open("run")
    answers = [await first, await second]
    assert sorted(answer.fine for answer in answers) == [False, True]
    failed = next(answer for answer in answers if not answer.fine)
    assert is_error(failed, "worker-lost")


@pytest.mark.parametrize(("fault", "kind"), FAULTS[:3], ids=lambda value: type(value).__name__)
async def test_one_request_does_not_spoil_its_batch(
    serve, connect, is_error, cloud, fault, kind
) -> None:
    """The pass of both fails, then the first one alone; the second one alone is fine."""
    running = await serve(batching=True, max_batch_wait_microseconds=200_000)
    client = connect(running)
    running.stages.shut("run")
    asked = [asyncio.create_task(client.detect(cloud))]
    await running.until(lambda: running.stages.begun["run"] == 1)
    asked += [asyncio.create_task(client.detect(cloud, seed=seed)) for seed in (1, 2)]
    await running.until(lambda: running.told.stages["prepare"] == 3)
    running.stages.faults["run"] = [fault, fault]
    running.stages.open("run")
    answers = await asyncio.gather(*asked)
    assert sorted(answer.fine for answer in answers) == [False, True, True]
    assert is_error(next(answer for answer in answers if not answer.fine), kind)
    assert running.stages.batches == [1, 2, 1, 1]


def batch() -> DummyBatch:
    return DummyBatch(np.zeros((2, 3), np.float32), np.array([0.5, 0.25], np.float32))


def test_a_thread_that_is_gone_is_replaced() -> None:
    """Whatever ends it; here, something that no stage is meant to raise."""

    class Ends(BaseException):
        pass

    told: list[str] = []

    class Told(Observer):
        def worker_replaced(self, reason: str) -> None:
            told.append(reason)

    def end() -> None:
        raise Ends

    worker = NetworkWorker(BatchPolicy(), Told())
    worker.start()
    call = Call("grpc", "DetectGrasps")
    for _ in range(3):
        with pytest.raises(WorkerLost):
            worker.submit(Job(call, work=end)).result(20)
    logits, _ = worker.submit(Job(call, DummyDetector(), batch())).result(20)
    assert logits.tolist() == [0.5, 0.25]
    assert told == ["Ends"] * 3
    worker.close()


def test_what_waits_when_the_worker_closes_hears_of_it() -> None:
    begun, release = threading.Event(), threading.Event()

    def hold() -> str:
        begun.set()
        assert release.wait(20)
        return "done"

    worker = NetworkWorker(BatchPolicy(), Observer())
    worker.start()
    call = Call("grpc", "DetectGrasps")
    running = worker.submit(Job(call, work=hold))
    waiting = worker.submit(Job(call, DummyDetector(), batch()))
    assert begun.wait(20)
    worker.close()
    with pytest.raises(NotReady):
        waiting.result(20)
    with pytest.raises(NotReady):
        worker.submit(Job(call, work=hold))
    release.set()
    assert running.result(20) == "done"
