"""The Ray Serve application and data generation on two nodes, both on this machine."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from benchmarks.load import OPTIONS
from benchmarks.load import cloud as table
from tests.programs import EDGEGRASP

from edgegrasp_client import (
    GraspClient,
    GraspClientError,
    InvalidRequestError,
    UnknownModelError,
)
from edgegrasp_model.options import DetectOptions
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import load_catalogue
from edgegrasp_training.generation import generate
from edgegrasp_training.options import GenerationOptions
from edgegrasp_training.views import find_views

ROOT = Path(__file__).parents[2]
DATA = ["generate-data", "--scenes=6", "--views-per-scene=1", "--grasps-per-view=8", "--seed=5"]
AGENTS = ("dashboard-agent-grpc", "dashboard-agent-listen", "metrics-export", "runtime-env-agent")
PATIENCE = 240  # seconds, of a busy machine


def free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        made = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in made]


class Cluster:
    """Two nodes of a processor each."""

    def __init__(self, folder: Path) -> None:
        self.processes: list[psutil.Popen] = []
        self._environment = os.environ | {
            "RAY_TMPDIR": str(folder),
            "RAY_AUTH_MODE": "disabled",
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_worker_niceness": "0",  # as nice as the test itself, on a busy machine too
            "PYTHONPATH": os.pathsep.join(sys.path),
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        }
        self._folder = folder

    def start_nodes(self) -> None:
        (head,) = free_ports(1)
        self.address = f"127.0.0.1:{head}"
        self._node("--head", f"--port={head}", "--include-dashboard=false")
        self.second = self._node(f"--address={self.address}")

    def serve(self) -> dict[str, str]:
        """`serve run` on the first; addresses of both transports."""
        yaml = pytest.importorskip("yaml")
        http, grpc = free_ports(2)
        config = yaml.safe_load((ROOT / "docker/ray/serve.yaml").read_text())
        config["http_options"] |= {"host": "127.0.0.1", "port": http}
        config["grpc_options"]["port"] = grpc
        config["proxy_location"] = "HeadOnly"  # both nodes have the same ports
        file = self._folder / "serve.yaml"
        file.write_text(yaml.safe_dump(config))
        words = "-m", "ray.serve.scripts", "run", f"--address={self.address}", str(file)
        self.serving = self.start(*words)
        return {"rest": f"http://127.0.0.1:{http}", "grpc": f"127.0.0.1:{grpc}"}

    def _node(self, *flags: str, tries: int = 6) -> psutil.Popen:
        ports = [f"--{name}-port={port}" for name, port in zip(AGENTS, free_ports(4), strict=True)]
        own = ("--node-ip-address=127.0.0.1", "--num-cpus=1", "--object-store-memory=100000000")
        any_port = ("--min-worker-port=0", "--max-worker-port=0")
        run = "-m", "ray.scripts.scripts", "start", "--block", *own, *any_port, *ports, *flags
        process = self.start(*run)
        for line in process.stdout:
            if "Ray runtime started" in line:
                return process
        self.kill(process)  # an agent had 15 s to start, which may be too few on a busy machine
        assert tries > 1, "Ray did not start"
        return self._node(*flags, tries=tries - 1)

    def start(self, *arguments: str) -> psutil.Popen:
        """Python with these arguments, on the first node."""
        process = psutil.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            text=True,
            env=self._environment,
            cwd=self._folder,
            # Shells start jobs in the background with this signal ignored.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        self.processes.append(process)
        return process

    def at_work(self, task: str) -> list[psutil.Process]:
        """The second node's processes in which a task of Ray runs; Ray names them after it."""
        found = []
        for process in self.second.children(recursive=True):
            with suppress(psutil.NoSuchProcess):
                if f"ray::{task}" in " ".join(process.cmdline()):
                    found.append(process)
        return found

    def kill(self, process: psutil.Popen) -> None:
        """End a process and all that it has started."""
        family = [process]
        with suppress(psutil.NoSuchProcess):
            family += process.children(recursive=True)
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
            made.start_nodes()
            yield made
        finally:
            for process in reversed(made.processes):
                made.kill(process)


def until(condition: Callable[[], Any], process: psutil.Popen) -> Any:
    """What a condition gives when it holds; the process must not have failed before."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert process.poll() in (None, 0)
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def outcome(address: str, points: np.ndarray, retry: bool = True) -> str:
    with GraspClient(address, timeout=PATIENCE, retry=retry) as client:
        try:
            return f"{len(client.detect(points, **OPTIONS).grasps)} grasps"
        except GraspClientError as error:
            return type(error).__name__


def test_answers_are_those_of_one_process_though_a_replica_dies(cluster: Cluster) -> None:
    addresses = cluster.serve()
    with GraspClient(addresses["rest"]) as client:
        client.wait_until_ready(PATIENCE)
    points = table(2000, seed=0)
    settings = Settings(workers=1)
    catalogue = load_catalogue(settings)
    here = catalogue.get("").detect(points, DetectOptions(**OPTIONS))
    for address in addresses.values():
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
            assert client.robots() == []
            with pytest.raises(UnknownModelError):
                client.detect(points, model="none of them")
            with pytest.raises(InvalidRequestError, match="seed"):
                client.detect(points, seed=-1)

    answered = f"{len(here.grasps)} grasps"
    (replica,) = until(lambda: cluster.at_work("ServeReplica"), cluster.second)
    with ThreadPoolExecutor(16) as threads:
        places = list(addresses.values()) * 8
        kept = [threads.submit(outcome, address, points) for address in places]
        once = [threads.submit(outcome, address, points, False) for address in places]
        kept[2].result()
        replica.kill()
        assert {one.result() for one in kept} == {answered}
        outcomes = {one.result() for one in once}  # each has one
    assert outcomes <= {answered, "ServerUnavailableError"}
    cluster.serving.send_signal(signal.SIGINT)  # which frees the processors
    assert cluster.serving.wait(PATIENCE) is not None


def test_data_are_those_of_one_process_though_a_node_is_lost(cluster, tmp_path) -> None:
    alone, there = tmp_path / "alone", tmp_path / "there"
    few = {"scenes": 6, "views_per_scene": 1, "grasps_per_view": 8, "seed": 5}
    list(generate(alone, None, GenerationOptions(**few)))
    making = cluster.start(*EDGEGRASP[1:], *DATA, str(there), f"--ray={cluster.address}")
    until(lambda: cluster.at_work("_run") and list(there.glob("*.npz")), making)
    cluster.kill(cluster.second)
    assert making.wait(PATIENCE) == 0
    views = find_views([alone])
    assert len(views) == 6
    assert [path.name for path in find_views([there])] == [path.name for path in views]
    for path in views:
        assert (there / path.name).read_bytes() == path.read_bytes()
