"""Requests that share a forward pass get what they would have got alone."""

import asyncio
import threading

import numpy as np
import pytest

from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import Detection
from edgegrasp_service.batching import BatchPolicy, Choice, Size
from edgegrasp_service.call import Call
from edgegrasp_service.core import DetectRequest, GraspService
from edgegrasp_service.observer import Observer
from edgegrasp_service.sent_cloud import PackedCloud, SentCloud
from edgegrasp_service.settings import Settings


def sizes(*balls: int) -> list[Size]:
    return [Size(number, 100 * number) for number in balls]


@pytest.mark.parametrize(
    ("policy", "waiting", "expected"),
    [
        (BatchPolicy(), sizes(32, 32), Choice(1, True)),  # off: each alone
        (BatchPolicy(100, 10_000), sizes(32), Choice(1, False)),
        (BatchPolicy(100, 10_000), sizes(32, 32, 32), Choice(3, False)),
        (BatchPolicy(100, 10_000), sizes(32, 32, 32, 32), Choice(3, True)),
        (BatchPolicy(96, 10_000), sizes(32, 32, 32, 1), Choice(3, True)),
        (BatchPolicy(100, 6400), sizes(32, 32, 32), Choice(2, True)),  # points
        (BatchPolicy(100, 10_000), sizes(256, 1), Choice(1, True)),  # larger than any batch
        (BatchPolicy(100, 10_000, preferred_balls=(64,)), sizes(32, 32, 32), Choice(2, True)),
        (BatchPolicy(100, 10_000, preferred_balls=(32, 64)), sizes(32, 32), Choice(2, True)),
        (BatchPolicy(100, 10_000, preferred_balls=(50,)), sizes(32, 32), Choice(2, False)),
        (BatchPolicy(100, 10_000, preferred_balls=(64,)), sizes(32, 32, 64), Choice(2, True)),
    ],
)
def test_how_many_share_a_pass(policy: BatchPolicy, waiting: list[Size], expected: Choice) -> None:
    assert policy.choose(waiting) == expected


def test_the_operators_policy() -> None:
    assert BatchPolicy.from_settings(Settings(max_batch_wait_microseconds=10)) == BatchPolicy()
    settings = Settings(
        batching=True,
        max_batch_balls=64,
        max_batch_points=5000,
        max_batch_wait_microseconds=1500,
        preferred_batch_balls=(32,),
    )
    assert BatchPolicy.from_settings(settings) == BatchPolicy(64, 5000, 0.0015, (32,))


async def gather_while_held(running, client, clouds) -> list:
    """Let requests come together while the network is held by another one."""
    running.stages.shut("run")
    first = asyncio.create_task(client.detect(clouds[0]))
    await running.until(lambda: running.stages.begun["run"] == 1)
    asked = [
        asyncio.create_task(client.detect(points, seed=seed)) for seed, points in enumerate(clouds)
    ]
    await running.until(lambda: running.told.stages["prepare"] == 1 + len(clouds))
    running.stages.open("run")
    assert (await first).fine
    return await asyncio.gather(*asked)


def clouds(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.uniform(-0.1, 0.1, (100 + n, 3)).astype(np.float32) for n in range(count)]


async def test_what_waits_shares_a_pass_and_gets_its_own_answer(serve, connect) -> None:
    batched, single = await serve(batching=True), await serve()
    together = await gather_while_held(batched, connect(batched), clouds(5))
    alone = await gather_while_held(single, connect(single), clouds(5))
    assert [(answer.counts, answer.scores) for answer in together] == [
        (answer.counts, answer.scores) for answer in alone
    ]
    assert len({answer.counts["crc32"] for answer in together}) == 5
    assert batched.stages.batches == [1, 5]
    assert single.stages.batches == [1] * 6


async def test_batches_are_bounded_in_balls(serve, connect) -> None:
    running = await serve(batching=True, max_batch_balls=64)
    answers = await gather_while_held(running, connect(running), clouds(5))
    assert all(answer.fine for answer in answers)
    assert running.stages.batches == [1, 2, 2, 1]


async def test_a_batch_waits_for_a_preferred_size(serve, connect) -> None:
    """Ten seconds would pass before the first went alone; the second completes the batch."""
    running = await serve(
        batching=True,
        max_batch_wait_microseconds=10_000_000,
        preferred_batch_balls=(64,),
    )
    client = connect(running)
    first = asyncio.create_task(client.detect(clouds(1)[0]))
    await running.until(lambda: running.told.stages["prepare"] == 1)
    assert running.stages.begun["run"] == 0
    second = asyncio.create_task(client.detect(clouds(2)[1]))
    assert [answer.fine for answer in await asyncio.gather(first, second)] == [True, True]
    assert running.stages.batches == [2]


async def test_a_batch_does_not_wait_longer_than_it_may(serve, connect) -> None:
    running = await serve(batching=True, max_batch_wait_microseconds=1000)
    assert (await connect(running).detect(clouds(1)[0])).fine
    assert running.stages.batches == [1]


class HeldDetector:
    """The shipped detector, whose first forward pass waits."""

    def __init__(self) -> None:
        self.detector = ModelCatalogue.load().get("edgegrasp-plus")
        self.edges: list[int] = []  # candidates of each pass
        self.may_run = threading.Event()

    def get(self, name: str = "") -> "HeldDetector":
        return self

    def warm_up(self) -> None: ...

    def prepare(self, *arguments: object) -> object:
        return self.detector.prepare(*arguments)

    def finish(self, *arguments: object) -> object:
        return self.detector.finish(*arguments)

    def run(self, batch: BallBatch) -> np.ndarray:
        self.edges.append(len(batch.contact))
        assert self.may_run.wait(20)
        return self.detector.run(batch)


def box(size: float) -> np.ndarray:
    """The visible surface of a box that fits the hand, metres."""
    rng = np.random.default_rng(0)
    surface = rng.uniform(-1.0, 1.0, (1500, 3))
    axis = rng.integers(0, 3, 1500)
    surface[np.arange(1500), axis] = np.where(rng.random(1500) < 0.5, -1.0, 1.0)
    surface[axis == 2, 2] = 1.0
    return (surface * (0.02 * size, 0.03, 0.05) + (0, 0, 0.05)).astype(np.float32)


OPTIONS = {"viewpoint": [0.1, 0.2, 0.6], "num_approach_points": 6, "num_candidates": 100}


async def test_the_network_scores_alike_alone_and_together() -> None:
    """The same grasps in the same order, with the same scores to the last bit."""
    held = HeldDetector()
    prepared = threading.Semaphore(0)

    class Told(Observer):
        def stage(self, call: Call, name: str, seconds: float) -> None:
            if name == "prepare":
                prepared.release()

    service = GraspService(lambda: held, Settings(batching=True), Told())
    await service.start()

    async def ask(points: np.ndarray) -> Detection:
        with service.admit(Call("grpc", "DetectGrasps")) as place:
            cloud = SentCloud(PackedCloud(points.tobytes()))
            return await service.detect(lambda: DetectRequest(cloud, OPTIONS), place)

    sent = [box(size) for size in (0.9, 0.8, 1.0, 1.2)]
    asked = [asyncio.create_task(ask(points)) for points in sent]
    for _ in sent:
        assert await asyncio.to_thread(prepared.acquire, timeout=20)
    held.may_run.set()
    together = await asyncio.gather(*asked)
    assert len(held.edges) < len(sent), "none shared a pass"
    alone = [held.detector.detect(points, DetectOptions(**OPTIONS)) for points in sent]
    service.close()
    for ours, theirs in zip(together, alone, strict=True):
        assert len(ours.grasps) == len(theirs.grasps) > 1
        for left, right in zip(ours.grasps, theirs.grasps, strict=True):
            assert left.score == right.score
            np.testing.assert_array_equal(left.T_cloud_hand, right.T_cloud_hand)
        assert ours.counts == theirs.counts
