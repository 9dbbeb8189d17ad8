"""pyproject.toml, constraints.txt, Dockerfile and the set-up scripts agree with each other."""

import re
import shlex
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_grpc_packages_share_one_version() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    grpc = [line.split("==") for line in lines if line.startswith("grpcio")]
    assert len(grpc) >= 4
    assert len({version for _, version in grpc}) == 1


def test_base_install_is_the_light_client() -> None:
    names = {Requirement(text).name for text in PROJECT["dependencies"]}
    assert names == {"grpcio", "httpx", "numpy", "protobuf", "typing-extensions"}


def test_dockerfile_installs_what_torch_needs_and_not_the_libraries_of_open3d() -> None:
    script = (ROOT / "scripts" / "system_packages.sh").read_text()
    table = script.partition("<<'LIBRARIES'\n")[2].partition("LIBRARIES")[0]
    looked_for = {line.split()[1] for line in table.splitlines()}
    dockerfile = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    lists = re.findall(r"apt-get (?:install|download) ([^&]*)", dockerfile)
    installed = {word for words in lists for word in shlex.split(words)}
    assert looked_for & installed == {"libgomp1"}
    assert len(looked_for) == 5
