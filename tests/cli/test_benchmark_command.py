"""`edgegrasp benchmark` and what reads its results, end to end and small."""

import contextlib
import csv
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

SMOKE_GATE = Path(__file__).parent / "smoke_gate.json"
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


def attempts(folder: Path) -> list[dict[str, str]]:
    with (folder / "attempts.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def benchmark(folder: Path, planner: str, *flags: object, rounds: int = 2) -> dict:
    where = ("--scene", "packed", "--seed", 0, "--rounds", rounds, "--output", folder)
    where = (*where, "--workers", 1)
    run("benchmark", "--no-report", "--planner", planner, *where, *flags)
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


def test_the_shipped_weights_are_not_below_the_gate() -> None:
    few = ("--num-approach-points", 16, "--num-candidates", 400)
    where = ("--scene", "packed", "--seed", 0, "--rounds", 4, "--workers", 1)
    assert "not below the gate" in run(
        "benchmark", "--planner", "in-process", *where, *few, "--gate", SMOKE_GATE
    )


def test_a_result_below_the_gate_fails(oracle: Path, tmp_path: Path) -> None:
    gate = figures(oracle)
    for name in ("grasp_success_rate", "declutter_rate"):
        gate[name] |= {"value": 0.99, "wilson_95": [0.98, 1.0]}
    (tmp_path / "gate.json").write_text(json.dumps(gate))
    where = ("--scene", "packed", "--seed", 0, "--rounds", 2, "--workers", 1)
    where = (*where, "--gate", tmp_path / "gate.json")
    result = CliRunner().invoke(
        app, [str(part) for part in ("benchmark", "--planner", "edge-sample", *where)]
    )
    assert result.exit_code == 1
    assert "below the gate: GSR" in result.output


def test_the_report_shows_tables_plots_and_pictures(tmp_path: Path, oracle: Path) -> None:
    benchmark(tmp_path, "edge-sample", "--report", rounds=2)
    page = (tmp_path / "report.html").read_text()
    failed = sum(bool(row["cause"]) for row in attempts(tmp_path))
    assert page.count("data:image/png") >= 3  # plots
    assert page.count("data:image/jpeg") == min(failed, 6) > 0
    assert "Edge Grasp Network, ICRA 2023" in page
    assert all(name in page for name in figures(tmp_path)["objects_by_name"])


def test_a_recorded_attempt_comes_out_the_same(oracle: Path, tmp_path: Path) -> None:
    last = attempts(oracle)[-1]
    where = ("--round", last["round"], "--attempt", last["attempt"])
    picture = tmp_path / "attempt.png"
    output = run("replay", "attempt", oracle, *where, "--picture", picture)
    assert "it came out the same" in output
    assert picture.read_bytes()[1:4] == b"PNG"


def test_wrong_replays_and_comparisons_end_with_a_sentence(oracle: Path, tmp_path: Path) -> None:
    def refused(*arguments: object) -> str:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert result.exit_code == 1
        return result.output

    assert "attempt is 99" in refused("replay", "attempt", oracle, "--attempt", 99)
    assert "round is 7" in refused("replay", "attempt", oracle, "--round", 7)
    assert "holds no benchmark" in refused("replay", "attempt", tmp_path)
    assert "holds no benchmark" in refused("compare", oracle, tmp_path)
    benchmark(tmp_path, "edge-sample", "--protocol", "giga", rounds=1)
    assert "differ in protocol" in refused("compare", oracle, tmp_path)


def test_two_planners_are_compared_scene_by_scene(oracle: Path, tmp_path: Path) -> None:
    benchmark(tmp_path / "baseline", "edge-sample")
    output = run("compare", tmp_path / "baseline", oracle, "--output", tmp_path / "compared.json")
    assert "2 scenes" in output
    compared = json.loads((tmp_path / "compared.json").read_text())
    for name in ("grasp_success_rate", "declutter_rate"):
        ceiling, base = (
            figures(oracle)[name]["value"],
            figures(tmp_path / "baseline")[name]["value"],
        )
        assert compared[name]["difference"] == pytest.approx(ceiling - base)
        low, high = compared[name]["difference_95"]
        assert low <= compared[name]["difference"] <= high


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


def test_a_server_that_asks_for_a_token_gets_it(
    start_server: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EDGEGRASP_CLIENT_TOKEN", raising=False)
    token = tmp_path / "token"
    token.write_text("user-token-0123456789\n")
    with start_server("--backend", "dummy", "--token-file", str(token)) as server:
        asked = ("--server", server.grpc_address)
        known = benchmark(tmp_path / "known", "server", *asked, "--token-file", token, rounds=1)
        assert known["attempts"] > 0
        words = ("benchmark", "--rounds", "1", "--seed", "0", "--workers", "1", *asked)
        result = CliRunner().invoke(app, list(words))
        assert result.exit_code == 1
        assert "authorization: got nothing" in result.output
