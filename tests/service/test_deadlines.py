"""Nothing is computed in vain for long: deadlines, callers who leave, and the server's limit."""

import asyncio
import itertools
import time

import httpx
import numpy as np
import pytest


async def test_a_request_that_expires_or_is_left_while_it_waits_is_never_computed(
    serve, transport, is_error, cloud
) -> None:
    running = await serve()
    client = running.connect(transport)
    running.stages.shut("evaluate")
    first = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.stages.begun["evaluate"] == 1)
    left = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.waiting == 1)
    left.cancel()
    await running.until(lambda: running.waiting == 0)
    assert is_error(await client.detect(cloud, timeout=0.1), "deadline-exceeded")
    running.stages.open("evaluate")
    assert (await first).fine
    await running.until_idle()
    assert running.stages.begun["prepare"] == 1


async def test_a_worker_that_goes_on_after_the_deadline_is_replaced(
    serve, transport, is_error, cloud
) -> None:
    running = await serve()
    client, before = running.connect(transport), running.server.pool.pids
    running.stages.fail("evaluate", "spin")
    assert is_error(await client.detect(cloud, timeout=0.3), "deadline-exceeded")
    assert (await client.detect(cloud)).fine
    assert running.server.pool.pids != before
    assert "edgegrasp_workers_replaced_total 1.0" in running.metrics()


async def test_the_worker_itself_stops_after_the_deadline(serve, transport, is_error, cloud):
    running = await serve()
    client, before = running.connect(transport), running.server.pool.pids
    running.stages.shut("prepare")
    assert is_error(await client.detect(cloud, timeout=0.2), "deadline-exceeded")
    await asyncio.sleep(0.1)  # the worker received its deadline a little later
    running.stages.open("prepare")
    assert (await client.detect(cloud)).fine
    assert running.stages.begun["evaluate"] == 1
    assert running.server.pool.pids == before


async def test_a_request_whose_client_left_frees_its_worker(serve, transport, cloud) -> None:
    running = await serve()
    client = running.connect(transport)
    running.stages.shut("evaluate")
    asked = asyncio.create_task(client.detect(cloud))
    await running.until(lambda: running.stages.begun["evaluate"] == 1)
    asked.cancel()
    await running.until(lambda: running.ended == ["cancelled"])
    await running.until_idle()  # though the gate is shut
    running.stages.open("evaluate")
    assert (await running.connect("grpc").detect(cloud)).fine


async def test_the_servers_own_limit_holds_without_a_deadline(serve, transport, is_error, cloud):
    running = await serve(max_request_seconds=0.2)
    running.stages.shut("evaluate")
    assert is_error(await running.connect(transport).detect(cloud), "deadline-exceeded")


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "soon", "1_0", "1e999"])
def test_a_timeout_that_is_none_is_refused(dummy_server, text: str) -> None:
    headers = {"X-Request-Timeout": text}
    response = httpx.post(f"{dummy_server.http_url}/v1/grasps", headers=headers, content=b"")
    assert (response.status_code, response.json()["field"]) == (400, "X-Request-Timeout")


HEAD = b"POST /v1/grasps HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
HEAD += b"Content-Length: 1000\r\n"


async def test_a_client_that_vanishes_mid_body_leaves_its_place(serve) -> None:
    running = await serve(max_queue_length=0)
    host, port = running.server.http_url.removeprefix("http://").split(":")
    _, writer = await asyncio.open_connection(host, int(port))
    writer.write(HEAD + b'\r\n{"points": [')
    await writer.drain()
    await running.until(lambda: running.waiting == 1)
    writer.close()
    await running.until(lambda: running.waiting == 0)
    await running.until(lambda: running.ended == ["cancelled"])


async def test_a_body_that_never_ends_is_given_up_at_the_deadline(serve) -> None:
    running = await serve()
    host, port = running.server.http_url.removeprefix("http://").split(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(HEAD + b'X-Request-Timeout: 0.2\r\n\r\n{"points": [')
    assert b" 504 " in await asyncio.wait_for(reader.readline(), 20)
    writer.close()
    await running.until(lambda: running.ended == ["deadline-exceeded"])


async def test_clocks_that_jump(serve, cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall clock goes back a day, and on by thirty years, each time it is read."""
    running = await serve()
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
