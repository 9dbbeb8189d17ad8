from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from edgegrasp_sim.grasping import GraspOutcome
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.simulation import ClutterSimulation, Observation
from edgegrasp_sim.top_down import plan_top_down
from edgegrasp_sim.trials import PlannedGrasp, Round, RoundEnd, run_round

if TYPE_CHECKING:
    from collections.abc import Iterator

IN_THE_AIR = np.diag([1.0, -1.0, -1.0, 1.0])
IN_THE_AIR[:3, 3] = (0.15, 0.15, 0.5)


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
        done = run_round(simulation, plan_top_down, "packed", seed=0, index=0, num_objects=3)
    assert done.end is RoundEnd.CLEARED
    assert done.successes == done.objects == 3
    assert all(
        attempt.object == ("cube" if attempt.outcome is GraspOutcome.SUCCESS else None)
        for attempt in done.attempts
    )


@pytest.mark.parametrize("scene", SceneKind)
def test_top_down_grasps_find_builtin_objects(
    simulation: ClutterSimulation, scene: SceneKind
) -> None:
    rounds = [
        run_round(simulation, plan_top_down, scene, seed=0, index=index) for index in range(4)
    ]
    objects = sum(done.objects for done in rounds)
    successes = sum(done.successes for done in rounds)
    assert objects >= 12
    assert successes >= 0.3 * objects


def test_two_failures_in_a_row_end_a_round(simulation: ClutterSimulation) -> None:
    done = run_round(
        simulation,
        lambda seen, seed: PlannedGrasp(IN_THE_AIR, 1.0, 0.04),
        "packed",
        seed=0,
        index=0,
        num_objects=2,
    )
    assert done.end is RoundEnd.FAILURES
    assert [attempt.outcome for attempt in done.attempts] == [GraspOutcome.AFTER] * 2


def test_no_grasp_is_no_attempt_and_the_third_ends_a_round(simulation: ClutterSimulation) -> None:
    clouds: list[int] = []
    seeds: list[int] = []

    def planner(seen: Observation, seed: int) -> None:
        clouds.append(len(seen.cloud))
        seeds.append(seed)

    done = run_round(simulation, planner, "packed", seed=0, index=0, num_objects=2)
    assert done.end is RoundEnd.NO_GRASP
    assert (done.attempts, done.no_grasp) == ((), 3)
    assert len(set(seeds)) == 3
    assert len(set(clouds)) == 3  # a new view every time


def test_scenes_and_views_do_not_depend_on_the_planner(simulation: ClutterSimulation) -> None:
    first_clouds = []

    def keep_first(seen: Observation, seed: int) -> PlannedGrasp:
        first_clouds.append(seen.cloud)
        return PlannedGrasp(IN_THE_AIR, 1.0, 0.04)

    run_round(simulation, plan_top_down, "pile", seed=4, index=0, num_objects=2)
    run_round(simulation, keep_first, "pile", seed=4, index=1, num_objects=2)
    with ClutterSimulation() as other:
        run_round(other, keep_first, "pile", seed=4, index=1, num_objects=2)
    assert np.array_equal(first_clouds[0], first_clouds[2])


def test_a_round_repeats_exactly(simulation: ClutterSimulation) -> None:
    first = run_round(simulation, plan_top_down, "pile", seed=0, index=2, num_objects=3)
    run_round(simulation, plan_top_down, "packed", seed=0, index=0, num_objects=1)
    again = run_round(simulation, plan_top_down, "pile", seed=0, index=2, num_objects=3)
    other = run_round(simulation, plan_top_down, "pile", seed=1, index=2, num_objects=3)
    assert without_times(first) == without_times(again) != without_times(other)


def test_negative_seed_is_refused(simulation: ClutterSimulation) -> None:
    with pytest.raises(ValueError, match="seed is -1"):
        run_round(simulation, plan_top_down, "pile", seed=-1, index=0)
