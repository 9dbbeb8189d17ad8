"""Rounds of a benchmark, and what is kept and told of them."""

import csv
import importlib
import json
import multiprocessing
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from examples.your_planner import plan

from edgegrasp_sim import results, trial
from edgegrasp_sim.benchmark import BenchmarkConfig, RoundRunner, manifest, run_benchmark
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.hand import FailureCause, GraspResult
from edgegrasp_sim.objects import ObjectModel, ObjectSet, SceneKind
from edgegrasp_sim.protocol import FOLDER, Protocol, load_protocol, protocol_from, protocol_names
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import PlannedGrasp, Planner, Round, RoundDriver, RoundEnd
from edgegrasp_sim.workers import run_tasks


def paper_with(number: int) -> Protocol:
    """The paper's protocol with so many objects in a scene."""
    paper = load_protocol("edgegrasp")
    return replace(paper, scene=replace(paper.scene, num_objects=(number,)))


TWO_OBJECTS = paper_with(2)
make_planner = partial(partial, plan)  # called, it gives the planner; workers can import it

DIES_ONCE = """
import os, signal
from pathlib import Path
from examples import your_planner

MARK = Path(__file__).with_suffix(".died")

class Planner:
    def __call__(self, observation, seed):
        if not MARK.exists():
            MARK.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return your_planner.plan(observation, seed)

    def close(self):
        MARK.with_suffix(".closed").touch()
"""


def run_in(path: Path, config: BenchmarkConfig, planner=make_planner, **limits) -> list[Round]:
    """The rounds of a benchmark that runs, or goes on, in a folder."""
    folder = results.ResultFolder(path)
    folder.open(manifest(config, {"name": "top-down"}))
    list(run_benchmark(config, planner, folder, **limits))
    return folder.rounds()


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> tuple[BenchmarkConfig, str]:
    config = BenchmarkConfig(SceneKind.PACKED, 2, (0, 3), TWO_OBJECTS)
    rounds = run_in(tmp_path_factory.mktemp("alone"), config)
    assert [(done.seed, done.index) for done in rounds] == [(0, 0), (0, 1), (3, 0), (3, 1)]
    return config, results.attempts_digest(rounds)


def test_rounds_of_a_crashed_worker_are_run_again_and_workers_change_nothing(
    alone: tuple[BenchmarkConfig, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, digest = alone
    (tmp_path / "dies_once.py").write_text(DIES_ONCE)
    monkeypatch.syspath_prepend(tmp_path)  # workers get it, too
    planner = importlib.import_module("dies_once").Planner
    rounds = run_in(tmp_path / "rounds", config, planner, workers=2)
    assert (tmp_path / "dies_once.died").exists()
    assert (tmp_path / "dies_once.closed").exists()
    assert results.attempts_digest(rounds) == digest
    made = run_tasks(partial(partial, time.sleep), (0, 600), workers=2)
    assert next(made) == (0, None)
    made.close()  # which does not wait for the other


def test_the_manifest_holds_what_decides_the_figures(engine: str) -> None:
    config = BenchmarkConfig(SceneKind.PACKED, 2, protocol=TWO_OBJECTS, engine=engine)
    facts = json.loads(json.dumps(manifest(config, {"name": "top-down"})))
    run = facts["run"]
    assert run["protocol"]["camera"]["polar_degrees"] == [45.0, 60.0]
    assert run["protocol"]["version"] == 3
    assert run["engine"] == engine
    assert run["constants"]["gravity"] == 9.81
    assert len(run["objects"]["digest"]) == 64
    assert facts["versions"][engine]
    assert facts["host"]["platform"]


def test_wrong_settings_are_refused(tmp_path: Path) -> None:
    for message, rounds, seeds in (
        ("rounds is 0", 0, (0,)),
        (r"seeds is \(-1,\)", 1, (-1,)),
        ("each seed once", 1, (1, 1)),
    ):
        with pytest.raises(ValueError, match=message):
            BenchmarkConfig(SceneKind.PILE, rounds, seeds)
    config = BenchmarkConfig(SceneKind.PILE, rounds=1)
    with pytest.raises(FileNotFoundError, match=r"no \*\.urdf, \*\.obj"):
        run_in(tmp_path / "rounds", replace(config, objects=tmp_path), workers=2)
    with pytest.raises(ValueError, match="workers is 0"):
        run_in(tmp_path / "rounds", config, workers=0)
    with pytest.raises(ValueError, match="returned <class 'int'>; return a PlannedGrasp or None"):
        run_in(tmp_path / "rounds", config, lambda: lambda *_: 7)


def test_a_killed_run_goes_on_and_changes_nothing(alone, tmp_path) -> None:
    config, digest = alone
    folder = results.ResultFolder(tmp_path)
    process = multiprocessing.get_context("spawn").Process(target=run_in, args=(tmp_path, config))
    process.start()
    while not list(folder.path.glob("rounds/*.json")):
        assert process.is_alive() or process.exitcode == 0
        time.sleep(0.005)
    process.kill()
    process.join()
    kept = len(folder.rounds())
    assert 1 <= kept <= 4
    assert len(list(run_benchmark(config, make_planner, folder))) == 4 - kept
    assert results.attempts_digest(folder.rounds()) == digest
    with pytest.raises(ValueError, match="different planner"):
        folder.open(manifest(config, {"name": "other"}))


def test_a_missing_ray_or_cluster_is_named(alone, tmp_path, monkeypatch) -> None:
    config, _ = alone
    with pytest.raises(ValueError, match="differ between the machines"):
        RoundRunner(config, make_planner, "another digest")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match=r"ray is not .*edgegrasp\[ray\]"):
        run_in(tmp_path, config, ray="local")
    deaf = Mock(init=Mock(side_effect=ConnectionError("nobody answers")))
    monkeypatch.setitem(sys.modules, "ray", deaf)
    with pytest.raises(RuntimeError, match=r"no Ray cluster at '127\.0\.0\.1:1': nobody"):
        run_in(tmp_path, config, ray="127.0.0.1:1")


def test_a_protocol_comes_back_from_a_manifest_or_a_file_beside_its_base(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text('base = "ur5-pile"\nname = "own"\n[camera]\nviews = 2\n')
    own, base = load_protocol(str(file)), load_protocol("ur5-pile")
    assert own == replace(base, name="own", camera=replace(base.camera, views=2))
    for name in protocol_names():
        protocol = load_protocol(name)
        assert protocol_from(json.loads(json.dumps(protocol.to_json()))) == replace(
            protocol, engine="", kind=None
        )


def test_the_side_view_is_where_giga_has_it() -> None:
    (view,) = load_protocol("giga").camera.sample(np.random.default_rng(0))
    expected = [0.15, 0.15 - 0.6 * np.sin(np.pi / 3), 0.10 + 0.6 * np.cos(np.pi / 3)]
    np.testing.assert_allclose(view[:3, 3], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("views = 1", "", "camera.views: Field required"),
        ("views = 1", "views = 1\nzoom = 2", "camera.zoom: Unexpected"),
        ("views = 1", "views = 0", "camera.views: .* greater than 0"),
        ("num_objects = [5]", "num_objects = []", "scene.num_objects: .* at least 1 item"),
        ("packed_scale = [0.7", "packed_scale = [nan", "scene.packed_scale"),
        ("packed_scale = [0.7", "packed_scale = [-0.7", "scene.packed_scale.0: .* greater than 0"),
        ("rounds = 100", "rounds = -1", "rounds: .* greater than 0"),
        ("min_score = 0.0", "min_score = 1.5", "planning.min_score: .* less than or equal to 1"),
        ("[noise]", "[noise]\ncorrelated_share = 2.0", "noise.correlated_share: .* equal to 1"),
        ("radius = [0.6", "radius = [0.9", "camera.radius: .* lower end first"),
        ("version = 3", 'version = 3\nbase = "vgn"\n[rounds]', "rounds: Input"),
        ('table = "known"', 'table = "guess"', "planning.table: .* 'known', 'seen', 'around'"),
        ("version = 3", "version = ", "protocol .*toml"),
        ("version = 3", 'version = 3\nbase = "nobody"', "base is 'nobody'; name one of bin"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = tmp_path / "own.toml"
    file.write_text((FOLDER / "edgegrasp.toml").read_text().replace(old, new))
    with pytest.raises(ValueError, match=message):
        load_protocol(str(file))


PACKED, PILE, *_ = SceneKind
IN_THE_AIR = np.diag([1.0, -1.0, -1.0, 1.0])
IN_THE_AIR[:3, 3] = (0.15, 0.15, 0.5)


def run(simulation, planner: Planner, scene: SceneKind, number: int, seed=0, index=0) -> Round:
    """A round with so many objects."""
    return RoundDriver(simulation, scene, paper_with(number), seed=seed, index=index).run(planner)


def test_two_failures_in_a_row_or_no_grasp_three_times_end_a_round(simulation) -> None:
    done = run(simulation, lambda seen, seed: PlannedGrasp(IN_THE_AIR, 1.0, 0.04), PACKED, 2)
    assert done.end is RoundEnd.FAILURES
    assert [(one.cause, one.target) for one in done.attempts] == [(FailureCause.MISSED, None)] * 2
    asked: list[tuple[int, int]] = []
    done = run(simulation, lambda seen, seed: asked.append((len(seen.cloud), seed)), PACKED, 2)
    assert done.end is RoundEnd.NO_GRASP
    assert (done.attempts, done.no_grasp) == ((), 3)  # it is no attempt
    clouds, seeds = zip(*asked, strict=True)
    assert len(set(seeds)) == 3
    assert len(set(clouds)) == 3  # a new view every time


def test_cubes_are_cleared_though_the_first_view_shows_nothing(engine: str, monkeypatch) -> None:
    views: list[Observation] = []
    cube = ObjectModel("cube", Path(__file__).parent / "cube.urdf", 1.2)
    observe_from = ClutterSimulation.observe_from

    def hidden_at_first(*args: object, **rules: object) -> Observation:
        views.append(observe_from(*args, **rules))
        return views[-1] if len(views) > 1 else replace(views[0], cloud=views[0].cloud[:0])

    monkeypatch.setattr(ClutterSimulation, "observe_from", hidden_at_first)
    with ClutterSimulation(ObjectSet("cubes", (cube,)), engine=engine) as cubes:
        done = RoundDriver(cubes, PACKED, paper_with(3), seed=0, index=0).run(plan)
    assert (done.end, done.no_grasp, done.successes) == (RoundEnd.CLEARED, 1, 3)
    for attempt in done.attempts:
        assert attempt.object == ("cube" if attempt.success else None)


def test_a_touch_is_of_something_seen_next_to_a_point_that_was_seen(simulation, monkeypatch):
    driver = RoundDriver(simulation, PACKED, paper_with(2), seed=0, index=0)
    point = driver.observe().cloud[0]
    for away, seen in ((0.005, True), (2.0, False)):
        touched = GraspResult(0.0, False, None, touched_on_the_way=(point + away,))
        monkeypatch.setattr(simulation, "execute_grasp", Mock(return_value=touched))
        attempt = driver.execute(PlannedGrasp(IN_THE_AIR, 1.0, 0.04))
        assert attempt.touched_on_the_way is True  # as JSON has it
        assert attempt.touched_seen is seen


def test_an_arm_that_cannot_start_in_a_view_takes_another_one(simulation) -> None:
    done = run(simulation, Mock(side_effect=trial.StartCollides), PACKED, 2)
    assert (done.end, done.no_grasp, done.start_collisions) == (RoundEnd.NO_GRASP, 3, 3)
    failures = results.summarise([done])["failures"]
    assert (failures["start in collision"], failures["no candidate"]) == (3, 0)


def test_scenes_and_views_do_not_depend_on_the_planner(engine, simulation) -> None:
    keep_first = Mock(return_value=PlannedGrasp(IN_THE_AIR, 1.0, 0.04))
    run(simulation, plan, PILE, 2, seed=4, index=0)
    run(simulation, keep_first, PILE, 2, seed=4, index=1)
    with ClutterSimulation(engine=engine) as other:
        run(other, keep_first, PILE, 2, seed=4, index=1)
    first_clouds = [call.args[0].cloud for call in keep_first.call_args_list]
    assert np.array_equal(first_clouds[0], first_clouds[2])


OF_A_MUG = "mug", "mug", False, 0.5, 0.04, 0.03, False, 0, 1000, 0.25
HELD = trial.Attempt(None, *OF_A_MUG, [[0.0] * 4] * 4)
MISSED = replace(HELD, cause=FailureCause.MISSED, object=None, planning_seconds=0.35)
WRONG = replace(HELD, object="cube", wrong_object=True, start_contact=True)
ROUNDS = [
    Round(0, 0, ("mug", "mug", "cube", "duck", "duck"), (HELD, MISSED, WRONG, MISSED, MISSED),
          0, RoundEnd.FAILURES),
    Round(1, 0, ("mug", "cube", "duck"), (HELD,), 3, RoundEnd.NO_GRASP),
]  # fmt: skip


def test_figures_count_as_the_reference_does() -> None:
    summary = results.summarise(ROUNDS)
    assert (summary["successes"], summary["attempts"], summary["objects"]) == (3, 6, 8)
    gsr, dr = summary["grasp_success_rate"], summary["declutter_rate"]
    assert gsr["value"] == pytest.approx(0.5)
    assert gsr["by_seed"] == {"0": pytest.approx(0.4), "1": 1.0}
    assert gsr["mean_over_seeds"] == pytest.approx(0.7)
    assert gsr["std_over_seeds"] == pytest.approx(0.3 * 2**0.5)
    assert dr["value"] == pytest.approx(3 / 8)
    assert summary["failures"]["missed"] == 3
    assert summary["failures"]["no candidate"] == 3
    assert sum(summary["failures"].values()) == 6
    assert summary["wrong_object_successes"] == 1
    assert summary["round_ends"] == {"consecutive failures": 1, "no grasp found": 1}
    assert summary["planning_seconds"]["mean"] == pytest.approx(0.3)
    objects = summary["objects_by_name"]
    assert objects["mug"] == {"present": 3, "removed": 2, "attempts": 6, "successes": 2}
    assert objects["cube"] == {"present": 2, "removed": 1, "attempts": 0, "successes": 0}


def test_objects_of_the_name_of_one_that_is_too_wide_are_left_out() -> None:
    both = replace(ROUNDS[0], objects=("mug", "mug"), too_wide=("mug",))
    others = results.summarise([both])["too_wide"]["declutter_rate_of_others"]
    assert others["value"] is None


def test_an_arm_s_figures_are_those_of_its_motions() -> None:
    held = replace(HELD, motion_seconds=3.75)
    missed = replace(held, object=None, cause=FailureCause.MISSED, touched_on_the_way=True)
    assert results.summarise([replace(ROUNDS[0], attempts=(held, missed))])["arm"] == {
        "picks_per_hour": pytest.approx(3600 / 8.0),
        "motion_seconds": 3.75,
        "touched_on_the_way": 1,
        "touched_seen": 0,
        "scenes_with_a_reachable_grasp": 1,
    }
    assert results.summarise(ROUNDS)["arm"] is None


def test_times_do_not_change_the_digest_and_outcomes_do() -> None:
    slower = replace(ROUNDS[1], attempts=(replace(HELD, planning_seconds=9.0),))
    assert results.attempts_digest([slower, ROUNDS[0]]) == results.attempts_digest(ROUNDS)
    failed = replace(ROUNDS[1], attempts=(MISSED,))
    assert results.attempts_digest([ROUNDS[0], failed]) != results.attempts_digest(ROUNDS)


def test_the_folder_holds_a_row_for_every_attempt(tmp_path: Path) -> None:
    folder = results.ResultFolder(tmp_path / "new")
    with pytest.raises(FileNotFoundError, match="contains no benchmark"):
        folder.rounds()
    protocol = {"name": "edgegrasp", "version": 1}
    folder.open({"run": {"scene": "pile", "engine": "mujoco", "protocol": protocol, "planner": {}}})
    for done in ROUNDS:
        folder.add(done)
    assert folder.rounds() == ROUNDS
    summary = folder.finish()
    assert json.loads(json.dumps(summary)) == json.loads((folder.path / "summary.json").read_text())
    with (folder.path / "attempts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert [row["cause"] for row in rows[:3]] == ["", "missed", ""]
    assert json.loads(rows[0]["T_world_hand"]) == HELD.T_world_hand
    assert not list(folder.path.rglob("*.tmp"))


def test_results_of_two_engines_are_kept_apart(tmp_path: Path) -> None:
    run = {"scene": "pile", "protocol": {"name": "edgegrasp", "version": 2}, "planner": {}}
    run |= {"objects": {}, "constants": {}}
    folders = results.ResultFolder(tmp_path / "before"), results.ResultFolder(tmp_path / "after")
    amount = {"seeds": [0, 1], "rounds": 2}
    before, after = ({"run": run | {"engine": name}, **amount} for name in ("pybullet", "mujoco"))
    for folder, facts in zip(folders, (before, after), strict=True):
        folder.open(facts)
        folder.add(ROUNDS[0])
    for other, name in (
        (after, "engine"),
        (before | {"run": run}, "engine"),
        (before | {"seeds": [2]}, "seeds"),
        (before | {"rounds": 1}, "rounds"),
    ):
        with pytest.raises(ValueError, match=f"different {name}"):
            folders[0].open(other)
    with pytest.raises(ValueError, match=r"differ in engine"):
        results.compare(*folders)
    with pytest.raises(ValueError, match="engine 'pybullet', not 'mujoco'"):
        results.gate_failures(folders[1].finish(), gate_file(tmp_path))


def gate_file(path: Path) -> Path:
    """Nine of ten grasps hold."""
    file = path / "gate.json"
    file.write_text(json.dumps(summary_with({"value": 0.9, "wilson_95": results.wilson(90, 100)})))
    return file


def summary_with(rate: dict[str, object]) -> dict[str, object]:
    of = {"scene": "pile", "engine": "pybullet", "protocol": "edgegrasp", "protocol_version": 1}
    return of | {"grasp_success_rate": rate, "declutter_rate": rate}


def test_the_gate_lets_chance_pass_and_stops_a_fall(tmp_path: Path) -> None:
    gate = gate_file(tmp_path)
    assert results.gate_failures(summary_with({"value": 0.85}), gate) == []
    below = results.gate_failures(summary_with({"value": 0.80}), gate)
    assert [text.split()[0] for text in below] == ["GSR", "DR"]
    assert results.gate_failures(summary_with({"value": None}), gate)
    with pytest.raises(ValueError, match="scene 'pile', not 'packed'"):
        results.gate_failures(summary_with({"value": 0.9}) | {"scene": "packed"}, gate)
    gate.write_text("{}")
    with pytest.raises(ValueError, match=r"not a summary\.json"):
        results.gate_failures(summary_with({"value": 0.9}), gate)
