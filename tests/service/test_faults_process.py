"""What can happen to a process: full disks, clocks that jump, SIGTERM under load, a soak."""

import ast
import json
import re
import subprocess
import sys
import threading
import time
import zlib
from collections import Counter
from pathlib import Path

import grpc
import httpx
import numpy as np
import pytest

import edgegrasp_service
from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import GraspClient

ROOT = Path(__file__).parents[2]
PROGRAM = "from edgegrasp_cli.main import main; main()"
SERVE = ("serve", "--http-port", "0", "--grpc-port", "0", "--backend", "dummy")
PATIENCE = 20


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_disk_under_the_log(cloud: np.ndarray) -> None:
    """Every line is lost, and no request."""
    with open("/dev/full", "w") as full:  # noqa: PTH123  # a device
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *SERVE, "--log-level", "debug"],
            stdout=subprocess.PIPE,
            stderr=full,
            text=True,
        )
    assert process.stdout is not None
    try:
        words = process.stdout.readline().split()
        for address in (words[3], words[5]):
            with GraspClient(address, timeout=PATIENCE) as client:
                for _ in range(20):
                    assert client.detect(cloud).counts["crc32"] == zlib.crc32(cloud.tobytes())
                    with pytest.raises(Exception, match="num_approach_points"):
                        client.detect(cloud[:3])
        process.terminate()
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.stdout.close()


JUMPING = """
import itertools, time
real, jumps = time.time, itertools.cycle([-86400.0, 3600.0, 1e9, -1e9])
time.time = lambda: real() + next(jumps)
time.time_ns = lambda: int(time.time() * 1e9)
"""


def test_clocks_that_jump(cloud: np.ndarray) -> None:
    """The wall clock goes back a day, and on by thirty years, each time it is read."""
    process = subprocess.Popen(
        [sys.executable, "-c", JUMPING + PROGRAM, *SERVE, "--dummy-seconds", "0.01"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    try:
        words = process.stdout.readline().split()
        body = {"points": cloud.tolist()}
        headers = {"X-Request-Timeout": str(PATIENCE)}
        message = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
        with (
            httpx.Client(base_url=words[3], timeout=PATIENCE) as http,
            grpc.insecure_channel(words[5]) as channel,
        ):
            detect = grasp_pb2_grpc.GraspServiceStub(channel).DetectGrasps
            for _ in range(10):
                answer = http.post("/v1/grasps", json=body, headers=headers)
                assert answer.status_code == 200
                # Without a deadline: gRPC works one out from two clocks, of which one jumps here.
                for seconds in (answer.json()["seconds"], dict(detect(message).seconds)):
                    assert all(0.0 <= value < PATIENCE for value in seconds.values())
            page = http.get("/metrics").text
        sums = re.findall(r"^edgegrasp_\w*seconds_sum\S* (\S+)$", page, re.MULTILINE)
        assert sums
        assert all(0.0 <= float(value) < 20 * PATIENCE for value in sums)
        process.terminate()
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.stdout.close()


def test_durations_come_from_clocks_that_only_go_forward() -> None:
    """Spans bear the wall clock's time, which is not subtracted from anything."""
    wall = {"time.time", "time.time_ns", "datetime.now", "datetime.utcnow"}
    readers = {
        path.name
        for path in Path(edgegrasp_service.__file__).parent.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and ast.unparse(node) in wall
    }
    assert readers <= {"tracing.py"}


class Callers:
    """Threads that send requests until the server is gone, and what came of each."""

    def __init__(self, cloud: np.ndarray) -> None:
        self.came: list[str] = []
        self.gone = threading.Event()
        self._message = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
        self._json = {"points": cloud.tolist()}
        self._digest = zlib.crc32(cloud.tobytes())

    def by_grpc(self, address: str) -> None:
        with grpc.insecure_channel(address) as channel:
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            while not self.gone.is_set():
                try:
                    answer = stub.DetectGrasps(self._message, timeout=PATIENCE)
                except grpc.RpcError as error:
                    self.came.append(f"grpc {error.code().name}")
                    return
                self._answered("grpc", answer.counts["crc32"])

    def by_stream(self, address: str) -> None:
        sent = 0

        def requests():
            nonlocal sent
            while not self.gone.is_set() and sent < 100_000:
                sent += 1
                yield grasp_pb2.DetectGraspsStreamRequest(
                    request_id=str(sent), request=self._message
                )

        with grpc.insecure_channel(address) as channel:
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            answers = 0
            try:
                for response in stub.DetectGraspsStream(requests(), timeout=PATIENCE):
                    answers += 1
                    assert response.request_id == str(answers)
                    if response.WhichOneof("answer") == "detection":
                        self._answered("stream", response.detection.counts["crc32"])
                    else:
                        self.came.append(f"stream answer {response.error.detail.kind}")
            except grpc.RpcError as error:
                self.came.append(f"stream {error.code().name}")

    def by_http(self, address: str) -> None:
        with httpx.Client(base_url=address, timeout=PATIENCE) as http:
            while not self.gone.is_set():
                try:
                    response = http.post("/v1/grasps", json=self._json)
                except httpx.TransportError as error:
                    self.came.append(f"http {type(error).__name__}")
                    return
                if response.status_code != 200:
                    self.came.append(f"http {response.status_code}")
                    return
                self._answered("http", response.json()["counts"]["crc32"])

    def _answered(self, transport: str, digest: int) -> None:
        assert digest == self._digest
        self.came.append(f"{transport} OK")


def test_sigterm_under_load(start_server, cloud: np.ndarray) -> None:
    """Every request that was accepted is answered; the others are told, and the exit code is 0."""
    with start_server("--backend", "dummy", "--dummy-seconds", "0.02") as server:
        callers = Callers(cloud)
        threads = [
            threading.Thread(target=work, args=(address,))
            for work, address in (
                (callers.by_grpc, server.grpc_address),
                (callers.by_stream, server.grpc_address),
                (callers.by_http, server.http_url),
            )
            for _ in range(3)
        ]
        for thread in threads:
            thread.start()
        end = time.monotonic() + PATIENCE
        while len(set(callers.came)) < 3 or len(callers.came) < 30:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert server.stop() == 0
        callers.gone.set()
        for thread in threads:
            thread.join(PATIENCE)
    came = Counter(callers.came)
    assert {"grpc OK", "stream OK", "http OK"} <= set(came)
    # A new connection may find nobody; a request on one that was there gets an answer.
    told = {"grpc UNAVAILABLE", "stream UNAVAILABLE", "stream answer not-ready", "http 503"}
    assert set(came) - {"grpc OK", "stream OK", "http OK"} <= told | {"http ConnectError"}


def test_a_short_soak(tmp_path: Path) -> None:
    """Mixed sizes, malformed, abandoned: every request comes to something, none to another's."""
    command = [sys.executable, "-m", "benchmarks.soak", "--requests", "400"]
    done = subprocess.run(
        [*command, "--output", tmp_path], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "soak.json").read_text())
    assert found["faults"] == []
    assert sum(found["outcomes"].values()) == 400
    kinds = {name.partition(":")[0] for name in found["outcomes"]}
    assert {f"{way} good" for way in ("grpc", "stream", "rest")} <= kinds
    assert any("malformed: refused" in name for name in found["outcomes"])
    assert any("cancelled: cancelled" in name for name in found["outcomes"])
