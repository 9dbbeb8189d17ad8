"""Clients that leave, stall or never read: others do not notice, and the server still stops."""

import contextlib
import queue
import socket
import time
import urllib.parse
from collections.abc import Iterator

import grpc
import httpx
import numpy as np
import pytest

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import GraspClient
from edgegrasp_service.server import KEEP_ALIVE_SECONDS

PLACES = 2
WAITING = 2
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\x00\x00\x00\x04" + bytes(5)  # empty SETTINGS
PATIENCE = 20


@pytest.fixture(scope="module")
def server(start_server):
    """Few places, so that one that is lost is missed."""
    flags = ("--max-concurrent-requests", str(PLACES), "--max-queue-length", str(WAITING))
    with start_server("--backend", "dummy", *flags) as running:
        yield running
        assert running.stop() == 0


@pytest.fixture(params=["grpc", "rest"])
def client(server, request: pytest.FixtureRequest) -> Iterator[GraspClient]:
    with GraspClient(server.address(request.param), timeout=PATIENCE) as one:
        yield one


def connection(address: str) -> socket.socket:
    host, _, port = address.rpartition(":")
    return socket.create_connection((host, int(port)), timeout=PATIENCE)


def http_connection(server) -> socket.socket:
    return connection(urllib.parse.urlsplit(server.http_url).netloc)


def head(length: int) -> bytes:
    lines = ["POST /v1/grasps HTTP/1.1", "Host: x", "Content-Type: application/x-npy"]
    return "\r\n".join([*lines, f"Content-Length: {length}", "", ""]).encode()


def answers(client: GraspClient, cloud: np.ndarray) -> bool:
    """Whether there is an answer before places could be missing for good."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with contextlib.suppress(Exception):
            return len(client.detect(cloud).grasps) > 0
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("reset", [False, True])
def test_clients_that_vanish_mid_body(server, client, cloud: np.ndarray, reset: bool) -> None:
    for _ in range(3 * (PLACES + WAITING)):
        with http_connection(server) as leaving:
            if reset:  # as where a machine is switched off and on: RST, and no FIN
                linger = np.array([1, 0], np.int32).tobytes()
                leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            leaving.sendall(head(100_000) + bytes(5000))
    assert answers(client, cloud)


def test_streams_that_vanish(server, client, cloud: np.ndarray) -> None:
    message = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
    for _ in range(3 * (PLACES + WAITING)):
        with grpc.insecure_channel(server.grpc_address) as channel:
            requests: queue.SimpleQueue = queue.SimpleQueue()
            for number in range(3):
                requests.put(
                    grasp_pb2.DetectGraspsStreamRequest(request_id=str(number), request=message)
                )
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            call = stub.DetectGraspsStream(iter(requests.get, None), timeout=PATIENCE)
            assert next(call).request_id == "0"
        requests.put(None)  # ends the thread that sends
    assert answers(client, cloud)


def half_open_head(server) -> socket.socket:
    stalled = http_connection(server)
    stalled.sendall(head(1000)[:40])
    return stalled


def half_open_body(server) -> socket.socket:
    stalled = http_connection(server)
    stalled.sendall(head(1000) + b"\x93NUMPY")
    return stalled


def half_open_preface(server) -> socket.socket:
    stalled = connection(server.grpc_address)
    stalled.sendall(PREFACE[:10])
    return stalled


def half_open_http2(server) -> socket.socket:
    stalled = connection(server.grpc_address)
    stalled.sendall(PREFACE + b"\x00\x00\x30\x01\x04\x00\x00\x00\x01")  # HEADERS that never come
    return stalled


@pytest.mark.parametrize("open_half", [half_open_head, half_open_preface, half_open_http2])
def test_half_open_connections_take_no_place(server, client, cloud: np.ndarray, open_half) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(3 * (PLACES + WAITING)):
            stack.enter_context(open_half(server))
        assert answers(client, cloud)


def test_a_half_open_body_takes_the_place_that_was_left(server, client, cloud) -> None:
    """Its request has begun; it gives its place back when its client is gone."""
    with half_open_body(server):
        assert answers(client, cloud)
    assert answers(client, cloud)


def test_a_stream_left_open_holds_nobody_up(server, client, cloud: np.ndarray) -> None:
    """It is idle: it neither sends, nor ends, nor reads."""
    message = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
    requests: queue.SimpleQueue = queue.SimpleQueue()
    requests.put(grasp_pb2.DetectGraspsStreamRequest(request_id="a", request=message))
    with grpc.insecure_channel(server.grpc_address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        call = stub.DetectGraspsStream(iter(requests.get, None), timeout=PATIENCE)
        assert next(call).request_id == "a"
        for _ in range(PLACES + WAITING + 1):
            assert answers(client, cloud)
        requests.put(grasp_pb2.DetectGraspsStreamRequest(request_id="b", request=message))
        assert next(call).request_id == "b"
        requests.put(None)
        assert next(call, None) is None


def test_half_open_connections_do_not_keep_a_server_from_stopping(
    start_server, cloud: np.ndarray
) -> None:
    halves = [half_open_head, half_open_body, half_open_preface, half_open_http2]
    with contextlib.ExitStack() as stack:
        running = stack.enter_context(start_server("--backend", "dummy", "--grace-seconds", "1"))
        for open_half in halves * 3:
            stack.enter_context(open_half(running))
        with GraspClient(running.grpc_address) as client:
            assert answers(client, cloud)
        channel = stack.enter_context(grpc.insecure_channel(running.grpc_address))
        requests: queue.SimpleQueue = queue.SimpleQueue()
        call = grasp_pb2_grpc.GraspServiceStub(channel).DetectGraspsStream(
            iter(requests.get, None), timeout=PATIENCE
        )
        assert running.stop() == 0
        with pytest.raises(grpc.RpcError) as caught:
            next(call)
        assert caught.value.code() is grpc.StatusCode.UNAVAILABLE
        requests.put(None)


def test_idle_connections_are_closed_by_clients_first() -> None:
    """Where the server is first, a request may be on its way and never be answered."""
    expiry = httpx.Limits().keepalive_expiry
    assert expiry is not None
    assert expiry < KEEP_ALIVE_SECONDS / 2
