"""Workers that die, spin, eat memory or lose their fork server: one request fails, others go on."""

import asyncio
import itertools
import os
import signal
import time
import zlib
from collections import Counter
from collections.abc import Callable

import numpy as np
import psutil
import pytest

from edgegrasp.v1 import grasp_pb2
from edgegrasp_service.worker.process import Answer, Job

from .conftest import is_error


@pytest.mark.parametrize(
    ("fault", "timeout", "kind"),
    [
        ("kill", None, "worker-lost"),
        ("eat", None, "worker-lost"),
        ("spin", 0.3, "deadline-exceeded"),  # it goes on after the deadline
    ],
)
async def test_a_worker_that_is_lost_fails_its_own_request_only(
    serve, transport, cloud, fault, timeout, kind
) -> None:
    running = await serve(max_worker_bytes=2**28)
    client, before = running.connect(transport), running.server.pool.pids
    running.stages.fail("evaluate", fault)
    assert is_error(await client.detect(cloud, timeout=timeout), kind)
    assert (await client.detect(cloud)).fine
    assert running.server.pool.pids != before
    assert "edgegrasp_workers_replaced_total 1.0" in running.metrics()


async def test_a_request_that_workers_die_of_is_not_tried_again(running, transport, cloud):
    """A crash is enough; a worker that was killed may have been killed for something else."""
    client = running.connect(transport)
    running.stages.fail("evaluate", "crash")
    for _ in range(3):
        assert is_error(await client.detect(cloud), "harmful-request")
    for seed in (1, 1, 1):
        running.stages.fail("evaluate", "kill")
        assert is_error(await client.detect(cloud, seed=seed), "worker-lost")
    assert is_error(await client.detect(cloud, seed=1), "harmful-request")
    assert (await client.detect(cloud, seed=2)).fine
    assert "edgegrasp_workers_replaced_total 4.0" in running.metrics()


async def test_a_request_cancelled_as_it_is_answered_leaves_its_worker_to_the_next(
    running, cloud, monkeypatch
) -> None:
    monkeypatch.setattr("edgegrasp_service.worker.process.KILL_SECONDS", 0.0)
    pool = running.server.pool
    message = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes()).SerializeToString()
    deadline = asyncio.get_running_loop().time() + 60.0

    async def detect(taken: Callable[[], object] = lambda: None) -> Answer:
        worker = await pool.take()
        taken()
        return await worker.run(Job("DetectGrasps", "grpc", message), deadline)

    first = asyncio.create_task(detect())
    second = asyncio.create_task(detect(first.cancel))  # the only worker, before the first goes on
    assert (await second).error is None
    with pytest.raises(asyncio.CancelledError):
        await first


async def test_a_fork_server_that_is_stopped_is_replaced(running, cloud, monkeypatch) -> None:
    monkeypatch.setattr("edgegrasp_service.worker.process.START_SECONDS", 1.0)
    pool, client = running.server.pool, running.connect("rest")
    fork_server = pool._fork_server.pid
    os.kill(fork_server, signal.SIGSTOP)
    os.kill(pool.pids[0], signal.SIGKILL)
    await running.until(lambda: not running.server.service.ready)
    await running.until(lambda: running.server.service.ready)
    assert pool._fork_server.pid != fork_server
    assert (await client.detect(cloud)).fine


async def test_a_worker_that_is_stopped_is_replaced(serve, monkeypatch) -> None:
    for name, seconds in (("HEARTBEAT_SECONDS", 0.2), ("HEARTBEAT_TIMEOUT", 1.0)):
        monkeypatch.setattr(f"edgegrasp_service.worker.process.{name}", seconds)
    running = await serve()
    (before,) = running.server.pool.pids
    os.kill(before, signal.SIGSTOP)
    await running.until(lambda: running.server.pool.pids not in ([], [before]))
    assert running.server.service.ready


async def test_workers_killed_under_load(serve, cloud) -> None:
    """Whatever is killed, each answer is of its own cloud, and nothing is lost."""
    running = await serve(workers=2)
    client, outcomes, stop = running.connect("grpc"), Counter(), asyncio.Event()

    async def ask(number: int) -> None:
        # Another cloud each time, as one that loses two workers is refused.
        for turn in itertools.count():
            if stop.is_set():
                return
            mine = cloud + np.float32(number + turn / 1024)
            answer = await client.detect(mine)
            if answer.fine:
                assert answer.counts["crc32"] == zlib.crc32(mine.tobytes()) % 2**32
            outcomes[answer.kind] += 1

    asking = [asyncio.create_task(ask(number)) for number in range(8)]
    for killed in range(4):
        before = outcomes[""]
        await running.until(lambda before=before: outcomes[""] >= before + 10)
        await running.until(lambda: len(running.server.pool.pids) == 2)
        os.kill(running.server.pool.pids[killed % 2], signal.SIGKILL)
        await running.until(lambda: len(running.server.pool.pids) == 2)
    stop.set()
    await asyncio.gather(*asking)
    assert set(outcomes) <= {"", "worker-lost"}
    assert outcomes["worker-lost"] <= 4


async def test_a_fork_server_that_dies_is_replaced(running, cloud) -> None:
    client, pool = running.connect("rest"), running.server.pool
    pool._fork_server._process.kill()
    assert (await client.detect(cloud)).fine
    await running.until(lambda: running.stages.begun["load"] == 2)
    await running.until(lambda: pool.models[0]["digest"] == "2")
    (before,) = pool.pids
    os.kill(before, signal.SIGKILL)
    await running.until(lambda: pool.pids not in ([], [before]))
    assert (await client.detect(cloud)).fine


async def test_workers_end_with_the_server(serve) -> None:
    running = await serve(workers=2)
    pids = running.server.pool.pids
    assert len(set(pids)) == 2
    running.stop.set()
    await running.serving
    await running.until(lambda: not any(map(psutil.pid_exists, pids)))


async def test_a_request_that_expires_or_is_left_while_it_waits_is_never_computed(
    running, transport, cloud
) -> None:
    client = running.connect(transport)
    first = await running.hold(client.detect(cloud))
    left = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.waiting == 1)
    left.cancel()
    await running.until(lambda: running.waiting == 0)
    assert is_error(await client.detect(cloud, timeout=0.1), "deadline-exceeded")
    running.stages.open("evaluate")
    assert (await first).fine
    await running.until_idle()
    assert running.stages.begun["prepare"] == 1


async def test_the_worker_itself_stops_after_the_deadline(running, transport, cloud):
    client, before = running.connect(transport), running.server.pool.pids
    running.stages.shut("prepare")
    assert is_error(await client.detect(cloud, timeout=0.2), "deadline-exceeded")
    await asyncio.sleep(0.1)  # the worker received its deadline a little later
    running.stages.open("prepare")
    assert (await client.detect(cloud)).fine
    assert running.stages.begun["evaluate"] == 1
    assert running.server.pool.pids == before


async def test_a_request_whose_client_left_frees_its_worker(running, transport, cloud) -> None:
    asked = await running.hold(running.connect(transport).detect(cloud))
    asked.cancel()
    await running.until(lambda: running.ended == ["cancelled"])
    await running.until_idle()  # though the gate is shut
    running.stages.open("evaluate")
    assert (await running.connect("grpc").detect(cloud)).fine


async def test_the_servers_own_limit_holds_without_a_deadline(serve, transport, cloud):
    running = await serve(max_request_seconds=0.2)
    running.stages.shut("evaluate")
    assert is_error(await running.connect(transport).detect(cloud), "deadline-exceeded")


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "soon", "1_0", "1e999"])
def test_a_timeout_that_is_none_is_refused(http, text: str) -> None:
    response = http.post("/v1/grasps", headers={"X-Request-Timeout": text}, content=b"")
    assert (response.status_code, response.json()["field"]) == (400, "X-Request-Timeout")


HEAD = b"POST /v1/grasps HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
HEAD += b"Content-Length: 1000\r\n"


async def test_a_client_that_vanishes_mid_body_or_never_ends_it_leaves_its_place(serve) -> None:
    running = await serve(max_queue_length=0)
    _, writer = await running.speak(HEAD + b'\r\n{"points": [')
    await writer.drain()
    await running.until(lambda: running.waiting == 1)
    writer.close()
    await running.until(lambda: running.waiting == 0)
    await running.until(lambda: running.ended == ["cancelled"])
    reader, writer = await running.speak(HEAD + b'X-Request-Timeout: 0.2\r\n\r\n{"points": [')
    assert b" 504 " in await asyncio.wait_for(reader.readline(), 20)
    writer.close()
    await running.until(lambda: running.ended == ["cancelled", "deadline-exceeded"])


async def test_clocks_that_jump(running, cloud, monkeypatch) -> None:
    """The wall clock goes back a day, and on by thirty years, each time it is read."""
    real, jumps = time.time, itertools.cycle([-86400.0, 3600.0, 1e9, -1e9])
    monkeypatch.setattr(time, "time", lambda: real() + next(jumps))
    monkeypatch.setattr(time, "time_ns", lambda: int(time.time() * 1e9))
    for transport in ("grpc", "rest"):
        client = running.connect(transport)
        for _ in range(5):
            # Without a deadline: gRPC works one out from two clocks, of which one jumps here.
            assert (await client.detect(cloud)).fine
    await running.until(lambda: len(running.calls) == 10)
    for call in running.calls:
        assert all(0.0 <= seconds < 20.0 for seconds in (call.seconds, *call.stages.values()))
