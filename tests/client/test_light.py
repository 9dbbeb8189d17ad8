"""The client beside a robot's controller: no torch, no Open3D, no web framework."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tests.programs import run

ROOT = Path(__file__).parents[2]
IMPORT = """
import importlib, importlib.abc, pkgutil, sys

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1:]:
            raise ModuleNotFoundError(f"no {name}", name=name)

sys.meta_path.insert(0, Absent())
import edgegrasp_client
for module in pkgutil.iter_modules(edgegrasp_client.__path__, "edgegrasp_client."):
    importlib.import_module(module.name)
edgegrasp_client.GraspClient("127.0.0.1:1").close()
edgegrasp_client.GraspClient("http+unix:/nowhere").close()
"""
ABSENT = ("fastapi", "numba", "open3d", "pybullet", "pydantic", "scipy", "starlette", "torch")


@pytest.mark.parametrize("python", [sys.executable, "python3.10"])
def test_the_client_imports_with_its_own_requirements_alone(python: str) -> None:
    program = shutil.which(python)
    probe = [program or "", "-c", "import grpc, httpx, numpy, google.protobuf, typing_extensions"]
    if program is None or subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip(f"{python} is not here, or has not what the client requires")
    path = f"{ROOT / 'clients'}:{ROOT / 'proto'}"
    words = ("-W", "error", "-c", IMPORT, *ABSENT)
    run(program, *words, env=os.environ | {"PYTHONPATH": path})
