from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING

import pytest

from edgegrasp_sim.benchmark import BenchmarkConfig, BenchmarkReport, run_benchmark
from edgegrasp_sim.grasping import GraspOutcome
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.top_down import plan_top_down
from edgegrasp_sim.trials import Attempt, Round, RoundEnd

if TYPE_CHECKING:
    from pathlib import Path

# Called, it gives the planner; spawned workers can import it.
make_planner = partial(partial, plan_top_down)


def attempt(outcome: GraspOutcome, *, start_contact: bool = False) -> Attempt:
    held = "mug" if outcome is GraspOutcome.SUCCESS else None
    return Attempt(outcome, held, 0.5, 0.04, 0.03, start_contact, 1000, 0.25, [[0.0] * 4] * 4)


def test_rates_count_as_the_reference_does() -> None:
    success, failure = attempt(GraspOutcome.SUCCESS), attempt(GraspOutcome.AFTER)
    pushed = attempt(GraspOutcome.SUCCESS, start_contact=True)
    report = BenchmarkReport(
        BenchmarkConfig(SceneKind.PILE, rounds=2, seed=0),
        (
            Round(0, 5, (success, failure, pushed, failure, failure), 0, RoundEnd.FAILURES),
            Round(1, 3, (), 3, RoundEnd.NO_GRASP),
        ),
        seconds=1.0,
    )
    assert report.grasp_success_rate == pytest.approx(2 / 5)
    assert report.declutter_rate == pytest.approx(2 / 8)
    summary = report.summary()
    assert summary["failures"] == {"after": 3, "no candidate": 3}
    assert summary["round_ends"] == {"consecutive failures": 1, "no grasp found": 1}
    assert summary["successes_without_start_contact"] == 1
    assert summary["planning_seconds_mean"] == 0.25


def test_rates_of_nothing_are_none() -> None:
    config = BenchmarkConfig(SceneKind.PILE, rounds=1, seed=0)
    empty = BenchmarkReport(config, (Round(0, 0, (), 0, RoundEnd.CLEARED),), 1.0)
    assert empty.grasp_success_rate is None
    assert empty.declutter_rate is None
    assert empty.summary()["planning_seconds_mean"] is None


def test_workers_change_nothing_and_the_report_is_written(tmp_path: Path) -> None:
    config = BenchmarkConfig(SceneKind.PACKED, rounds=2, seed=0, num_objects=2)
    told: list[int] = []
    alone = run_benchmark(config, make_planner, on_round=lambda done: told.append(done.index))
    shared = run_benchmark(config, make_planner, workers=2)
    assert told == [0, 1]

    def outcomes(report: BenchmarkReport) -> list[object]:
        return [
            (done.objects, done.end, [(one.outcome, one.opening) for one in done.attempts])
            for done in report.rounds
        ]

    assert outcomes(alone) == outcomes(shared)

    path = tmp_path / "new" / "report.json"
    alone.write_json(path, planner={"model": "top-down"})
    written = json.loads(path.read_text())
    assert written["summary"]["successes"] == alone.successes
    assert written["manifest"]["planner"] == {"model": "top-down"}
    assert written["manifest"]["config"]["objects"] == "builtin"
    assert written["manifest"]["constants"]["solver_iterations"] == 100
    assert written["manifest"]["versions"]["pybullet"]
    assert len(written["rounds"]) == 2
    assert written["rounds"][0]["attempts"][0]["outcome"] in list(GraspOutcome)


def test_wrong_settings_are_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rounds is 0"):
        BenchmarkConfig(SceneKind.PILE, rounds=0, seed=0)
    with pytest.raises(ValueError, match="seed is -1"):
        BenchmarkConfig(SceneKind.PILE, rounds=1, seed=-1)
    with pytest.raises(ValueError, match="noise_std is nan"):
        BenchmarkConfig(SceneKind.PILE, rounds=1, seed=0, noise_std=float("nan"))
    config = BenchmarkConfig(SceneKind.PILE, rounds=1, seed=0, objects=tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no \*\.urdf files"):
        run_benchmark(config, make_planner, workers=2)
    with pytest.raises(ValueError, match="workers is 0"):
        run_benchmark(config, make_planner, workers=0)
