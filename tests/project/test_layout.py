"""The tree holds what it should, and nothing of the machine it was made on."""

import importlib
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]

# Package indexes and absolute paths of somebody's machine; in pieces, or this file would match.
HOSTS = ["pypi" + r"\.org", "python" + "hosted", "npm" + r"js\.org", r"deb\." + "debian"]
FOREIGN = re.compile(
    "|".join([*HOSTS, "--index" + "-url", r"(?<![\w.}])/(?:work|root|home|mnt)/\w"])
)


def tracked_files() -> list[Path]:
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
        )
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout, so there is no list of tracked files")
    paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    return [path for path in paths if path.is_file()]


def text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return ""


def test_no_tracked_file_names_a_registry_or_a_path_of_one_machine() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in tracked_files()
        for match in FOREIGN.finditer(text_of(path))
    ]
    assert found == []


@pytest.mark.parametrize("text", ["see https://" + "pypi" + ".org/x", "open('/" + "work/main/a')"])
def test_that_search_finds_what_it_looks_for(text: str) -> None:
    assert FOREIGN.search(text)


def test_tracked_files_are_small_enough_for_a_clone() -> None:
    large = [path.name for path in tracked_files() if path.stat().st_size > 20 * 2**20]
    assert large == []


@pytest.mark.parametrize("package", PACKAGES)
def test_package_is_where_the_distribution_says(package: str) -> None:
    folder = ROOT / package
    assert (folder / "__init__.py").is_file()
    assert package == "proto/edgegrasp" or (folder / "py.typed").is_file()


def test_console_script_can_be_imported() -> None:
    module, _, function = PYPROJECT["project"]["scripts"]["edgegrasp"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))
