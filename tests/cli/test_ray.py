"""The Ray Serve application on a cluster of two nodes, both on this machine."""

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
from benchmarks.load import OPTIONS
from benchmarks.load import cloud as table

from edgegrasp_client import (
    GraspClient,
    GraspClientError,
    InvalidRequestError,
    UnknownModelError,
)
from edgegrasp_model.options import DetectOptions
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import load_catalogue

CONFIG = Path(__file__).parents[2] / "docker/ray/serve.yaml"
AGENTS = ("dashboard-agent-grpc", "dashboard-agent-listen", "metrics-export", "runtime-env-agent")
PATIENCE = 240  # seconds, of a busy machine


def free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        made = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in made]


class Cluster:
    """Two nodes of a processor each, and `serve run` on the first."""

    def __init__(self, folder: Path) -> None:
        yaml = pytest.importorskip("yaml")
        self.processes: list[psutil.Popen] = []
        self._environment = os.environ | {
            "RAY_TMPDIR": str(folder),
            "RAY_AUTH_MODE": "disabled",
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_raylet_start_wait_time_s": str(PATIENCE),
            "PYTHONPATH": os.pathsep.join(sys.path),
        }
        head, http, grpc = free_ports(3)
        config = yaml.safe_load(CONFIG.read_text())
        config["http_options"] |= {"host": "127.0.0.1", "port": http}
        config["grpc_options"]["port"] = grpc
        config["proxy_location"] = "HeadOnly"  # both nodes have the same ports
        (folder / "serve.yaml").write_text(yaml.safe_dump(config))
        self.addresses = {"rest": f"http://127.0.0.1:{http}", "grpc": f"127.0.0.1:{grpc}"}
        self._head, self._config = f"127.0.0.1:{head}", str(folder / "serve.yaml")

    def start(self) -> None:
        port = self._head.rpartition(":")[2]
        self._node("--head", f"--port={port}", "--include-dashboard=false")
        self.second = self._node(f"--address={self._head}")
        self._start("ray.serve.scripts", "run", f"--address={self._head}", self._config)

    def _node(self, *flags: str) -> psutil.Popen:
        # Agents that choose ports for themselves must do so within 15 s, whatever else runs here.
        ports = (f"--{name}-port={port}" for name, port in zip(AGENTS, free_ports(4), strict=True))
        own = ("--node-ip-address=127.0.0.1", "--num-cpus=1", "--object-store-memory=100000000")
        any_port = ("--min-worker-port=0", "--max-worker-port=0")
        run = "ray.scripts.scripts", "start", "--block", *own, *any_port, *ports, *flags
        process = self._start(*run)
        for line in process.stdout:
            if "Ray runtime started" in line:
                return process
        raise AssertionError("Ray did not start")

    def _start(self, *module: str) -> psutil.Popen:
        command = [sys.executable, "-m", *module]
        process = psutil.Popen(command, stdout=subprocess.PIPE, text=True, env=self._environment)
        self.processes.append(process)
        return process

    def kill(self, process: psutil.Popen) -> None:
        """End a process and all that it has started."""
        family = [*process.children(recursive=True), process]
        for one in family:
            with suppress(psutil.NoSuchProcess):
                one.kill()
        psutil.wait_procs(family)
        process.stdout.close()


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    pytest.importorskip("ray.serve", reason="the extra `ray` is not installed")
    pytest.importorskip("watchfiles", reason="the extra `ray` is not installed")
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="ray") as folder:  # short: of sockets
        made = Cluster(Path(folder))
        try:
            made.start()
            with GraspClient(made.addresses["rest"]) as client:
                client.wait_until_ready(PATIENCE)
            yield made
        finally:
            for process in reversed(made.processes):
                if process.is_running():
                    made.kill(process)


def outcome(address: str, points: np.ndarray) -> str:
    with GraspClient(address, timeout=PATIENCE) as client:
        try:
            return f"{len(client.detect(points, **OPTIONS).grasps)} grasps"
        except GraspClientError as error:
            return type(error).__name__


def test_answers_are_those_of_one_process_and_a_lost_node_loses_none(cluster: Cluster) -> None:
    points = table(2000, seed=0)
    settings = Settings(workers=1)
    catalogue = load_catalogue(settings)
    here = catalogue.get("").detect(points, DetectOptions(**OPTIONS))
    for address in cluster.addresses.values():
        with GraspClient(address, timeout=PATIENCE) as client:
            for _ in range(4):  # of either replica
                found = client.detect(points, **OPTIONS)
                assert found.counts == here.counts
                poses = [grasp.T_cloud_hand for grasp in found.grasps]
                assert np.array_equal(poses, [grasp.T_cloud_hand for grasp in here.grasps])
                scores = [grasp.score for grasp in found.grasps]
                assert scores == pytest.approx([grasp.score for grasp in here.grasps], abs=1e-6)
            assert {one.name for one in client.models()} == {
                m["name"] for m in catalogue.describe()
            }
            with pytest.raises(UnknownModelError):
                client.detect(points, model="none of them")
            with pytest.raises(InvalidRequestError, match="seed"):
                client.detect(points, seed=-1)

    with ThreadPoolExecutor(8) as threads:
        places = list(cluster.addresses.values()) * 8
        sent = [threads.submit(outcome, address, points) for address in places]
        sent[2].result()
        cluster.kill(cluster.second)
        outcomes = {one.result() for one in sent}  # each has one
    answered = f"{len(here.grasps)} grasps"
    assert answered in outcomes
    assert outcomes <= {answered, "ProtocolError", "ServerFailedError", "ServerUnavailableError"}
    for address in cluster.addresses.values():
        assert outcome(address, points) == answered
