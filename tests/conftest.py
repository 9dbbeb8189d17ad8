import contextlib
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # two test processes and their servers share two cores
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):  # or each program started compiles all of PyTorch
    sys.pycache_prefix = str(Path(__file__).parents[1] / "build" / "pycache")
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    sys.dont_write_bytecode = False

import numpy as np
import pytest
import trustme
from benchmarks import serve_dummy
from hypothesis import HealthCheck, settings
from tests.programs import EDGEGRASP, started

# PyTorch with CUDA loads it for training, which on Debian 12 crashes once MuJoCo has drawn: both
# bring an LLVM.
with contextlib.suppress(ImportError):
    importlib.import_module("triton.knobs")

# No busy machine fails a test, and every run tries the same examples; `make fuzz` tries new ones.
settings.register_profile("tests", max_examples=20, deadline=None, derandomize=True)
settings.register_profile(
    "fuzz",
    max_examples=1500,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("tests")

WEIGHTS = Path(__file__).parents[1] / "model" / "edgegrasp_model" / "weights"
READY_LINE = re.compile(r"EdgeGrasp serves HTTP (\S+) gRPC (\S+)\n")


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    folder = Path(__file__).parents[1].parent / "shared"
    if not folder.is_dir():
        pytest.skip("the shared data folder is absent")
    return folder


@dataclass
class RunningServer:
    http_url: str
    grpc_address: str
    process: subprocess.Popen[str]
    mine: Path | None = None  # weights that a test may replace

    def address(self, transport: str) -> str:
        return self.http_url if transport == "rest" else self.grpc_address

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=20)


@contextlib.contextmanager
def running_server(*flags, program=EDGEGRASP[1:], seconds=0.0, **more) -> Iterator[RunningServer]:
    words = (sys.executable, *program, "serve", "--http-port", "0", "--grpc-port", "0", *flags)
    with started(*words, env=os.environ | {"DUMMY_SECONDS": str(seconds)}, **more) as process:
        line = process.stdout.readline()  # empty once the process is gone
        match = READY_LINE.fullmatch(line)
        assert match, f"the server said {line!r}"
        yield RunningServer(match[1], match[2], process)


@pytest.fixture(scope="session")
def real_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server with the weights that ship, a copy of others as `mine`, and an arm if installed."""
    mine = tmp_path_factory.mktemp("weights") / "mine.safetensors"
    shutil.copy(WEIGHTS / "edgegrasp.safetensors", mine)
    flags = ("--weights", str(mine), "--workers", "2", "--max-voxels", "10000000")
    robots = ("--robots", "fr3") if importlib.util.find_spec("roboplan") else ()
    with running_server(*flags, *robots, "--log-level", "warning") as server:
        server.mine = mine
        yield server


@pytest.fixture(scope="session")
def start_dummy() -> Callable[..., contextlib.AbstractContextManager[RunningServer]]:
    """Start a server with the dummy detector, which takes `seconds`."""
    return partial(running_server, program=("-P", serve_dummy.__file__))


@pytest.fixture(scope="session")
def dummy_server(start_dummy) -> Iterator[RunningServer]:
    with start_dummy() as server:
        yield server


@pytest.fixture(scope="session")
def catalogue() -> Any:
    """The weights that ship, in this process."""
    from edgegrasp_model.detector import ModelCatalogue

    return ModelCatalogue.load()


@pytest.fixture(params=["grpc", "rest"])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def cloud() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.1, 0.1, (500, 3)).astype(np.float32)


@pytest.fixture(scope="session")
def pem(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files: a CA, a server's and a client's certificates and keys of it, and those of another."""
    folder = tmp_path_factory.mktemp("pem")
    files: dict[str, Path] = {}
    for prefix in ("", "other_"):
        authority = trustme.CA()
        blobs = {"ca": authority.cert_pem}
        for name in ("server", "client"):
            issued = authority.issue_cert("127.0.0.1", "localhost")
            blobs |= {name: issued.cert_chain_pems[0], f"{name}_key": issued.private_key_pem}
        for name, blob in blobs.items():
            files[prefix + name] = folder / f"{prefix}{name}.pem"
            blob.write_to_path(files[prefix + name])
    return files
