"""The Ray Serve application and data generation on two nodes, both on this machine."""

import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from benchmarks.load import OPTIONS
from benchmarks.load import cloud as table
from tests.programs import EDGEGRASP, ROOT, free_ports, started, until

from edgegrasp_client import GraspClient, GraspClientError, InvalidRequestError, UnknownModelError
from edgegrasp_model.options import DetectOptions
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import load_catalogue
from edgegrasp_training.generation import generate
from edgegrasp_training.options import GenerationOptions
from edgegrasp_training.views import find_views

DATA = ["generate-data", "--scenes=6", "--views-per-scene=1", "--grasps-per-view=8", "--seed=5"]
PATIENCE = 240  # seconds, of a busy machine
# Shells start jobs in the background with this signal ignored.
INTERRUPTIBLE = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), "stdout": None}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes of a processor each."""
    pytest.importorskip("ray.serve", reason="the extra `ray` is not installed")
    pytest.importorskip("watchfiles", reason="the extra `ray` is not installed")
    from ray.cluster_utils import Cluster

    with (
        tempfile.TemporaryDirectory(dir="/tmp", prefix="ray") as folder,  # short: of sockets
        pytest.MonkeyPatch.context() as patch,
    ):
        for name, value in {
            "RAY_TMPDIR": folder,
            "RAY_AUTH_MODE": "disabled",
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_worker_niceness": "0",  # as nice as the test itself, on a busy machine too
            "PYTHONPATH": os.pathsep.join(sys.path),
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        }.items():
            patch.setenv(name, value)
        made = two_nodes(Cluster)
        try:
            yield made
        finally:
            made.shutdown()


def two_nodes(kind: Any) -> Any:
    """Ray gives its processes too little time to start on a busy or newly installed machine."""
    for left in (3, 2, 1, 0):
        made = kind()
        try:
            made.add_node(include_dashboard=False, dashboard_agent_listen_port=None)
            made.add_node()
            break
        except Exception:
            made.shutdown()
            if not left:
                raise
    return made


@contextmanager
def served(cluster: Any, folder: Path) -> Iterator[dict[str, str]]:
    """`serve run`; addresses of both transports."""
    yaml = pytest.importorskip("yaml")
    http, grpc = free_ports(2)
    config = yaml.safe_load((ROOT / "docker/ray/serve.yaml").read_text())
    config["http_options"] |= {"host": "127.0.0.1", "port": http}
    config["grpc_options"]["port"] = grpc
    config["proxy_location"] = "HeadOnly"  # both nodes have the same ports
    file = folder / "serve.yaml"
    file.write_text(yaml.safe_dump(config))
    words = "-m", "ray.serve.scripts", "run", f"--address={cluster.address}", file
    with started(sys.executable, *words, **INTERRUPTIBLE) as serving:
        yield {"rest": f"http://127.0.0.1:{http}", "grpc": f"127.0.0.1:{grpc}"}
        serving.send_signal(signal.SIGINT)  # which frees the processors
        assert serving.wait(PATIENCE) is not None


def at_work(task: str) -> list[psutil.Process]:
    """The processes in which a task of Ray runs; Ray names them after it."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if f"ray::{task}" in " ".join(process.cmdline()):
                found.append(process)
    return found


def outcome(address: str, points: np.ndarray, retry: bool = True) -> str:
    with GraspClient(address, timeout=PATIENCE, retry=retry) as client:
        try:
            return f"{len(client.detect(points, **OPTIONS).grasps)} grasps"
        except GraspClientError as error:
            return type(error).__name__


def test_answers_are_those_of_one_process_though_a_replica_dies(cluster, tmp_path) -> None:
    points = table(2000, seed=0)
    catalogue = load_catalogue(Settings(workers=1))
    here = catalogue.get("").detect(points, DetectOptions(**OPTIONS))
    answered = f"{len(here.grasps)} grasps"
    with served(cluster, tmp_path) as addresses:
        for address in addresses.values():
            with GraspClient(address, timeout=PATIENCE) as client:
                client.wait_until_ready(PATIENCE)  # though Ray's gRPC has no health service
                for _ in range(4):  # of either replica
                    found = client.detect(points, **OPTIONS)
                    assert found.counts == here.counts
                    poses = [grasp.T_cloud_hand for grasp in found.grasps]
                    assert np.array_equal(poses, [grasp.T_cloud_hand for grasp in here.grasps])
                    scores = [grasp.score for grasp in found.grasps]
                    assert scores == pytest.approx([grasp.score for grasp in here.grasps], abs=1e-6)
                names = {model["name"] for model in catalogue.describe()}
                assert {one.name for one in client.models()} == names
                assert client.robots() == []
                with pytest.raises(UnknownModelError):
                    client.detect(points, model="none of them")
                with pytest.raises(InvalidRequestError, match="seed"):
                    client.detect(points, seed=-1)

        replica = until(lambda: at_work("ServeReplica"))[0]
        with ThreadPoolExecutor(16) as threads:
            places = list(addresses.values()) * 8
            kept = [threads.submit(outcome, address, points) for address in places]
            once = [threads.submit(outcome, address, points, False) for address in places]
            kept[2].result()
            replica.kill()
            assert {one.result() for one in kept} == {answered}
            outcomes = {one.result() for one in once}  # each has one
        assert outcomes <= {answered, "ServerUnavailableError"}


def test_data_are_those_of_one_process_though_a_node_is_lost(cluster, tmp_path) -> None:
    alone, there = tmp_path / "alone", tmp_path / "there"
    few = {"scenes": 6, "views_per_scene": 1, "grasps_per_view": 8, "seed": 5}
    list(generate(alone, None, GenerationOptions(**few)))
    words = *EDGEGRASP, *DATA, there, f"--ray={cluster.address}"
    with started(*words, **INTERRUPTIBLE) as making:
        until(lambda: len(at_work("_run")) == 2 and list(there.glob("*.npz")))
        (second,) = cluster.worker_nodes
        cluster.remove_node(second, allow_graceful=False)
        assert making.wait(PATIENCE) == 0
    views = find_views([alone])
    assert len(views) == 6
    assert [path.name for path in find_views([there])] == [path.name for path in views]
    for path in views:
        assert (there / path.name).read_bytes() == path.read_bytes()
