"""pyproject.toml, constraints.txt, Dockerfile and the set-up scripts agree with each other."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def constraint_lines() -> list[str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return [line for line in lines if not line.startswith("#")]


def pinned() -> dict[str, Version]:
    pairs = (line.split("==") for line in constraint_lines())
    return {canonicalize_name(name): Version(version) for name, version in pairs}


def requirements() -> list[Requirement]:
    extras = PROJECT["optional-dependencies"].values()
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in extra)]
    parsed = [Requirement(text) for text in texts]
    return [
        requirement
        for requirement in parsed
        if requirement.name != PROJECT["name"]
        and (requirement.marker is None or requirement.marker.evaluate())
    ]


def test_every_constraint_is_one_exact_public_version() -> None:
    for line in constraint_lines():
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9A-Za-z.]*", line), line


@pytest.mark.parametrize("requirement", requirements(), ids=str)
def test_constraint_lies_in_the_declared_range(requirement: Requirement) -> None:
    assert pinned()[canonicalize_name(requirement.name)] in requirement.specifier


def test_grpc_packages_share_one_version() -> None:
    names = ("grpcio", "grpcio-tools", "grpcio-health-checking", "grpcio-reflection")
    assert len({pinned()[name] for name in names}) == 1


def test_base_install_is_the_light_client() -> None:
    names = {Requirement(text).name for text in PROJECT["dependencies"]}
    assert names == {"grpcio", "httpx", "numpy", "protobuf"}


def test_dockerfile_installs_the_libraries_that_the_set_up_script_looks_for() -> None:
    script = (ROOT / "scripts" / "system_packages.sh").read_text()
    table = script.partition("<<'LIBRARIES'\n")[2].partition("LIBRARIES")[0]
    looked_for = {line.split()[1] for line in table.splitlines()}
    dockerfile = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    install = re.search(r"apt-get install ([^&]*)", dockerfile)
    assert install is not None
    installed = {word for word in shlex.split(install[1]) if not word.startswith("-")}
    assert looked_for == installed
    assert len(looked_for) == 5


def test_changelog_has_a_section_for_this_version() -> None:
    assert f"\n## {PROJECT['version']}" in (ROOT / "CHANGELOG.md").read_text()
