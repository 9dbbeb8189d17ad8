"""Commands, and one result of each kind that several tests look at."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from edgegrasp_cli.main import app

Command = Callable[..., str]
TOP_DOWN = "examples.your_planner:plan"


def invoke(code: int, *words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


@pytest.fixture(scope="session")
def run() -> Command:
    """Run a command that succeeds; gives what it prints."""
    return partial(invoke, 0)


@pytest.fixture(scope="session")
def refused() -> Command:
    """Run a command that ends with a message; gives the message."""
    return partial(invoke, 1)


@pytest.fixture(scope="session")
def benchmark(run: Command) -> Callable[..., dict[str, Any]]:
    """A small benchmark of packed scenes; gives its summary."""

    def benchmark(folder: Path, planner: str, *flags: object, rounds: int = 2) -> dict[str, Any]:
        where = ("--scene", "packed", "--seed", 0, "--workers", 1, "--output", folder)
        asked = ("--planner", planner, "--rounds", rounds, "--no-report")
        run("benchmark", *where, *asked, *flags)
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
        return summary

    return benchmark


@pytest.fixture(scope="session")
def in_process(benchmark: Callable[..., dict], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in_process")
    benchmark(folder, "in-process", "--num-approach-points", 16, "--num-candidates", 200)
    return folder


@pytest.fixture(scope="session")
def top_down(benchmark: Callable[..., dict], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without a model, over the same scenes, with a report."""
    folder = tmp_path_factory.mktemp("top_down")
    benchmark(folder, TOP_DOWN, "--report")
    return folder
