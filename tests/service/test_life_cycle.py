"""Addresses, honest readiness; SIGTERM: what was accepted is answered, what comes later is told."""

import asyncio
import itertools
import os
import pty
import signal
import socket
import tempfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import numpy as np
import psutil
import pytest
from grpc import StatusCode
from grpc_health.v1 import health_pb2, health_pb2_grpc
from tests.programs import until

from edgegrasp_client import AsyncGraspClient, GraspClient, GraspClientError, StreamRequest
from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import AddressInUse, InvalidSettings
from edgegrasp_service.probe import is_ready

from .conftest import PATIENCE, is_error
from .test_stream import request

Status = health_pb2.HealthCheckResponse


async def states(running: Any, cloud: np.ndarray) -> tuple[Any, ...]:
    """What probes and a request are told: by HTTP, then by gRPC."""
    http, client = running.http(), running.connect("grpc")
    found = [await http.get(path) for path in ("/health/live", "/health/ready")]
    found.append(await http.post("/v1/grasps", json={"points": cloud.tolist()}))
    health = health_pb2_grpc.HealthStub(client.channel)
    status = (await health.Check(health_pb2.HealthCheckRequest())).status
    return *(answer.status_code for answer in found), status, (await client.detect(cloud)).code


async def test_not_ready_until_loaded(begin, cloud) -> None:
    running, ready = await begin(lambda stages: stages.shut("load"))
    stub = health_pb2_grpc.HealthStub(running.channel())
    names = ("", "edgegrasp.v1.GraspService")
    watches = [stub.Watch(health_pb2.HealthCheckRequest(service=name)) for name in names]
    assert [(await watch.read()).status for watch in watches] == [Status.NOT_SERVING] * 2
    assert await states(running, cloud) == (200, 503, 503, Status.NOT_SERVING, "UNAVAILABLE")
    port = int(running.server.http_url.rpartition(":")[2])
    assert not await asyncio.to_thread(is_ready, http_port=port)
    assert (await running.http().get("/v1/models")).json()["title"] == "Not ready"
    assert "edgegrasp_model_info{" not in running.metrics()
    running.stages.open("load")
    await ready.wait()
    assert [(await watch.read()).status for watch in watches] == [Status.SERVING] * 2
    assert await states(running, cloud) == (200, 200, 200, Status.SERVING, "OK")
    assert await asyncio.to_thread(is_ready, "0.0.0.0", str(port))
    running.stop.set()
    assert [(await watch.read()).status for watch in watches] == [Status.NOT_SERVING] * 2


async def test_a_server_ends_as_it_loads_where_it_has_to(begin) -> None:
    """Stopped, without weights that can be loaded, or with a port that is taken."""
    running, _ = await begin(lambda stages: stages.shut("load"))
    running.stop.set()
    await asyncio.wait_for(running.serving, PATIENCE)
    running, _ = await begin(lambda stages: stages.fail("weights", "weights: truncated"))
    with pytest.raises(EdgeGraspError, match="truncated"):
        await asyncio.wait_for(running.serving, PATIENCE)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for name in ("http_port", "grpc_port"):
            running, _ = await begin(**{name: port})
            with pytest.raises(AddressInUse, match=f"127.0.0.1:{port}"):
                await running.serving


async def test_while_draining_both_transports_say_so(running, transport, cloud) -> None:
    client, by_grpc, http = running.connect(transport), running.connect("grpc"), running.http()
    watch = health_pb2_grpc.HealthStub(by_grpc.channel).Watch(health_pb2.HealthCheckRequest())
    assert (await watch.read()).status == Status.SERVING
    assert (await http.get("/health/live")).status_code == 200
    accepted = [await running.hold(client.detect(cloud), "finish")]
    accepted.append(asyncio.create_task(client.detect(cloud)))
    await running.until(lambda: running.waiting == 1)
    running.stop.set()
    assert (await watch.read()).status == Status.NOT_SERVING
    late = await http.post("/v1/grasps", json={"points": cloud.tolist()})
    assert late.status_code == 503
    assert late.headers["connection"] == "close"
    assert (await by_grpc.detect(cloud)).code == "UNAVAILABLE"
    assert not any(task.done() for task in accepted)
    running.stages.open("finish")
    assert [(await task).fine for task in accepted] == [True, True]
    await http.aclose()
    await by_grpc.close()
    await running.serving
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{running.server.http_url}/health/live")


async def test_when_grace_is_over_callers_are_told(serve, transport, cloud) -> None:
    running = await serve(grace_seconds=0.2)
    asked = await running.hold(running.connect(transport).detect(cloud), "finish")
    running.stop.set()
    assert is_error(await asked, "not-ready")
    await asyncio.wait_for(running.serving, PATIENCE)


async def test_idle_connections_do_not_hold_a_stop_up(serve, cloud) -> None:
    """A watcher of health, an idle stream and a kept connection, with an hour's grace."""
    running = await serve(grace_seconds=3600.0)
    assert (await running.http().get("/health/live")).status_code == 200
    health = health_pb2_grpc.HealthStub(running.channel())
    watch = health.Watch(health_pb2.HealthCheckRequest())
    await watch.read()
    stream = running.stub().DetectGraspsStream()
    await stream.write(request("", cloud))
    assert len((await stream.read()).detection.grasps) == 10
    running.stop.set()
    await asyncio.wait_for(running.serving, 60)
    assert await stream.code() == StatusCode.UNAVAILABLE


def call(address: str, cloud: np.ndarray, came: list[str], streams: bool) -> None:
    """Send requests until the server is gone; what came of each."""
    digest = zlib.crc32(cloud.tobytes())
    with GraspClient(address, timeout=PATIENCE, retry=False) as client:
        try:
            while True:
                if streams:
                    requests = itertools.repeat(StreamRequest(cloud), 1000)
                    found = (answer.result() for answer in client.detect_stream(requests))
                else:
                    found = iter([client.detect(cloud)])
                for detection in found:
                    assert detection.counts["crc32"] == digest
                    came.append("OK")
        except GraspClientError as error:
            came.append(type(error).__name__)


def test_sigterm_under_load(start_dummy, cloud: np.ndarray) -> None:
    """Every request that was accepted is answered; the others are told, and the exit code is 0."""
    with ThreadPoolExecutor(9) as threads, start_dummy(seconds=0.02) as server:
        ways = [(server.grpc_address, False), (server.grpc_address, True), (server.http_url, False)]
        came: list[list[str]] = [[] for _ in range(3 * len(ways))]
        calls = [
            threads.submit(call, address, cloud, mine, streams)
            for mine, (address, streams) in zip(came, ways * 3, strict=True)
        ]
        until(lambda: all(len(mine) >= 3 for mine in came))
        assert server.stop() == 0
        for each in calls:
            each.result(PATIENCE)
    for mine in came:
        assert set(mine[:-1]) == {"OK"}
        assert mine[-1] == "ServerUnavailableError"


SERVE_AT_A_TERMINAL = """
import fcntl, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from benchmarks.serve_dummy import main
main()
"""


def test_a_closed_terminal_stops_what_was_started_in_it(start_dummy) -> None:
    terminal, inside = pty.openpty()
    there = {"program": ("-c", SERVE_AT_A_TERMINAL), "stdin": inside, "start_new_session": True}
    with start_dummy(**there) as server, httpx.Client(base_url=server.http_url) as http:
        os.close(inside)
        server.process.send_signal(signal.SIGHUP)  # with the terminal there: a reload
        until(lambda: 'reloads_total{outcome="succeeded"} 1.0' in http.get("/metrics").text)
        os.close(terminal)
        assert server.process.wait(timeout=30) == 0


SERVE_AS_A_CONTAINER_DOES = """
import ctypes
from benchmarks.serve_dummy import main
ctypes.CDLL(None).prctl(36, 1)  # PR_SET_CHILD_SUBREAPER: it gets orphans, as process 1 does
main()
"""


def test_reloads_in_a_container_leave_no_dead_processes(start_dummy) -> None:
    program = "-c", SERVE_AS_A_CONTAINER_DOES
    with start_dummy(program=program) as server, httpx.Client(base_url=server.http_url) as http:
        server.process.send_signal(signal.SIGHUP)
        until(lambda: 'reloads_total{outcome="succeeded"} 1.0' in http.get("/metrics").text)
        front = psutil.Process(server.process.pid)
        until(lambda: psutil.STATUS_ZOMBIE not in [each.status() for each in front.children()])


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="this machine has no IPv6")
async def test_all_addresses_are_those_of_both_protocols(serve, transport: str, cloud) -> None:
    address = (await serve(host="::")).address(transport).replace("[::]", "127.0.0.1")
    async with AsyncGraspClient(address) as client:
        assert len((await client.detect(cloud, timeout=20)).grasps) == 10


async def test_sockets_of_a_folder(serve, transport: str, cloud: np.ndarray) -> None:
    """As a controller on the same machine uses them; the folder's path is short, as it must be."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        for _ in range(2):  # again over the sockets that the first has left
            running = await serve(host=f"unix:{folder}")
            kind, name = ("unix", "grpc") if transport == "grpc" else ("http+unix", "http")
            assert running.address(transport) == f"{kind}:{folder}/{name}.sock"
            async with AsyncGraspClient(running.address(transport)) as client:
                assert len((await client.detect(cloud, timeout=20)).grasps) == 10
            assert await asyncio.to_thread(is_ready, f"unix:{folder}")
            with pytest.raises(AddressInUse, match=r"http\.sock .*in use"):
                await serve(host=f"unix:{folder}")
            running.stop.set()
            await running.serving
    with pytest.raises(AddressInUse, match="choose another folder that exists: --host"):
        await serve(host=f"unix:{folder}")  # gone
    for host in ("unix:", "192.0.2.1", "http://127.0.0.1"):
        with pytest.raises(InvalidSettings, match=f"host: got '{host}'"):
            await serve(host=host)


async def test_a_name_with_several_addresses_has_all_of_them_asked(serve, cloud) -> None:
    servers = [await serve(), await serve()]
    name = "ipv4:" + ",".join(one.server.grpc_address for one in servers)
    async with AsyncGraspClient(name) as client:
        async with asyncio.timeout(20):
            while not all(one.calls for one in servers):
                await client.detect(cloud)
