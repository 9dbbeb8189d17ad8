"""`edgegrasp benchmark` and what reads its results, end to end and small.

Tests that share a result are in one file, so that one process makes it once.
"""

import csv
import json
import re
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from edgegrasp_sim.engine import choose_engine

from .conftest import TOP_DOWN

SMOKE_GATE = Path(__file__).parent / "smoke_gate.json"


def figures(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def attempts(folder: Path) -> list[dict[str, str]]:
    with (folder / "attempts.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_shipped_weights_are_not_below_the_gate(benchmark: Callable, run, tmp_path) -> None:
    few = ("--num-approach-points", 16, "--num-candidates", 400)
    gate = tmp_path / "gate.json"  # all held, in the one engine and the other
    committed = json.loads(SMOKE_GATE.read_text()) | {"engine": choose_engine()}
    gate.write_text(json.dumps(committed))
    benchmark(tmp_path, "in-process", *few, "--gate", gate, rounds=4)
    planner = json.loads((tmp_path / "manifest.json").read_text())["run"]["planner"]
    assert planner["options"] == {
        "num_approach_points": 16,
        "num_candidates": 400,
    }


def test_another_hand_is_planned_for_and_simulated(benchmark, run, refused, tmp_path) -> None:
    few = ("--num-approach-points", 16, "--num-candidates", 400, "--gripper", "robotiq-2f-85")
    assert benchmark(tmp_path, "in-process", *few, rounds=1)["successes"] > 0
    manifest = json.loads((tmp_path / "manifest.json").read_text())["run"]
    assert manifest["gripper"]["max_opening"] == 0.085
    assert manifest["planner"]["options"]["gripper"] == manifest["gripper"]
    assert "the result is the same" in run("replay", "attempt", tmp_path, "--round", 0)
    assert "nothere" in refused("benchmark", "--gripper", "nothere")


def test_a_result_below_the_gate_fails(top_down: Path, in_process: Path, refused, tmp_path) -> None:
    gate = figures(in_process)
    for name in ("grasp_success_rate", "declutter_rate"):
        gate[name] |= {"value": 0.99, "wilson_95": [0.98, 1.0]}
    (tmp_path / "gate.json").write_text(json.dumps(gate))
    where = ("--scene", "packed", "--seed", 0, "--rounds", 2, "--workers", 1, "--no-report")
    again = ("--planner", TOP_DOWN, *where, "--output", top_down)  # nothing is left to run
    assert "below the gate: GSR" in refused("benchmark", *again, "--gate", tmp_path / "gate.json")


def test_the_report_shows_tables_and_pictures(top_down: Path) -> None:
    page = (top_down / "report.html").read_text()
    assert "name=viewport" in page  # a phone shows it as wide as itself
    failed = sum(bool(row["cause"]) for row in attempts(top_down))
    assert page.count("data:image/jpeg") == min(failed, 6) > 0
    assert all(name in page for name in figures(top_down)["objects_by_name"])


def test_a_protocol_brings_its_scene(run, tmp_path) -> None:
    where = ("--planner", TOP_DOWN, "--rounds", 1, "--no-report", "--output", tmp_path)
    run("benchmark", "--protocol", "shelf", *where)
    assert figures(tmp_path)["scene"] == "shelf"


def test_a_recorded_attempt_comes_out_the_same(in_process: Path, run, tmp_path: Path) -> None:
    last = attempts(in_process)[-1]
    where = ("--round", last["round"], "--attempt", last["attempt"])
    picture = tmp_path / "attempt.png"
    assert "the same" in run("replay", "attempt", in_process, *where, "--picture", picture)
    assert picture.read_bytes()[1:4] == b"PNG"


def test_wrong_replays_and_comparisons_end_with_a_sentence(
    in_process, benchmark, refused, tmp_path
):
    assert "attempt is 99" in refused("replay", "attempt", in_process, "--attempt", 99)
    assert "round is 7" in refused("replay", "attempt", in_process, "--round", 7)
    assert "contains no benchmark" in refused("replay", "attempt", tmp_path)
    assert "contains no benchmark" in refused("compare", in_process, tmp_path)
    benchmark(tmp_path, TOP_DOWN, "--protocol", "giga", rounds=1)
    assert "differ in protocol" in refused("compare", in_process, tmp_path)


def test_two_planners_are_compared_scene_by_scene(in_process, top_down, run, tmp_path) -> None:
    output = run("compare", top_down, in_process, "--output", tmp_path / "compared.json")
    assert "2 scenes" in output
    compared = json.loads((tmp_path / "compared.json").read_text())
    for name in ("grasp_success_rate", "declutter_rate"):
        ceiling, base = (figures(folder)[name]["value"] for folder in (in_process, top_down))
        assert compared[name]["difference"] == pytest.approx(ceiling - base)
        low, high = compared[name]["difference_95"]
        assert low <= compared[name]["difference"] <= high


def test_a_server_killed_and_restarted_changes_nothing(
    start_dummy: Callable, dummy_server, benchmark: Callable, tmp_path: Path
) -> None:
    address = dummy_server.grpc_address
    calm = benchmark(tmp_path / "calm", "server", "--server", address, rounds=2)
    shaken = tmp_path / "shaken"
    with ExitStack() as stack:
        first = stack.enter_context(start_dummy())
        ports = re.findall(r":(\d+)", f"{first.http_url} {first.grpc_address}")
        same = ("--http-port", ports[0], "--grpc-port", ports[1])

        def restart() -> None:
            while not list(shaken.glob("rounds/*.json")):
                time.sleep(0.01)
            first.process.kill()
            first.process.wait()
            stack.enter_context(start_dummy(*same))

        thread = threading.Thread(target=restart)
        thread.start()
        again = benchmark(shaken, "server", "--server", first.grpc_address, rounds=2)
        thread.join()
    assert again["attempts_digest"] == calm["attempts_digest"]
