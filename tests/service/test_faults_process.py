"""What can happen to a process: full disks, clocks that jump, a soak."""

import json
import re
import subprocess
import sys
import zlib
from pathlib import Path

import grpc
import httpx
import numpy as np
import pytest

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
