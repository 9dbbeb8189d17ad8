"""`edgegrasp benchmark` and what reads its results, end to end and small.

Tests that share a result are in one file, so that one process makes it once.
"""

import csv
import json
import re
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from tests.cli.commands import refused, run
from tests.programs import until

from edgegrasp_camera.picture import Picture
from edgegrasp_lab.benchmark import BenchmarkFlags, _plan, benchmark_arm
from edgegrasp_lab.flags import PlannerFlags
from edgegrasp_lab.planners import named_planner, open_planner, request_options
from edgegrasp_model.detector import WEIGHTS_FOLDER
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.engine import choose_engine
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import PlannedGrasp, RoundDriver, StartCollides

TOP_DOWN = "examples.your_planner:plan"


def figures(folder: Path, name: str = "summary.json") -> dict[str, Any]:
    return json.loads((folder / name).read_text())


def attempts(folder: Path) -> list[dict[str, str]]:
    with (folder / "attempts.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def benchmark(folder: Path, planner: str, *flags: object, rounds: int = 2) -> dict[str, Any]:
    """The summary of a small benchmark of packed scenes."""
    where = ("--scene", "packed", "--seed", 0, "--workers", 1, "--output", folder)
    asked = ("--planner", planner, "--rounds", rounds, "--no-report")
    run("benchmark", *where, *asked, *flags)
    return figures(folder)


@pytest.fixture(scope="session")
def in_process(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in_process")
    benchmark(folder, "in-process", "--num-approach-points", 16, "--num-candidates", 200)
    return folder


@pytest.fixture(scope="session")
def top_down(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without a model, over the same scenes, with a report."""
    folder = tmp_path_factory.mktemp("top_down")
    benchmark(folder, TOP_DOWN, "--report")
    return folder


def test_the_shipped_weights_are_not_below_the_gate(tmp_path) -> None:
    few = ("--num-approach-points", 16, "--num-candidates", 400)
    gate = tmp_path / "gate.json"  # all held, in the one engine and the other
    committed = json.loads(Path(__file__).with_name("smoke_gate.json").read_text())
    gate.write_text(json.dumps(committed | {"engine": choose_engine()}))
    benchmark(tmp_path, "in-process", *few, "--gate", gate, rounds=4)
    planner = figures(tmp_path, "manifest.json")["run"]["planner"]
    assert planner["options"] == {"num_approach_points": 16, "num_candidates": 400}


def test_another_hand_is_planned_for_and_simulated(tmp_path, monkeypatch) -> None:
    few = ("--num-approach-points", 16, "--num-candidates", 400, "--gripper", "robotiq-2f-85")
    assert benchmark(tmp_path, "in-process", *few, rounds=1)["successes"] > 0
    manifest = figures(tmp_path, "manifest.json")["run"]
    assert manifest["gripper"]["max_opening"] == 0.085
    assert manifest["planner"]["options"]["gripper"] == manifest["gripper"]
    drawn = Mock()
    monkeypatch.setattr(Picture, "grasps", drawn)
    replay = "replay", "attempt", tmp_path, "--round", 0, "--picture", tmp_path / "hand.png"
    assert "the result is the same" in run(*replay)
    assert drawn.call_args.args[1][1] == manifest["gripper"]["tip_z"]
    assert "nothere" in refused("benchmark", "--gripper", "nothere")


@pytest.mark.parametrize("asked", ["penalise", {"margin": 0.001}])
def test_flags_keep_the_lift_of_an_arm(asked) -> None:
    pytest.importorskip("roboplan", reason="the extra robot is not installed")
    _, options = _plan(BenchmarkFlags(robot="ur5", protocol="ur5-pile"), {"collision": asked})
    assert options["collision"]["retreat_length"] == 0.1


def test_a_result_below_the_gate_fails(top_down: Path, in_process: Path, tmp_path) -> None:
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


def test_a_protocol_brings_its_scene(tmp_path) -> None:
    where = ("--planner", TOP_DOWN, "--rounds", 1, "--no-report", "--output", tmp_path)
    run("benchmark", "--protocol", "shelf", *where)
    assert figures(tmp_path)["scene"] == "shelf"


def test_a_recorded_attempt_comes_out_the_same(in_process: Path, tmp_path: Path) -> None:
    last = attempts(in_process)[-1]
    where = ("--round", last["round"], "--attempt", last["attempt"])
    picture = tmp_path / "attempt.png"
    assert "the same" in run("replay", "attempt", in_process, *where, "--picture", picture)
    assert picture.read_bytes()[1:4] == b"PNG"


def test_wrong_replays_and_comparisons_end_with_a_sentence(in_process, tmp_path) -> None:
    assert "attempt is 99" in refused("replay", "attempt", in_process, "--attempt", 99)
    assert "round is 7" in refused("replay", "attempt", in_process, "--round", 7)
    assert "contains no benchmark" in refused("replay", "attempt", tmp_path)
    assert "contains no benchmark" in refused("compare", in_process, tmp_path)
    benchmark(tmp_path, TOP_DOWN, "--protocol", "giga", rounds=1)
    assert "differ in protocol" in refused("compare", in_process, tmp_path)
    facts = figures(tmp_path, "manifest.json")
    facts["run"]["arm"] = ["joint_1"]
    (tmp_path / "manifest.json").write_text(json.dumps(facts))
    assert "attempts of an arm" in refused("replay", "attempt", tmp_path)


def test_two_planners_are_compared_scene_by_scene(in_process, top_down, tmp_path) -> None:
    output = run("compare", top_down, in_process, "--output", tmp_path / "compared.json")
    assert "2 scenes" in output
    compared = figures(tmp_path, "compared.json")
    for name in ("grasp_success_rate", "declutter_rate"):
        ceiling, base = (figures(folder)[name]["value"] for folder in (in_process, top_down))
        assert compared[name]["difference"] == pytest.approx(ceiling - base)
        low, high = compared[name]["difference_95"]
        assert low <= compared[name]["difference"] <= high


def test_a_server_killed_and_restarted_changes_nothing(start_dummy, dummy_server, tmp_path) -> None:
    calm = benchmark(tmp_path / "calm", "server", "--server", dummy_server.grpc_address, rounds=2)
    shaken = tmp_path / "shaken"
    with ExitStack() as stack:
        first = stack.enter_context(start_dummy())
        ports = re.findall(r":(\d+)", f"{first.http_url} {first.grpc_address}")
        same = ("--http-port", ports[0], "--grpc-port", ports[1])

        def restart() -> None:
            until(lambda: list(shaken.glob("rounds/*.json")))
            first.process.kill()
            first.process.wait()
            stack.enter_context(start_dummy(*same))

        thread = threading.Thread(target=restart)
        thread.start()
        again = benchmark(shaken, "server", "--server", first.grpc_address, rounds=2)
        thread.join()
    assert again["attempts_digest"] == calm["attempts_digest"]


PAPER = load_protocol("edgegrasp").planning


def seen_under(name: str) -> Observation:
    with ClutterSimulation() as simulation:
        driver = RoundDriver(simulation, SceneKind.PACKED, load_protocol(name), seed=0, index=0)
        return driver.observe()


def test_requests_follow_the_protocol() -> None:
    options = request_options(seen_under("edgegrasp"), 7, PAPER, {"num_candidates": 100})
    assert options["seed"] == 7
    assert (options["num_approach_points"], options["num_candidates"]) == (64, 100)
    assert options["support"]["offset"] == 0.05
    assert len(options["viewpoint"]) == 3
    giga = request_options(seen_under("giga"), 0, load_protocol("giga").planning, {})
    assert giga["support"]["offset"] == 0.05
    assert giga["support"]["max_depth_error"] == 0.12
    assert giga["workspace"]["min"][2] > 0.05
    six = request_options(seen_under("vgn"), 0, load_protocol("vgn").planning, {})
    assert np.shape(six["viewpoint"]) == (6, 3)


LITTLE = {"num_approach_points": 8, "num_candidates": 100}


def planned(**changes: object) -> PlannedGrasp:
    with open_planner(PlannerFlags(planner="in-process", **changes), PAPER, LITTLE) as made:
        grasp = made.make()(seen_under("edgegrasp"), 3)
    assert grasp is not None
    return grasp


def test_a_planner_has_the_weights_and_the_time_of_its_flags(tmp_path: Path) -> None:
    ablation = tmp_path / "no-augmentation.safetensors"
    ablation.write_bytes((WEIGHTS_FOLDER / "edgegrasp-plus.safetensors").read_bytes())
    file = PlannerFlags(planner="in-process", model=str(ablation), timeout=7.0)
    with open_planner(file, PAPER, {}) as made:
        assert len(made.facts["digest"]) == len(made.facts["scene_digest"]) == 64
        assert made.make().timeout == 7.0
    assert planned(model=str(ablation)).score == planned().score
    for changes in ({"planner": "in-process"}, {"weights": (ablation,)}):
        with (
            pytest.raises(ValueError, match="leave out --weights and --planner in-process"),
            open_planner(PlannerFlags(server="127.0.0.1:1", **changes), PAPER, {}),
        ):
            pass


def test_a_view_in_which_the_arm_touches_the_table_is_told_from_other_errors() -> None:
    pytest.importorskip("roboplan", reason="the extra robot is not installed")
    *_, fields = benchmark_arm("fr3", load_protocol("edgegrasp").camera)
    choice, asked = PlannerFlags(planner="in-process", robot="fr3"), LITTLE | fields
    fields["robot"]["joints"] = [0.0, 1.3, 0.0, -1.0, 0.0, 2.2, 0.8]  # in the table
    with open_planner(choice, PAPER, asked) as made:
        with pytest.raises(StartCollides, match="support"):
            made.make()(seen_under("edgegrasp"), 3)
        fields["robot"]["joints"] = [9.0] * 7
        with pytest.raises(InvalidRequest, match="joint1"):
            made.make()(seen_under("edgegrasp"), 3)


def test_another_package_may_name_its_planner(tmp_path, monkeypatch) -> None:
    about = tmp_path / "their_package-0.1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 0.1\n")
    (about / "entry_points.txt").write_text(
        "[edgegrasp.planners]\ntheirs = their_package:Planner\nbroken = their_package:Missing\n"
    )
    (tmp_path / "their_package.py").write_text(
        "class Planner:\n    def __call__(self, observation, seed): return None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert type(named_planner("theirs")).__module__ == "their_package"
    with pytest.raises(ValueError, match="'broken' cannot be loaded"):
        named_planner("broken")
    with pytest.raises(ValueError, match="in-process, broken, theirs, or module:callable"):
        named_planner("nobody")
