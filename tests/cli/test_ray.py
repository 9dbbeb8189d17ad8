"""Data and the Ray Serve application on a cluster that Ray starts on this machine."""

import os
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from benchmarks.load import OPTIONS
from benchmarks.load import cloud as table

from edgegrasp_client import GraspClient, GraspClientError, InvalidRequestError, UnknownModelError
from edgegrasp_model.options import DetectOptions
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import load_catalogue
from edgegrasp_training.generation import GenerationOptions, generate
from edgegrasp_training.views import find_views

EDGEGRASP = "-c", "from edgegrasp_cli.main import main; main()"
ROOT = Path(__file__).parents[2]
DATA = ["generate-data", "--scenes=4", "--views-per-scene=1", "--grasps-per-view=8", "--seed=5"]
PATIENCE = 240  # seconds, of a busy machine

pytest.importorskip("ray.serve", reason="the extra `ray` is not installed")
pytest.importorskip("watchfiles", reason="the extra `ray` is not installed")


@contextmanager
def started(*arguments: str) -> Iterator[psutil.Popen]:
    """Python with these arguments, and at the end nothing that it started."""
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="ray") as folder:  # short: of sockets
        environment = os.environ | {
            "RAY_TMPDIR": folder,
            "RAY_AUTH_MODE": "disabled",
            "RAY_USAGE_STATS_ENABLED": "0",
            "PYTHONPATH": os.pathsep.join(sys.path),
        }
        process = psutil.Popen([sys.executable, *arguments], env=environment, cwd=folder)
        try:
            yield process
        finally:
            family = [process]
            with suppress(psutil.NoSuchProcess):
                family += process.children(recursive=True)
            for one in family:
                with suppress(psutil.NoSuchProcess):
                    one.kill()
            psutil.wait_procs(family)


def at_work(process: psutil.Popen, task: str) -> list[psutil.Process]:
    """The processes in which a task of Ray runs; Ray names them after it."""
    found = []
    for child in process.children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if f"ray::{task}" in " ".join(child.cmdline()):
                found.append(child)
    return found


def until(condition: Callable[[], Any], process: psutil.Popen) -> Any:
    """What a condition gives when it holds; the process must not have failed before."""
    while not (found := condition()):
        assert process.poll() in (None, 0)
        time.sleep(0.05)
    return found


def test_data_are_those_of_one_process_though_a_worker_is_lost(tmp_path: Path) -> None:
    alone, there = tmp_path / "alone", tmp_path / "there"
    list(generate(alone, None, GenerationOptions(4, 1, 8, seed=5)))
    with started(*EDGEGRASP, *DATA, str(there), "--ray=local", "--workers=2") as making:
        (lost, *_) = until(lambda: list(there.glob("*.npz")) and at_work(making, "_run"), making)
        lost.kill()
        assert making.wait(PATIENCE) == 0
    views = find_views([alone])
    assert [path.name for path in find_views([there])] == [path.name for path in views]
    for path in views:
        assert (there / path.name).read_bytes() == path.read_bytes()


def outcome(address: str, points: np.ndarray) -> str:
    with GraspClient(address, timeout=PATIENCE) as client:
        try:
            return f"{len(client.detect(points, **OPTIONS).grasps)} grasps"
        except GraspClientError as error:
            return type(error).__name__


def free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        made = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in made]


def test_answers_are_those_of_one_process_and_a_lost_replica_loses_none(tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    http, grpc = free_ports(2)
    config = yaml.safe_load((ROOT / "docker/ray/serve.yaml").read_text())
    config["http_options"] |= {"host": "127.0.0.1", "port": http}
    config["grpc_options"]["port"] = grpc
    (tmp_path / "serve.yaml").write_text(yaml.safe_dump(config))
    addresses = f"http://127.0.0.1:{http}", f"127.0.0.1:{grpc}"
    points, catalogue = table(2000, seed=0), load_catalogue(Settings(workers=1))
    here = catalogue.get("").detect(points, DetectOptions(**OPTIONS))
    with started("-m", "ray.serve.scripts", "run", str(tmp_path / "serve.yaml")) as serving:
        for address in addresses:
            with GraspClient(address, timeout=PATIENCE) as client:
                client.wait_until_ready(PATIENCE)
                found = client.detect(points, **OPTIONS)
                assert found.counts == here.counts
                poses = [grasp.T_cloud_hand for grasp in found.grasps]
                assert np.array_equal(poses, [grasp.T_cloud_hand for grasp in here.grasps])
                names = {one["name"] for one in catalogue.describe()}
                assert {one.name for one in client.models()} == names
                with pytest.raises(UnknownModelError):
                    client.detect(points, model="none of them")
                with pytest.raises(InvalidRequestError, match="seed"):
                    client.detect(points, seed=-1)
        with ThreadPoolExecutor(8) as threads:
            kept = [threads.submit(outcome, address, points) for address in addresses * 4]
            kept[0].result()
            until(lambda: at_work(serving, "ServeReplica"), serving)[0].kill()
            assert {one.result() for one in kept} == {f"{len(here.grasps)} grasps"}
