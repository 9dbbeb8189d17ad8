"""`edgegrasp benchmark` and what reads its results, end to end and small."""

import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from edgegrasp_cli.main import app

OWN_PLANNER = """
from edgegrasp_sim.top_down import plan_top_down

class MyPlanner:
    def __call__(self, observation, seed):
        return plan_top_down(observation, seed)
"""


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def figures(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def benchmark(folder: Path, planner: str, *flags: object, rounds: int = 2) -> dict:
    where = ("--scene", "packed", "--seed", 0, "--rounds", rounds, "--output", folder)
    run("benchmark", "--planner", planner, *where, *flags)
    return figures(folder)


@pytest.fixture(scope="module")
def oracle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("oracle")
    benchmark(folder, "oracle")
    return folder


def test_the_oracle_is_above_random_candidates(oracle: Path, tmp_path: Path) -> None:
    ceiling = figures(oracle)
    baseline = benchmark(tmp_path, "edge-sample")
    assert ceiling["grasp_success_rate"]["value"] > 0.9
    assert ceiling["declutter_rate"]["value"] > baseline["declutter_rate"]["value"]


def test_a_planner_of_one_s_own_needs_only_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_planner.py").write_text(OWN_PLANNER)
    monkeypatch.syspath_prepend(tmp_path)
    as_class = benchmark(tmp_path / "class", "my_planner:MyPlanner", rounds=1)
    as_function = benchmark(tmp_path / "function", "edgegrasp_sim.top_down:plan_top_down", rounds=1)
    assert as_class["attempts_digest"] == as_function["attempts_digest"]


def test_both_transports_give_the_same_attempts(dummy_server, tmp_path: Path) -> None:
    digests = {
        benchmark(tmp_path / str(number), "server", "--server", address)["attempts_digest"]
        for number, address in enumerate((dummy_server.http_url, dummy_server.grpc_address))
    }
    assert len(digests) == 1


@pytest.mark.parametrize("transport", ["grpc", "rest"])
def test_a_server_killed_and_restarted_changes_nothing(
    transport: str, start_server: Callable, tmp_path: Path
) -> None:
    with start_server("--backend", "dummy") as server:
        address = server.address(transport)
        calm = benchmark(tmp_path / "calm", "server", "--server", address, rounds=6)
        ports = re.findall(r":(\d+)", server.http_url + " " + server.grpc_address)
    flags = ("--backend", "dummy", "--http-port", ports[0], "--grpc-port", ports[1])
    shaken = tmp_path / "shaken"

    def restart(stack: contextlib.ExitStack) -> None:
        first = stack.enter_context(start_server(*flags))
        started.set()
        while not list(shaken.glob("rounds/*.json")):
            time.sleep(0.01)
        first.process.kill()
        first.process.wait()
        wait_until_closed(int(ports[0]))
        stack.enter_context(start_server(*flags))

    started = threading.Event()
    with contextlib.ExitStack() as stack:
        thread = threading.Thread(target=restart, args=(stack,))
        thread.start()
        started.wait(60)
        again = benchmark(shaken, "server", "--server", address, rounds=6)
        thread.join()
    assert again["attempts_digest"] == calm["attempts_digest"]
    assert again["planner_retries"] > 0 == calm["planner_retries"]


def wait_until_closed(port: int) -> None:
    while True:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) != 0:
                return
        time.sleep(0.01)
