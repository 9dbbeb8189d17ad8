"""Readiness is honest, and stopping is clean."""

import asyncio
import socket
import subprocess
import sys
import threading

import grpc
import httpx
import numpy as np
import pytest
from grpc import aio
from grpc_health.v1 import health_pb2, health_pb2_grpc

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_service.core import GraspService
from edgegrasp_service.dummy import DummyCatalogue, DummyDetector
from edgegrasp_service.errors import AddressInUse
from edgegrasp_service.server import Server, _listen
from edgegrasp_service.settings import load_settings

SETTINGS = load_settings(http_port=0, grpc_port=0, grace_seconds=5.0)
POINTS = np.zeros((40, 3), np.float32)
Status = health_pb2.HealthCheckResponse


async def http_state(http: httpx.AsyncClient) -> tuple[int, int, int]:
    body = {"points": POINTS.tolist()}
    answers = [
        await http.get("/health/live"),
        await http.get("/health/ready"),
        await http.post("/v1/grasps", json=body),
    ]
    return tuple(answer.status_code for answer in answers)


async def grpc_state(channel: aio.Channel) -> tuple[int, grpc.StatusCode]:
    health = health_pb2_grpc.HealthStub(channel)
    status = (await health.Check(health_pb2.HealthCheckRequest())).status
    stub = grasp_pb2_grpc.GraspServiceStub(channel)
    try:
        await stub.DetectGrasps(grasp_pb2.DetectGraspsRequest(points=POINTS.tobytes()))
    except aio.AioRpcError as error:
        return status, error.code()
    return status, grpc.StatusCode.OK


async def test_not_ready_until_loaded_and_warm() -> None:
    may_load, opened, ready, stop = threading.Event(), *(asyncio.Event() for _ in range(3))

    def load() -> DummyCatalogue:
        may_load.wait(20)
        return DummyCatalogue()

    server = Server(SETTINGS, GraspService(load, SETTINGS))
    serving = asyncio.create_task(server.serve(stop, opened.set, ready.set))
    await opened.wait()
    async with (
        httpx.AsyncClient(base_url=server.http_url) as http,
        aio.insecure_channel(server.grpc_address) as channel,
    ):
        assert await http_state(http) == (200, 503, 503)
        assert await grpc_state(channel) == (Status.NOT_SERVING, grpc.StatusCode.UNAVAILABLE)
        assert (await http.get("/v1/models")).json()["title"] == "Not ready"
        may_load.set()
        await ready.wait()
        assert await http_state(http) == (200, 200, 200)
        assert await grpc_state(channel) == (Status.SERVING, grpc.StatusCode.OK)
    stop.set()
    await serving


async def test_stopping_finishes_what_was_accepted() -> None:
    class Counting(DummyCatalogue):
        accepted = 0

        def get(self, name: str = "") -> DummyDetector:
            Counting.accepted += 1
            return super().get(name)

    ready, stop = asyncio.Event(), asyncio.Event()
    service = GraspService(lambda: Counting(seconds=0.5), SETTINGS)
    server = Server(SETTINGS, service)
    serving = asyncio.create_task(server.serve(stop, ready=ready.set))
    await ready.wait()
    async with (
        httpx.AsyncClient(base_url=server.http_url) as http,
        aio.insecure_channel(server.grpc_address) as channel,
    ):
        by_http = asyncio.create_task(
            http.post("/v1/grasps", json={"points": POINTS.tolist()}, timeout=20)
        )
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        by_grpc = stub.DetectGrasps(grasp_pb2.DetectGraspsRequest(points=POINTS.tobytes()))
        while Counting.accepted < 2:
            await asyncio.sleep(0.01)
        stop.set()
        assert (await by_http).status_code == 200
        assert len((await by_grpc).grasps) == 10
        await serving
        with pytest.raises(httpx.ConnectError):
            await http.get("/health/live")


async def test_weights_that_cannot_be_loaded_end_the_server() -> None:
    def load() -> DummyCatalogue:
        raise InvalidCheckpoint("weights: truncated")

    server = Server(SETTINGS, GraspService(load, SETTINGS))
    with pytest.raises(InvalidCheckpoint, match="truncated"):
        await asyncio.wait_for(server.serve(asyncio.Event()), 20)


@pytest.mark.parametrize("name", ["http_port", "grpc_port"])
async def test_a_taken_port_is_named(name: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        settings = load_settings(**({"http_port": 0, "grpc_port": 0} | {name: port}))
        with pytest.raises(AddressInUse, match=f"127.0.0.1:{port}"):
            await Server(settings).serve(asyncio.Event())


def test_sigterm_exits_with_zero(start_server) -> None:
    with start_server("--backend", "dummy") as server:
        body = {"points": POINTS.tolist()}
        assert httpx.post(f"{server.http_url}/v1/grasps", json=body).status_code == 200
        assert server.stop() == 0


def test_bad_settings_end_with_a_sentence() -> None:
    program = "from edgegrasp_cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "serve", "--http-port", "70000"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("edgegrasp serve: http_port: got 70000.")


def test_answers_are_sent_without_delay() -> None:
    with _listen("127.0.0.1", 0) as listening:
        assert listening.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
