"""What strangers may throw at a server: it stays alive, small and ready for the next good request.

Each attack here froze, filled or shut a server that had no bounds.
"""

import asyncio
import contextlib
import json
import os
import resource
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import httpx
import numpy as np
import psutil
import pytest
from benchmarks.soak import CHECK, STREAM, connect, http2_frame, http2_headers, http2_opening
from grpc import aio
from grpc_health.v1 import health_pb2, health_pb2_grpc
from tests.cloud_files import npy
from tests.programs import ROOT, run, until

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client import DeadlineError, GraspClient, InvalidRequestError
from edgegrasp_service.front.http import MAX_PAGES_AT_ONCE
from edgegrasp_service.server import HEALTH_PLACES

from .conftest import PATIENCE
from .test_stream import request

MIB = 2**20
HEAD = "POST /v1/grasps HTTP/1.1\r\nHost: x\r\nContent-Type: application/x-npy\r\n"
PAGE = b"GET /docs/assets/swagger-ui-bundle.js HTTP/1.1\r\nHost: x\r\n\r\n"
OWN_CONNECTION = (("grpc.use_local_subchannel_pool", 1),)


@contextlib.contextmanager
def in_background(attack: Callable[[], None], count: int) -> Iterator[None]:
    """Threads that attack again and again, all of them once before the block, until it ends."""
    stop, begun = threading.Event(), threading.Barrier(count + 1)

    def work() -> None:
        begun.wait(PATIENCE)
        while not stop.is_set():
            with contextlib.suppress(OSError, httpx.HTTPError):
                attack()

    threads = [threading.Thread(target=work) for _ in range(count)]
    for thread in threads:
        thread.start()
    begun.wait(PATIENCE)
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(PATIENCE)


def check_alive(server, cloud: np.ndarray) -> None:
    """Liveness is answered again and again, and a good request in the end."""
    with httpx.Client(base_url=server.http_url, timeout=PATIENCE) as http:
        for _ in range(50):
            assert http.get("/health/live").status_code == 200
    with GraspClient(server.grpc_address, timeout=PATIENCE) as client:
        assert len(client.detect(cloud).grasps) == 10


async def check_health(address: str) -> None:
    """Over gRPC, on another connection than that of the attack."""
    async with aio.insecure_channel(address, OWN_CONNECTION) as channel:
        check = health_pb2_grpc.HealthStub(channel).Check
        answer = await check(health_pb2.HealthCheckRequest(), timeout=PATIENCE)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING


@contextlib.contextmanager
def connections(address: str, count: int, said: bytes = b"") -> Iterator[list[socket.socket]]:
    """So many, on each of which this has been sent."""
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(connect(address)) for _ in range(count)]
        for connection in held if said else ():
            connection.sendall(said)
        yield held


def is_ended(connection: socket.socket) -> bool:
    """Whether the other side has closed it."""
    connection.setblocking(False)
    with contextlib.suppress(ConnectionResetError):
        try:
            while connection.recv(2**16):
                pass
        except BlockingIOError:
            return False
    return True


async def test_messages_that_never_end(serve, cloud) -> None:
    """60 gRPC messages of 31 MB, of which the end never comes, on one connection."""
    running = await serve(max_held_bytes=64 * MIB)
    before = psutil.Process().memory_info().rss
    with contextlib.closing(Http2(running.server.grpc_address)) as connection:
        for stream in range(60):
            connection.begin("/edgegrasp.v1.GraspService/DetectGrasps", 2 * stream + 1)
        for stream in range(20):
            connection.begin("/grpc.health.v1.Health/Check", 121 + 2 * stream)
        sending = threading.Thread(target=connection.send_all, args=(31 * MIB,))
        sending.start()
        await running.until(lambda: connection.sent > 50 * MIB)  # or there is no attack
        http = running.http()
        for _ in range(30):
            assert (await http.get("/health/live")).status_code == 200
        assert psutil.Process().memory_info().rss - before < 500 * MIB
        connection.stop.set()
        await asyncio.to_thread(sending.join, PATIENCE)
    await running.until_idle()
    assert (await running.connect("grpc").detect(cloud)).fine


class Http2:
    """As much of an HTTP/2 client as begins messages and does not end them."""

    def __init__(self, address: str) -> None:
        self._socket = connect(address)
        self._socket.sendall(http2_opening())
        self._windows: dict[int, int] = {0: 65535}
        self._initial = 65535
        self.sent = 0
        self.stop = threading.Event()

    def begin(self, path: str, stream: int) -> None:
        self._socket.sendall(http2_headers(path, stream))
        self._windows[stream] = 65535

    def send_all(self, size: int) -> None:
        """Send every message but its last byte, as far as the server lets it."""
        left = {stream: size for stream in self._windows if stream}
        buffer = b""
        with contextlib.suppress(OSError):
            while not self.stop.is_set():
                moved = False
                for stream, rest in list(left.items()):
                    room = min(self._windows[0], self._windows[stream], 16384, rest - 1)
                    if room <= 5:
                        continue
                    first = b"\x00" + struct.pack(">I", size) if rest == size else b""
                    payload = first + bytes(room - len(first))
                    self._socket.sendall(http2_frame(0, 0, stream, payload))
                    left[stream] -= room
                    self.sent += room
                    self._windows[0] -= room
                    self._windows[stream] -= room
                    moved = True
                self._socket.settimeout(0.0 if moved else 0.02)
                with contextlib.suppress(BlockingIOError, TimeoutError):
                    buffer = self._take(buffer + self._socket.recv(2**16), left)
                self._socket.settimeout(PATIENCE)

    def _take(self, buffer: bytes, left: dict[int, int]) -> bytes:
        """Heed the whole frames in what was received; returns the rest."""
        while len(buffer) >= 9 and len(buffer) >= (end := 9 + int.from_bytes(buffer[:3], "big")):
            kind, flags, stream = struct.unpack(">3xBBI", buffer[:9])
            payload, buffer = buffer[9:end], buffer[end:]
            if kind == 8 and stream in self._windows:
                self._windows[stream] += int.from_bytes(payload, "big")
            elif kind == 3:
                left.pop(stream, None)
            elif kind == 4 and not flags & 1:
                for name, value in struct.iter_unpack(">HI", payload):
                    if name == 4:
                        for each in self._windows:
                            self._windows[each] += (value - self._initial) * (each != 0)
                        self._initial = value
                self._socket.sendall(http2_frame(4, 1, 0, b""))
            elif kind == 6 and not flags & 1:
                self._socket.sendall(http2_frame(6, 1, 0, payload))
        return buffer

    def close(self) -> None:
        self._socket.close()


@pytest.mark.parametrize("path", ["/v1/grasps", "/v1/models:reload"])
def test_bodies_in_crumbs(dummy_server, cloud, path: str) -> None:
    """Bodies in chunks of one byte, also after a refusal."""
    head = HEAD.replace("/v1/grasps", path) + "Transfer-Encoding: chunked\r\n\r\n"

    def attack() -> None:
        with connect(dummy_server.http_url) as connection:
            connection.sendall(head.encode())
            for _ in range(20):
                connection.sendall(b"1\r\nX\r\n" * 40_000)

    with in_background(attack, 4):
        check_alive(dummy_server, cloud)


def test_a_form_of_nothing_but_boundaries(dummy_server, cloud) -> None:
    body = b"\r\n--X" * 2_000_000
    headers = {"content-type": "multipart/form-data; boundary=X", "X-Request-Timeout": "5"}
    codes = set()

    def attack() -> None:
        url = f"{dummy_server.http_url}/v1/grasps"
        codes.add(httpx.post(url, content=body, headers=headers, timeout=PATIENCE).status_code)

    with in_background(attack, 2):
        check_alive(dummy_server, cloud)
    assert set() < codes <= {400, 429, 504}


async def test_bodies_that_trickle_give_their_places_back(serve, cloud, transport: str) -> None:
    """A body of one byte now and then, in every place."""
    running = await serve(max_queue_length=3, read_seconds=1.0)
    held, writers = [], []
    channel = running.channel()
    for _ in range(4):
        if transport == "grpc":
            call = channel.stream_unary("/edgegrasp.v1.GraspService/DetectGrasps")()
            held.append(asyncio.ensure_future(call.code()))
        else:
            body = b"Content-Length: 1000000\r\n\r\nX"
            reader, writer = await running.speak(HEAD.encode() + body)
            held.append(asyncio.ensure_future(reader.readexactly(12)))
            writers.append(writer)
    await running.until(lambda: running.waiting == 4)
    client = running.connect(transport)
    assert (await client.detect(cloud)).kind == "overloaded"
    told = [await asyncio.wait_for(each, PATIENCE) for each in held]
    slow = grpc.StatusCode.DEADLINE_EXCEEDED if transport == "grpc" else b"HTTP/1.1 408"
    assert told == [slow] * 4
    assert (await client.detect(cloud)).fine
    for writer in writers:
        writer.close()


async def test_answers_that_nobody_takes_are_given_up(serve, transport: str, caplog) -> None:
    """Clients that send and never read."""
    running = await serve(write_seconds=0.5, min_bytes_per_second=10**9)
    crowd = np.random.default_rng(0).uniform(-0.1, 0.1, (300_000, 3)).astype("<f4")
    if transport == "rest":
        held, body = connect(running.server.http_url), npy(crowd)
        head = HEAD.replace(" HTTP", "?debug=true HTTP") + f"Content-Length: {len(body)}\r\n\r\n"
        await asyncio.to_thread(held.sendall, head.encode() + body)
    else:
        channel = running.channel(("grpc.http2.bdp_probe", 0))
        held = channel.stream_stream("/edgegrasp.v1.GraspService/DetectGrasps")()
        debug = grasp_pb2.DetectOptions(debug=True)  # the whole cloud comes back
        message = grasp_pb2.DetectGraspsRequest(points=crowd.tobytes(), options=debug)
        await held.write(message.SerializeToString())
    admission = running.server.service.admission
    await running.until(lambda: admission.held_bytes > 5 * 10**6)  # unsent, and counted
    await running.until_idle()
    assert admission.held_bytes == 0
    await running.until(lambda: running.server.service.in_flight == 0)
    if transport == "grpc":  # gRPC holds the answer until then
        assert await asyncio.wait_for(held.code(), PATIENCE) is not grpc.StatusCode.OK
        held.cancel()
    else:
        held.close()
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


async def test_connections_beyond_the_bound_end_the_oldest_idle_ones(serve) -> None:
    """Of HTTP: silent ones, and ones that ask for a page and read nothing."""
    running = await serve(max_connections=3)
    with connections(running.server.http_url, 3 * (3 + HEALTH_PLACES)) as held:
        for connection in held[3:]:
            connection.sendall(PAGE)
        for connection in held[: 2 * (3 + HEALTH_PLACES)]:  # they were ended, some of them reset
            with contextlib.suppress(ConnectionResetError):
                while await asyncio.to_thread(connection.recv, 2**20):
                    pass
        assert (await running.http().get("/health/live")).status_code == 200


async def test_health_is_answered_while_every_connection_has_a_request(serve, cloud) -> None:
    running = await serve(max_connections=2, workers=1)
    running.stages.shut("evaluate")
    http, kind = running.http(), {"content-type": "application/x-npy"}

    def ask() -> asyncio.Task[httpx.Response]:
        return asyncio.create_task(http.post("/v1/grasps", content=npy(cloud), headers=kind))

    held = [ask(), ask()]
    await running.until(lambda: len(running.server.service.admission.calls) == 2)
    refused = await ask()
    assert refused.status_code == 429
    assert refused.headers["x-request-id"]
    counted = 'requests_total{code="429",method="other",transport="http"} 1.0'
    assert counted in (await http.get("/metrics")).text
    for path in ("/health/live", "/health/ready"):
        assert (await http.get(path)).status_code == 200
    running.stages.open("evaluate")
    assert [(await one).status_code for one in held] == [200, 200]


async def test_silent_grpc_connections_are_closed_for_others(serve, cloud) -> None:
    """None of those others is refused before that, nor if descriptors were short for a while."""
    running = await serve(max_connections=30)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    await asyncio.sleep(0.3)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    with connections(running.server.grpc_address, 90, http2_opening()) as held:
        await check_health(running.server.grpc_address)
        assert (await running.connect("grpc").detect(cloud)).fine
        await running.until(lambda: sum(map(is_ended, held)) >= 60)


async def test_a_health_check_waits_for_no_other_calls(serve) -> None:
    running = await serve(max_streams=100)
    order, observe = [], running.server.service.observe
    running.server.service.observe = lambda call: order.append(call.method) or observe(call)
    with contextlib.closing(Http2(running.server.grpc_address)) as connection:
        for number in range(90):
            connection.begin(CHECK if number == 60 else STREAM, 2 * number + 1)
        time.sleep(0.5)  # all of them arrive before this event loop looks
        await running.until(lambda: len(order) == 90)
    assert order.index("HealthCheck") < 10


async def test_answers_of_pages_are_given_up_too(serve) -> None:
    running = await serve(write_seconds=0.3, min_bytes_per_second=10**9)
    with connections(running.server.http_url, 1, PAGE):
        await running.until(lambda: running.server.service.in_flight == 1)
        await running.until(lambda: running.server.service.in_flight == 0)


async def test_pages_that_nobody_reads_keep_no_place_from_another_client(running) -> None:
    with connections(running.server.http_url, 2 * MAX_PAGES_AT_ONCE, PAGE):
        await running.until(lambda: running.server.service.in_flight >= MAX_PAGES_AT_ONCE)
        for path in ("/health/ready", "/openapi.json"):
            assert (await running.http().get(path)).status_code == 200


async def test_silent_health_checks_and_watchers_hold_up_nobody(running) -> None:
    """Hundreds of streams of one connection that ask nothing, or ask for ever."""
    check = running.channel().stream_unary("/grpc.health.v1.Health/Check")
    silent = [check() for _ in range(400)]
    stub = health_pb2_grpc.HealthStub(running.channel(*OWN_CONNECTION))
    watching = [stub.Watch(health_pb2.HealthCheckRequest()) for _ in range(80)]
    await running.until(lambda: running.server.service.in_flight > 60)
    # They are no load that another machine would share.
    assert "edgegrasp_requests_in_flight 0.0" in (await running.http().get("/metrics")).text
    for _ in range(5):
        await check_health(running.server.grpc_address)
    for call in (*silent, *watching):
        call.cancel()


async def test_errors_in_a_stream_that_is_left_open_hold_up_nobody(running, cloud) -> None:
    call = running.channel().stream_stream("/edgegrasp.v1.GraspService/DetectGraspsStream")()
    await call.write(b"\x08\x01" * 10**7)  # very many fields
    assert await call.code() is grpc.StatusCode.INVALID_ARGUMENT
    stream = running.stub().DetectGraspsStream()
    for _ in range(2):
        await stream.write(request("", cloud[:0]))
        assert (await stream.read()).error.detail.kind == "invalid-request"
    await check_health(running.server.grpc_address)
    assert (await running.http().get("/health/live")).status_code == 200
    assert (await running.connect("rest").detect(cloud)).fine
    stream.cancel()


async def test_silent_streams_give_their_places_to_others(serve, cloud, monkeypatch) -> None:
    monkeypatch.setattr("edgegrasp_service.front.grpc.STREAM_GRACE_SECONDS", 0.0)
    running = await serve(max_streams=2)
    stub = running.stub()
    silent = [stub.DetectGraspsStream() for _ in range(4)]
    ended = [asyncio.ensure_future(call.code()) for call in silent]
    await running.until(lambda: sum(code.done() for code in ended) == 2)
    assert {code.result() for code in ended if code.done()} == {grpc.StatusCode.RESOURCE_EXHAUSTED}
    mine = stub.DetectGraspsStream()
    await mine.write(request("", cloud))
    assert (await mine.read()).detection.grasps
    for call in (*silent, mine):
        call.cancel()
    await asyncio.wait(ended)


OUT_OF_DESCRIPTORS = """
import resource, sys
from benchmarks.serve_dummy import main
resource.setrlimit(resource.RLIMIT_NOFILE, (96, 96))
main()
"""


def test_without_file_descriptors_left_the_log_stays_short(start_dummy, tmp_path, cloud) -> None:
    file, program = tmp_path / "log", ("-c", OUT_OF_DESCRIPTORS)
    with file.open("w") as log, start_dummy("--workers=1", program=program, stderr=log) as server:
        with connections(server.http_url, 150):
            until(lambda: "Too many open files" in file.read_text())
        check_alive(server, cloud)
        assert server.stop() == 0
    lines = file.read_text().splitlines()
    assert len(lines) < 20
    assert not any("Traceback" in line for line in lines)


def test_a_cloud_far_too_dense(real_server, cloud) -> None:
    """2 M points in a cube of 1 m, all of them objects, are within every limit and take minutes."""
    dense = np.random.default_rng(0).random((2_000_000, 3), np.float32)

    def attack() -> None:
        # More voxels than can be done in time, or a slow machine does not come to count them.
        refused = pytest.raises((InvalidRequestError, DeadlineError))
        with GraspClient(real_server.grpc_address, timeout=2.0) as client, refused:
            client.detect(dense, objects="off", support="none")

    with ThreadPoolExecutor() as threads:
        for each in [threads.submit(attack) for _ in range(2)]:
            each.result(PATIENCE)
    with GraspClient(real_server.http_url, timeout=PATIENCE) as client:
        client.detect(cloud, num_approach_points=2, num_candidates=20)


async def test_large_and_many_metadata_and_compressed_messages_are_refused(serve, cloud) -> None:
    stub = (await serve(max_header_bytes=16_384)).stub()
    request = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
    for metadata in ((("x-large", "a" * 40_000),), tuple((f"x-{n}", "y") for n in range(100))):
        call = stub.DetectGrasps(request, metadata=metadata)
        assert await call.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    trailers = dict(await call.trailing_metadata())
    detail = grasp_pb2.ErrorDetail.FromString(trailers["edgegrasp-error-bin"])
    assert (detail.kind, detail.field) == ("headers-too-large", "metadata")
    assert len((await stub.DetectGrasps(request)).grasps) == 10
    long = grasp_pb2.DetectGraspsRequest(points=bytes(12 * 100_000))
    packed = stub.DetectGrasps(long, compression=grpc.Compression.Gzip)
    assert await packed.code() is grpc.StatusCode.UNIMPLEMENTED


async def test_a_message_far_over_the_limit_is_refused_as_such(serve) -> None:
    """Without a deadline too, which clients in other languages leave out."""
    call = (await serve(max_body_bytes=1024)).stub().DetectGrasps
    reply = call(grasp_pb2.DetectGraspsRequest(points=bytes(3 * 2**20)))
    assert await reply.code() is grpc.StatusCode.RESOURCE_EXHAUSTED


def test_grpc_connections_that_were_left_are_closed(start_dummy) -> None:
    with start_dummy() as server:
        process = psutil.Process(server.process.pid)
        before = process.num_fds()
        for _ in range(300):
            with connect(server.grpc_address) as connection:
                connection.sendall(http2_opening())
                connection.recv(1024)
                connection.sendall(http2_frame(4, 1, 0, b""))
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        until(lambda: process.num_fds() < before + 10)


def test_a_short_soak(tmp_path: Path) -> None:
    """Beside attacks each request comes to something, none to another's; health is answered."""
    command = [sys.executable, "-m", "benchmarks.soak", "--minutes", "0.05", "--clients", "3"]
    patience = os.environ | {"SOAK_PATIENCE": "10"}  # on a busy machine
    run(*command, "--output", tmp_path, cwd=ROOT, env=patience)
    found = json.loads((tmp_path / "soak.json").read_text())
    assert found["faults"] == []
    answered = {f"{way} good: answered" for way in ("grpc", "stream", "rest")}
    assert answered <= found["outcomes"].keys()
    assert found["attacks"][0].keys() == {"json: 400", "x-npy: 400", "x-npz: 400"}
