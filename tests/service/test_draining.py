"""SIGTERM: what was accepted is answered, what comes later is told, and the end is clean."""

import asyncio
import os
import pty
import signal
import subprocess
import sys
import threading
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from grpc import StatusCode, aio
from grpc_health.v1 import health_pb2, health_pb2_grpc

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.core import GraspService
from edgegrasp_service.dummy import DummyCatalogue, DummyDetector
from edgegrasp_service.server import Server
from edgegrasp_service.settings import load_settings

Status = health_pb2.HealthCheckResponse


class Load:
    """Asks over one transport again and again until the server is gone; notes every outcome."""

    def __init__(self, cloud: np.ndarray) -> None:
        self.outcomes: list[str] = []
        self.points = cloud.tobytes()
        self.body = {"points": cloud.tolist()}

    def by_grpc(self, address: str) -> None:
        with grpc.insecure_channel(address) as channel:
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            while self.outcomes[-1:] not in (["UNAVAILABLE"], ["refused"]):
                try:
                    request = grasp_pb2.DetectGraspsRequest(points=self.points)
                    assert len(stub.DetectGrasps(request, timeout=20).grasps) == 10
                    self.outcomes.append("answer")
                except grpc.RpcError as error:
                    self.outcomes.append(error.code().name)

    def by_http(self, url: str) -> None:
        with httpx.Client(base_url=url, timeout=20) as http:
            while self.outcomes[-1:] not in (["503"], ["refused"]):
                try:
                    answer = http.post("/v1/grasps", json=self.body)
                    assert answer.status_code != 200 or len(answer.json()["grasps"]) == 10
                    told = str(answer.status_code)
                    self.outcomes.append("answer" if told == "200" else told)
                except httpx.ConnectError:
                    self.outcomes.append("refused")
                except httpx.TransportError as error:
                    self.outcomes.append(type(error).__name__)


def test_sigterm_under_load(start_server, cloud: np.ndarray) -> None:
    with start_server("--backend", "dummy", "--dummy-seconds", "0.02") as server:
        loads = [Load(cloud) for _ in range(6)]
        calls = [load.by_grpc for load in loads[::2]] + [load.by_http for load in loads[1::2]]
        addresses = [server.grpc_address] * 3 + [server.http_url] * 3
        threads = [
            threading.Thread(target=call, args=(address,))
            for call, address in zip(calls, addresses, strict=True)
        ]
        for thread in threads:
            thread.start()
        while any(load.outcomes.count("answer") < 3 for load in loads):
            threading.Event().wait(0.02)
        assert server.stop() == 0
        for thread in threads:
            thread.join(20)
    for load in loads:
        *answers, last = load.outcomes
        assert set(answers) == {"answer"}, load.outcomes
        assert last in ("503", "UNAVAILABLE", "refused")


SERVE_AT_A_TERMINAL = """
import fcntl, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from edgegrasp_cli.main import main
main()
"""


def test_a_closed_terminal_stops_what_was_started_in_it() -> None:
    terminal, inside = pty.openpty()
    command = [sys.executable, "-c", SERVE_AT_A_TERMINAL, "serve", "--backend", "dummy"]
    process = subprocess.Popen(
        [*command, "--http-port", "0", "--grpc-port", "0"],
        stdin=inside,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    os.close(inside)
    try:
        assert process.stdout is not None
        url = process.stdout.readline().split()[3]
        process.send_signal(signal.SIGHUP)  # with the terminal there: a reload
        with httpx.Client(base_url=url) as http:
            while 'reloads_total{outcome="succeeded"} 1.0' not in http.get("/metrics").text:
                threading.Event().wait(0.05)
        os.close(terminal)
        assert process.wait(timeout=30) == 0
    finally:
        process.kill()
        process.communicate()


async def drained(server: Server, **_: Any) -> None:
    """Wait until new requests are refused."""
    async with httpx.AsyncClient(base_url=server.http_url) as http:
        while (await http.get("/health/ready")).status_code == 200:
            await asyncio.sleep(0.005)


class Held(DummyCatalogue):
    """Detectors that wait until they may go on."""

    def __init__(self) -> None:
        super().__init__()
        self.accepted = asyncio.Event()
        self.may_go_on = threading.Event()
        self._loop = asyncio.get_running_loop()

    def get(self, name: str = "") -> DummyDetector:
        detector = super().get(name)
        held = self

        class Waiting(DummyDetector):
            def finish(self, *given: Any) -> Any:
                held._loop.call_soon_threadsafe(held.accepted.set)
                assert held.may_go_on.wait(20)
                return detector.finish(*given)

        return Waiting()


async def holding(
    catalogue: Held, grace_seconds: float
) -> tuple[Server, asyncio.Event, "asyncio.Task[None]"]:
    """A server that is ready and holds up requests, what stops it, and its end."""
    settings = load_settings(backend="dummy", http_port=0, grpc_port=0, grace_seconds=grace_seconds)
    server = Server(settings, GraspService(lambda: catalogue, settings))
    ready, stop = asyncio.Event(), asyncio.Event()
    catalogue.may_go_on.set()
    serving = asyncio.create_task(server.serve(stop, ready=ready.set))
    await ready.wait()
    catalogue.accepted.clear()
    catalogue.may_go_on.clear()
    return server, stop, serving


@pytest.mark.parametrize("transport", ["grpc", "rest"])
async def test_while_draining_both_transports_say_so(transport: str, cloud: np.ndarray) -> None:
    catalogue = Held()
    server, stop, serving = await holding(catalogue, grace_seconds=20.0)
    async with (
        httpx.AsyncClient(base_url=server.http_url, timeout=20) as http,
        aio.insecure_channel(server.grpc_address) as channel,
    ):
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest())
        assert (await watch.read()).status == Status.SERVING
        request = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
        body = {"points": cloud.tolist()}
        if transport == "grpc":
            accepted: asyncio.Future[Any] = asyncio.ensure_future(stub.DetectGrasps(request))
        else:
            accepted = asyncio.ensure_future(http.post("/v1/grasps", json=body))
        await catalogue.accepted.wait()
        stop.set()
        assert (await watch.read()).status == Status.NOT_SERVING
        await drained(server)
        late = await http.post("/v1/grasps", json=body)
        assert late.status_code == 503
        assert late.headers["connection"] == "close"
        assert (await http.get("/health/live")).status_code == 200
        with pytest.raises(aio.AioRpcError) as caught:
            await stub.DetectGrasps(request)
        assert caught.value.code() == StatusCode.UNAVAILABLE
        assert not accepted.done()
        catalogue.may_go_on.set()
        answer = await accepted
        grasps = answer.grasps if transport == "grpc" else answer.json()["grasps"]
        assert len(grasps) == 10
    await serving


async def test_a_watcher_sees_a_server_become_ready() -> None:
    may_load = threading.Event()

    def load() -> DummyCatalogue:
        assert may_load.wait(20)
        return DummyCatalogue()

    settings = load_settings(http_port=0, grpc_port=0, grace_seconds=0.0)
    server = Server(settings, GraspService(load, settings))
    opened, stop = asyncio.Event(), asyncio.Event()
    serving = asyncio.create_task(server.serve(stop, opened=opened.set))
    await opened.wait()
    async with aio.insecure_channel(server.grpc_address) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        names = ("", "edgegrasp.v1.GraspService")
        requests = [health_pb2.HealthCheckRequest(service=name) for name in names]
        watches = [stub.Watch(request) for request in requests]
        states = [[(await watch.read()).status for watch in watches]]
        may_load.set()
        states.append([(await watch.read()).status for watch in watches])
        stop.set()
        states.append([(await watch.read()).status for watch in watches])
    assert states == [[Status.NOT_SERVING] * 2, [Status.SERVING] * 2, [Status.NOT_SERVING] * 2]
    await serving


@pytest.mark.parametrize("transport", ["grpc", "rest"])
async def test_when_grace_is_over_callers_are_told(transport: str, cloud: np.ndarray) -> None:
    catalogue = Held()
    server, stop, serving = await holding(catalogue, grace_seconds=0.5)
    async with (
        httpx.AsyncClient(base_url=server.http_url, timeout=20) as http,
        aio.insecure_channel(server.grpc_address) as channel,
    ):
        if transport == "rest":
            body = {"points": cloud.tolist()}
            asked = asyncio.ensure_future(http.post("/v1/grasps", json=body))
            await catalogue.accepted.wait()
            stop.set()
            answer = await asked
            assert answer.status_code == 503
            assert answer.json()["type"] == "urn:edgegrasp:error:not-ready"
        else:
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            call = stub.DetectGrasps(grasp_pb2.DetectGraspsRequest(points=cloud.tobytes()))
            waiting = asyncio.ensure_future(call.code())
            await catalogue.accepted.wait()
            stop.set()
            assert await waiting in (StatusCode.UNAVAILABLE, StatusCode.CANCELLED)
    await serving
    catalogue.may_go_on.set()


async def test_idle_connections_do_not_hold_a_stop_up(cloud: np.ndarray) -> None:
    """A watcher of health, an idle stream and a kept connection, with an hour's grace."""
    settings = load_settings(backend="dummy", http_port=0, grpc_port=0, grace_seconds=3600.0)
    server = Server(settings)
    ready, stop = asyncio.Event(), asyncio.Event()
    serving = asyncio.create_task(server.serve(stop, ready=ready.set))
    await ready.wait()
    async with (
        httpx.AsyncClient(base_url=server.http_url) as http,
        aio.insecure_channel(server.grpc_address) as channel,
    ):
        assert (await http.get("/health/live")).status_code == 200
        watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest())
        await watch.read()
        stream = grasp_pb2_grpc.GraspServiceStub(channel).DetectGraspsStream()
        request = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
        await stream.write(grasp_pb2.DetectGraspsStreamRequest(request=request))
        assert len((await stream.read()).detection.grasps) == 10
        stop.set()
        await asyncio.wait_for(serving, 60)
        assert await stream.code() == StatusCode.UNAVAILABLE
