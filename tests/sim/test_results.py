import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from edgegrasp_sim.hand import FailureCause
from edgegrasp_sim.results import (
    ResultFolder,
    attempts_digest,
    below_gate,
    compare,
    summarise,
    wilson,
)
from edgegrasp_sim.trial import Attempt, Round, RoundEnd

HELD = Attempt(
    None, "mug", "mug", False, 0.5, 0.04, 0.03, False, 0, 1000, 0.25,
    [[0.0] * 4] * 4,
)  # fmt: skip
MISSED = replace(HELD, cause=FailureCause.MISSED, object=None, planning_seconds=0.35)
WRONG = replace(HELD, object="cube", wrong_object=True, start_contact=True)
ROUNDS = [
    Round(0, 0, ("mug", "mug", "cube", "duck", "duck"), (HELD, MISSED, WRONG, MISSED, MISSED),
          0, RoundEnd.FAILURES),
    Round(1, 0, ("mug", "cube", "duck"), (HELD,), 3, RoundEnd.NO_GRASP),
]  # fmt: skip


def test_figures_count_as_the_reference_does() -> None:
    summary = summarise(ROUNDS)
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


def test_an_arm_s_figures_are_those_of_its_motions() -> None:
    held = replace(HELD, motion_seconds=3.75)
    missed = replace(held, object=None, cause=FailureCause.MISSED, touched_on_the_way=True)
    assert summarise([replace(ROUNDS[0], attempts=(held, missed))])["arm"] == {
        "picks_per_hour": pytest.approx(3600 / 8.0),
        "motion_seconds": 3.75,
        "touched_on_the_way": 1,
        "scenes_with_a_reachable_grasp": 1,
    }
    assert summarise(ROUNDS)["arm"] is None


def test_times_do_not_change_the_digest_and_outcomes_do() -> None:
    slower = replace(ROUNDS[1], attempts=(replace(HELD, planning_seconds=9.0),))
    assert attempts_digest([slower, ROUNDS[0]]) == attempts_digest(ROUNDS)
    failed = replace(ROUNDS[1], attempts=(MISSED,))
    assert attempts_digest([ROUNDS[0], failed]) != attempts_digest(ROUNDS)


def test_the_folder_holds_a_row_for_every_attempt(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "new")
    with pytest.raises(FileNotFoundError, match="contains no benchmark"):
        folder.rounds()
    protocol = {"name": "edgegrasp", "version": 1}
    folder.open({"run": {"scene": "pile", "engine": "mujoco", "protocol": protocol, "planner": {}}})
    for done in ROUNDS:
        folder.add(done)
    assert folder.rounds() == ROUNDS
    summary = folder.finish(folder.rounds())
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
    folders = ResultFolder(tmp_path / "before"), ResultFolder(tmp_path / "after")
    amount = {"seeds": [0, 1], "rounds": 2}
    folders[0].open({"run": run | {"engine": "pybullet"}, **amount})
    folders[1].open({"run": run | {"engine": "mujoco"}, **amount})
    for folder in folders:
        folder.add(ROUNDS[0])
    with pytest.raises(ValueError, match=r"different engine"):
        folders[0].open({"run": run | {"engine": "mujoco"}, **amount})
    with pytest.raises(ValueError, match=r"different engine"):
        folders[0].open({"run": run, **amount})
    for less in ({"seeds": [2]}, {"rounds": 1}):
        with pytest.raises(ValueError, match=f"different {next(iter(less))}"):
            folders[0].open({"run": run | {"engine": "pybullet"}, **amount | less})
    with pytest.raises(ValueError, match=r"differ in engine"):
        compare(*folders)
    gate = gate_file(tmp_path, 90, 100)
    with pytest.raises(ValueError, match="engine 'pybullet', not 'mujoco'"):
        below_gate(folders[1].finish(ROUNDS), gate)


def gate_file(path: Path, successes: int, attempts: int) -> Path:
    rate = {"value": successes / attempts, "wilson_95": wilson(successes, attempts)}
    file = path / "gate.json"
    file.write_text(json.dumps(summary_with(rate)))
    return file


def summary_with(rate: dict[str, object]) -> dict[str, object]:
    return {
        "scene": "pile",
        "engine": "pybullet",
        "protocol": "edgegrasp",
        "protocol_version": 1,
        "grasp_success_rate": rate,
        "declutter_rate": rate,
    }


def test_the_gate_lets_chance_pass_and_stops_a_fall(tmp_path: Path) -> None:
    gate = gate_file(tmp_path, 90, 100)
    assert below_gate(summary_with({"value": 0.85}), gate) == []
    below = below_gate(summary_with({"value": 0.80}), gate)
    assert [text.split()[0] for text in below] == ["GSR", "DR"]
    assert below_gate(summary_with({"value": None}), gate)
    with pytest.raises(ValueError, match="scene 'pile', not 'packed'"):
        below_gate(summary_with({"value": 0.9}) | {"scene": "packed"}, gate)
    gate.write_text("{}")
    with pytest.raises(ValueError, match=r"not a summary\.json"):
        below_gate(summary_with({"value": 0.9}), gate)
