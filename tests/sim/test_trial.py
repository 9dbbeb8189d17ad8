"""A round of clutter removal, and what a person sees of it."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from examples.your_planner import plan

from edgegrasp_sim.camera import Observation
from edgegrasp_sim.hand import FailureCause
from edgegrasp_sim.objects import ObjectModel, ObjectSet, SceneKind
from edgegrasp_sim.protocol import Protocol
from edgegrasp_sim.results import summarise
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import PlannedGrasp, Planner, Round, RoundDriver, RoundEnd, StartCollides

MakeProtocol = Callable[[int], Protocol]
PACKED, PILE, *_ = SceneKind
IN_THE_AIR = np.diag([1.0, -1.0, -1.0, 1.0])
IN_THE_AIR[:3, 3] = (0.15, 0.15, 0.5)


@pytest.fixture
def run(simulation: ClutterSimulation, paper_with: MakeProtocol) -> Callable[..., Round]:
    """Runs a round with so many objects."""

    def run(
        planner: Planner,
        scene: SceneKind,
        number: int,
        seed: int = 0,
        index: int = 0,
    ) -> Round:
        driver = RoundDriver(simulation, scene, paper_with(number), seed=seed, index=index)
        return driver.run(planner)

    return run


@pytest.fixture(scope="module")
def cubes(engine: str) -> Iterator[ClutterSimulation]:
    cube = ObjectModel("cube", Path(__file__).parent / "cube.urdf", 1.2)
    with ClutterSimulation({PACKED: ObjectSet("cubes", (cube,))}, engine=engine) as simulation:
        yield simulation


def test_top_down_grasps_clear_a_scene_of_cubes(cubes, paper_with) -> None:
    done = RoundDriver(cubes, PACKED, paper_with(3), seed=0, index=0).run(plan)
    assert done.end is RoundEnd.CLEARED
    assert done.successes == len(done.objects) == 3
    for attempt in done.attempts:
        assert attempt.object == ("cube" if attempt.success else None)


def test_two_failures_in_a_row_end_a_round(run: Callable[..., Round]) -> None:
    done = run(lambda seen, seed: PlannedGrasp(IN_THE_AIR, 1.0, 0.04), PACKED, 2)
    assert done.end is RoundEnd.FAILURES
    found = [(attempt.cause, attempt.target) for attempt in done.attempts]
    assert found == [(FailureCause.MISSED, None)] * 2


def test_no_grasp_is_no_attempt_and_the_third_ends_a_round(run: Callable[..., Round]) -> None:
    clouds: list[int] = []
    seeds: list[int] = []

    def planner(seen: Observation, seed: int) -> None:
        clouds.append(len(seen.cloud))
        seeds.append(seed)

    done = run(planner, PACKED, 2)
    assert done.end is RoundEnd.NO_GRASP
    assert (done.attempts, done.no_grasp) == ((), 3)
    assert len(set(seeds)) == 3
    assert len(set(clouds)) == 3  # a new view every time


def test_a_view_that_shows_nothing_is_one_without_a_grasp(cubes, paper_with, monkeypatch) -> None:
    views: list[Observation] = []
    observe_from = cubes.observe_from

    def hidden_at_first(*args: object, **rules: object) -> Observation:
        views.append(observe_from(*args, **rules))
        return views[-1] if len(views) > 1 else replace(views[0], cloud=views[0].cloud[:0])

    monkeypatch.setattr(cubes, "observe_from", hidden_at_first)
    done = RoundDriver(cubes, PACKED, paper_with(3), seed=0, index=0).run(plan)
    assert (done.end, done.no_grasp, done.successes) == (RoundEnd.CLEARED, 1, 3)


def test_an_arm_that_cannot_start_in_a_view_takes_another_one(run: Callable[..., Round]) -> None:
    def planner(seen: Observation, seed: int) -> None:
        raise StartCollides

    done = run(planner, PACKED, 2)
    assert (done.end, done.no_grasp, done.start_collisions) == (RoundEnd.NO_GRASP, 3, 3)
    failures = summarise([done])["failures"]
    assert (failures["start in collision"], failures["no candidate"]) == (3, 0)


def test_scenes_and_views_do_not_depend_on_the_planner(engine, run, paper_with) -> None:
    first_clouds = []

    def keep_first(seen: Observation, seed: int) -> PlannedGrasp:
        first_clouds.append(seen.cloud)
        return PlannedGrasp(IN_THE_AIR, 1.0, 0.04)

    run(plan, PILE, 2, seed=4, index=0)
    run(keep_first, PILE, 2, seed=4, index=1)
    with ClutterSimulation(engine=engine) as other:
        RoundDriver(other, PILE, paper_with(2), seed=4, index=1).run(keep_first)
    assert np.array_equal(first_clouds[0], first_clouds[2])
