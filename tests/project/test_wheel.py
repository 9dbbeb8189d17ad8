"""What is released: built as a release is, looked into, installed without this checkout, run."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.programs import ROOT, run, started

from edgegrasp_client import GraspClient

VERSION = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.M)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The sdist, and the wheel that is made of it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT)
    return next(folder.glob("*.tar.gz")), next(folder.glob("*.whl"))


def test_sdist_and_wheel_hold_the_packages_of_this_version_and_no_caches(built) -> None:
    with tarfile.open(built[0]) as sdist, zipfile.ZipFile(built[1]) as wheel:
        names = [name.partition("/")[2] for name in sdist.getnames()]
        ours = [name for name in wheel.namelist() if ".dist-info/" not in name]
    for name in (*names, *ours):
        assert not re.search(r"__pycache__|\.py[co]$|\.nb[ic]$|(^|/)tests?/|_cache/", name), name
    weights = {path.name for path in (ROOT / "model/edgegrasp_model/weights").iterdir()}
    assert weights == {Path(name).name for name in ours if "/weights/" in name}
    v1 = {"grasp.proto", "grasp_pb2.py", "grasp_pb2.pyi", "grasp_pb2_grpc.pyi", "openapi.json"}
    assert v1 <= {name.removeprefix("edgegrasp/v1/") for name in ours}
    packages = {name.partition("/")[0] for name in ours}
    assert packages == {Path(name).parent.name for name in ours if name.endswith("/py.typed")}
    assert VERSION is not None
    assert built[1].name == f"edgegrasp-{VERSION[1]}-py3-none-any.whl"
    deployed = (ROOT / "docker/kubernetes/edgegrasp.yaml").read_text()
    assert f"image: edgegrasp:{VERSION[1]}\n" in deployed
    assert f"## {VERSION[1]}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_wheel_alone_serves(built: tuple[Path, Path], tmp_path: Path) -> None:
    """With what this environment has for it to require, and not its own edgegrasp."""
    new = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(new)], check=True)
    (packages,) = new.glob("lib/python*/site-packages")
    install = ["install", "--quiet", "--no-deps", "--no-index", str(built[1])]
    subprocess.run([sys.executable, "-m", "pip", f"--python={new}", *install], check=True)
    (packages / "required.pth").write_text(sysconfig.get_path("purelib"))
    for loop in (ROOT / "model").rglob("*.nb[ci]"):  # compiled here: it would take a minute
        to = packages / loop.relative_to(ROOT / "model")
        to.parent.mkdir(exist_ok=True)
        shutil.copy(loop, to)
    command = [str(new / "bin/edgegrasp"), "serve", "--http-port=0", "--grpc-port=0", "--workers=1"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with started(*command, cwd=tmp_path, env=environment) as server:
        _, _, _, url, _, address = server.stdout.readline().split()
        document = httpx.get(f"{url}/openapi.json").json()
        with GraspClient(address) as client:
            box = np.random.default_rng(0).uniform(-0.03, 0.03, (2000, 3))
            assert client.detect(box, viewpoint=(0.0, 0.0, 0.5)).model == "edgegrasp-plus"
        server.terminate()
        assert server.wait(20) == 0
    assert "/v1/grasps" in document["paths"]
    where = "import edgegrasp_service as s; print(s.__file__)"
    assert run(new / "bin/python", "-c", where, env=environment).stdout.startswith(str(new))


BARE = """
import importlib, importlib.metadata, pkgutil, sys
from types import SimpleNamespace
import edgegrasp_client, numpy as np
from edgegrasp_bridge import bridge
for module in pkgutil.iter_modules(edgegrasp_client.__path__, "edgegrasp_client."):
    importlib.import_module(module.name)
stamp = SimpleNamespace(sec=1, nanosec=2)
fields = [SimpleNamespace(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
points = np.random.default_rng(0).uniform(0.1, 0.3, (500, 3)).astype("<f4")
cloud = SimpleNamespace(
    header=SimpleNamespace(stamp=stamp, frame_id="camera"), height=1, width=500, fields=fields,
    is_bigendian=False, point_step=12, row_step=6000, data=points.tobytes(),
)
inbox, settings = bridge.Inbox(), bridge.Settings()
assert inbox.take("cloud", cloud, settings.mask_age)
for address in sys.argv[1:]:
    with edgegrasp_client.GraspClient(address) as client:
        asked = client, inbox.scene(settings.mask_age), settings, {}, lambda *_: np.eye(4)
        found = bridge.detect(*asked)
        assert len(bridge.pose_array(found)["poses"]) == len(client.detect(points).grasps) > 0
        assert len(bridge.marker_array(found)["markers"]) == 1 + len(found.grasps)
        assert bridge.moveit_grasps(found, settings, lambda *_: np.eye(4))["grasps"]
        assert len(client.models()) == 1
print(np.__version__, *sorted(each.metadata["Name"] for each in importlib.metadata.distributions()))
"""


def oldest_python() -> str:
    """Python 3.10 where it is and runs, else this one."""
    pyenv = Path.home().glob(".pyenv/versions/3.10.*/bin/python3.10")
    for program in (shutil.which("python3.10"), *map(str, pyenv)):
        if program and not subprocess.run([program, "-c", ""], capture_output=True).returncode:
            return program
    return sys.executable


def test_the_base_install_alone_asks_a_server(built, dummy_server, tmp_path: Path) -> None:
    """The client and the ROS 2 bridge without any extra, with the lowest numpy on 3.10."""
    program = oldest_python()
    lowest = program != sys.executable
    subprocess.run([program, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    python = str(tmp_path / "venv/bin/python")
    pip = [sys.executable, "-m", "pip", f"--python={python}", "install", "--quiet"]
    pinned = ["numpy==1.24.*"] if lowest else ["-c", str(ROOT / "constraints.txt")]
    reached = subprocess.run([*pip, "numpy", *pinned], capture_output=True, text=True, check=False)
    if reached.returncode:
        pytest.skip(f"pip reaches no index: {reached.stderr.strip().splitlines()[-1]}")
    run(*pip, *pinned, built[1])
    addresses = [dummy_server.grpc_address, dummy_server.http_url]
    there = {**os.environ, "PYTHONPATH": str(ROOT / "clients" / "ros2")}
    ran = run(python, "-W", "error", "-c", BARE, *addresses, env=there)
    numpy, *names = ran.stdout.split()
    assert numpy.startswith("1.24.") or not lowest
    assert not {"scipy", "torch", "matplotlib", "typer"} & set(names)
