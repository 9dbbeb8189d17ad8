from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from edgegrasp_sim import trials
from edgegrasp_sim.hand import FailureCause, GraspOutcome
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.protocol import Protocol, load_protocol
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.top_down import plan_top_down
from edgegrasp_sim.trial import (
    PlannedGrasp,
    PlannerUnavailableError,
    Round,
    RoundDriver,
    RoundEnd,
    run_round,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import ArrayLike

    from edgegrasp_sim.camera import Observation
    from edgegrasp_sim.hand import GraspResult

IN_THE_AIR = np.diag([1.0, -1.0, -1.0, 1.0])
IN_THE_AIR[:3, 3] = (0.15, 0.15, 0.5)


def protocol(num_objects: int = 5) -> Protocol:
    paper = load_protocol("edgegrasp")
    return replace(paper, scene=replace(paper.scene, num_objects=(num_objects,)))


@pytest.fixture(scope="module")
def simulation() -> Iterator[ClutterSimulation]:
    with ClutterSimulation() as simulation:
        yield simulation


def without_times(done: Round) -> list[object]:
    return [
        (attempt.outcome, attempt.object, attempt.opening, attempt.points, attempt.T_world_hand)
        for attempt in done.attempts
    ]


def test_top_down_grasps_clear_a_scene_of_cubes() -> None:
    cubes = ObjectSet("cubes", ObjectSet.builtin(SceneKind.PACKED).models[:1])
    with ClutterSimulation({SceneKind.PACKED: cubes}) as simulation:
        done = run_round(simulation, plan_top_down, SceneKind.PACKED, protocol(3), seed=0, index=0)
    assert done.end is RoundEnd.CLEARED
    assert done.successes == len(done.objects) == 3
    assert all(
        attempt.object == ("cube" if attempt.outcome is GraspOutcome.SUCCESS else None)
        for attempt in done.attempts
    )


@pytest.mark.parametrize("scene", SceneKind)
def test_top_down_grasps_find_builtin_objects(
    simulation: ClutterSimulation, scene: SceneKind
) -> None:
    rounds = [
        run_round(simulation, plan_top_down, scene, protocol(), seed=0, index=index)
        for index in range(4)
    ]
    objects = sum(len(done.objects) for done in rounds)
    successes = sum(done.successes for done in rounds)
    assert objects >= 12
    assert successes >= 0.3 * objects


def test_two_failures_in_a_row_end_a_round(simulation: ClutterSimulation) -> None:
    done = run_round(
        simulation,
        lambda seen, seed: PlannedGrasp(IN_THE_AIR, 1.0, 0.04),
        SceneKind.PACKED,
        protocol(2),
        seed=0,
        index=0,
    )
    assert done.end is RoundEnd.FAILURES
    assert [attempt.outcome for attempt in done.attempts] == [GraspOutcome.AFTER] * 2
    assert [attempt.cause for attempt in done.attempts] == [FailureCause.MISSED] * 2
    assert [attempt.target for attempt in done.attempts] == [None] * 2


def test_no_grasp_is_no_attempt_and_the_third_ends_a_round(simulation: ClutterSimulation) -> None:
    clouds: list[int] = []
    seeds: list[int] = []

    def planner(seen: Observation, seed: int) -> None:
        clouds.append(len(seen.cloud))
        seeds.append(seed)

    done = run_round(simulation, planner, SceneKind.PACKED, protocol(2), seed=0, index=0)
    assert done.end is RoundEnd.NO_GRASP
    assert (done.attempts, done.no_grasp) == ((), 3)
    assert len(set(seeds)) == 3
    assert len(set(clouds)) == 3  # a new view every time


def test_scenes_and_views_do_not_depend_on_the_planner(simulation: ClutterSimulation) -> None:
    first_clouds = []

    def keep_first(seen: Observation, seed: int) -> PlannedGrasp:
        first_clouds.append(seen.cloud)
        return PlannedGrasp(IN_THE_AIR, 1.0, 0.04)

    run_round(simulation, plan_top_down, SceneKind.PILE, protocol(2), seed=4, index=0)
    run_round(simulation, keep_first, SceneKind.PILE, protocol(2), seed=4, index=1)
    with ClutterSimulation() as other:
        run_round(other, keep_first, SceneKind.PILE, protocol(2), seed=4, index=1)
    assert np.array_equal(first_clouds[0], first_clouds[2])


def test_a_round_repeats_exactly(simulation: ClutterSimulation) -> None:
    first = run_round(simulation, plan_top_down, SceneKind.PILE, protocol(3), seed=0, index=2)
    run_round(simulation, plan_top_down, SceneKind.PACKED, protocol(1), seed=0, index=0)
    again = run_round(simulation, plan_top_down, SceneKind.PILE, protocol(3), seed=0, index=2)
    other = run_round(simulation, plan_top_down, SceneKind.PILE, protocol(3), seed=1, index=2)
    assert without_times(first) == without_times(again) != without_times(other)


def test_negative_seed_is_refused(simulation: ClutterSimulation) -> None:
    with pytest.raises(ValueError, match="seed is -1"):
        run_round(simulation, plan_top_down, SceneKind.PILE, protocol(), seed=-1, index=0)


def test_an_unavailable_planner_is_asked_again_and_changes_nothing(
    simulation: ClutterSimulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "FIRST_WAIT", 0.001)
    asked = 0

    def away_at_times(seen: Observation, seed: int) -> PlannedGrasp | None:
        nonlocal asked
        asked += 1
        if asked % 3:
            raise PlannerUnavailableError("restarting")
        return plan_top_down(seen, seed)

    rules = protocol(2)
    calm = run_round(simulation, plan_top_down, SceneKind.PACKED, rules, seed=0, index=0)
    shaken = run_round(simulation, away_at_times, SceneKind.PACKED, rules, seed=0, index=0)
    assert without_times(calm) == without_times(shaken)
    assert calm.retries == 0
    assert shaken.retries == 2 * len(shaken.attempts)
    assert shaken.waited_seconds > 0


def test_patience_with_an_unavailable_planner_ends(simulation: ClutterSimulation) -> None:
    def away(seen: Observation, seed: int) -> None:
        raise PlannerUnavailableError("gone for good")

    with pytest.raises(PlannerUnavailableError, match="gone for good"):
        run_round(simulation, away, SceneKind.PACKED, protocol(1), seed=0, index=0, patience=0.0)


def test_a_planner_may_try_grasps_in_the_scene(simulation: ClutterSimulation) -> None:
    class Careful:
        """Only executes what held when tried."""

        def use_trial(self, try_grasp: Callable[[ArrayLike], GraspResult]) -> None:
            self.try_grasp = try_grasp

        def __call__(self, seen: Observation, seed: int) -> PlannedGrasp | None:
            grasp = plan_top_down(seen, seed)
            holds = grasp is not None and self.try_grasp(grasp.T_world_hand).success
            return grasp if holds else None

    done = run_round(simulation, Careful(), SceneKind.PACKED, protocol(3), seed=0, index=0)
    assert done.attempts
    assert done.successes == len(done.attempts)


def test_a_round_can_be_driven_by_hand() -> None:
    cubes = ObjectSet("cubes", ObjectSet.builtin(SceneKind.PACKED).models[:1])
    with ClutterSimulation({SceneKind.PACKED: cubes}) as simulation:
        driver = RoundDriver(simulation, SceneKind.PACKED, protocol(1), seed=0, index=0)
        grasp = driver.plan(plan_top_down, driver.look())
        assert grasp is not None
        attempt = driver.execute(grasp)
    assert attempt.success
    assert attempt.target == attempt.object == "cube"
    assert driver.end is RoundEnd.CLEARED
    assert driver.result().attempts == (attempt,)


@pytest.mark.parametrize("name", ["giga", "vgn", "robot"])
def test_other_protocols_run(simulation: ClutterSimulation, name: str) -> None:
    rules = load_protocol(name)
    driver = RoundDriver(simulation, SceneKind.PACKED, rules, seed=0, index=0)
    seen = driver.look()
    assert len(seen.camera_positions) == rules.camera.views
    assert set(seen.view_ids) == set(range(rules.camera.views))
    on_table = np.abs(seen.cloud[:, 2] - seen.table_height) < 0.003
    assert (on_table.mean() > 0.3) == (name == "robot")
