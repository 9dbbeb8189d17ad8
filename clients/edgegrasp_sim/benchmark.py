"""Many rounds of clutter removal, and what they say about a planner."""

from __future__ import annotations

import json
import multiprocessing
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, TypeAlias

from edgegrasp_sim import grasping, gripper, scene, trials, world
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.simulation import NOISE_STD, ClutterSimulation
from edgegrasp_sim.trials import NUM_OBJECTS, Planner, Round, run_round

if TYPE_CHECKING:
    from pathlib import Path

# Makes the planner in the process that uses it; must be picklable if there are several.
PlannerFactory: TypeAlias = Callable[[], Planner]


@dataclass(frozen=True, slots=True)
class BenchmarkConfig:
    """What to run.

    Attributes:
        scene: kind of the scenes.
        rounds: how many.
        seed: with a round's number it gives the round's scene, views and noise.
        objects: folder in the layout `<scene>/<split>/*.urdf`; the built-in set if None.
        split: of that folder.
        num_objects: how many objects to try to place in each scene.
        noise_std: of the points seen, metres.
        start_contact_fails: see `ClutterSimulation`.
    """

    scene: SceneKind
    rounds: int
    seed: int
    objects: Path | None = None
    split: str = "test"
    num_objects: int = NUM_OBJECTS
    noise_std: float = NOISE_STD
    start_contact_fails: bool = False

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; run at least 1")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; pass 0 or more")
        if not self.noise_std >= 0:
            raise ValueError(f"noise_std is {self.noise_std}; pass 0 or more, in metres")

    def object_set(self) -> ObjectSet:
        """The objects to draw scenes from.

        Raises:
            FileNotFoundError: `objects` does not hold this scene and split.
        """
        if self.objects is None:
            return ObjectSet.builtin(self.scene)
        return ObjectSet.from_folder(self.objects, self.scene, self.split)


@dataclass(frozen=True, slots=True)
class BenchmarkReport:
    """What came of a benchmark.

    Attributes:
        config: what was run.
        rounds: in order of their index.
        seconds: wall-clock time of it all.
    """

    config: BenchmarkConfig
    rounds: tuple[Round, ...]
    seconds: float

    @property
    def attempts(self) -> int:
        """Grasps executed."""
        return sum(len(item.attempts) for item in self.rounds)

    @property
    def successes(self) -> int:
        """Objects removed by grasping."""
        return sum(item.successes for item in self.rounds)

    @property
    def objects(self) -> int:
        """Objects present after the resets."""
        return sum(item.objects for item in self.rounds)

    @property
    def grasp_success_rate(self) -> float | None:
        """GSR: successes / attempts; None without attempts."""
        return self.successes / self.attempts if self.attempts else None

    @property
    def declutter_rate(self) -> float | None:
        """DR: successes / objects present after the reset; None without objects."""
        return self.successes / self.objects if self.objects else None

    def summary(self) -> dict[str, Any]:
        """The figures, ready for JSON."""
        attempts = [attempt for item in self.rounds for attempt in item.attempts]
        failed = [attempt for attempt in attempts if attempt.object is None]
        planning = [attempt.planning_seconds for attempt in attempts]
        return {
            "grasp_success_rate": self.grasp_success_rate,
            "declutter_rate": self.declutter_rate,
            "successes": self.successes,
            "attempts": self.attempts,
            "objects": self.objects,
            "failures": {
                **Counter(attempt.outcome.value for attempt in failed),
                "no candidate": sum(item.no_grasp for item in self.rounds),
            },
            "round_ends": dict(Counter(item.end.value for item in self.rounds)),
            "start_contacts": sum(attempt.start_contact for attempt in attempts),
            "successes_without_start_contact": sum(
                attempt.object is not None and not attempt.start_contact for attempt in attempts
            ),
            "planning_seconds_mean": sum(planning) / len(planning) if planning else None,
            "seconds": self.seconds,
        }

    def to_json(self, planner: dict[str, Any] | None = None) -> dict[str, Any]:
        """Everything, ready for JSON.

        Args:
            planner: how the grasps were planned (model, options), to keep with the figures.
        """
        return {
            "summary": self.summary(),
            "manifest": {**manifest(self.config), "planner": planner or {}},
            "rounds": [asdict(item) for item in self.rounds],
        }

    def write_json(self, path: Path, planner: dict[str, Any] | None = None) -> None:
        """Write `to_json` to a file; makes its folder."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.to_json(planner), indent=1) + "\n")


def run_benchmark(
    config: BenchmarkConfig,
    make_planner: PlannerFactory,
    *,
    workers: int = 1,
    on_round: Callable[[Round], None] | None = None,
) -> BenchmarkReport:
    """Run all rounds; the outcomes do not depend on `workers`.

    Args:
        config: what to run.
        make_planner: called once in every process.
        workers: processes; with 1 all runs in this one.
        on_round: told of every round as it is done, in order.

    Raises:
        ValueError: `workers` below 1, or the planner's pose is no rigid transform.
        FileNotFoundError: the object folder does not hold the scene.
    """
    if workers < 1:
        raise ValueError(f"workers is {workers}; use at least 1")
    config.object_set()  # a wrong folder shall fail here, not in every worker
    started = time.perf_counter()
    rounds = []
    run = (
        _run_here(config, make_planner)
        if workers == 1
        else _run_pool(config, make_planner, workers)
    )
    for item in run:
        rounds.append(item)
        if on_round is not None:
            on_round(item)
    return BenchmarkReport(config, tuple(rounds), time.perf_counter() - started)


def manifest(config: BenchmarkConfig) -> dict[str, Any]:
    """What is needed to get the same figures again."""
    settings = asdict(config)
    settings["objects"] = config.objects.name if config.objects is not None else "builtin"
    return {
        "config": settings,
        "object_set": config.object_set().name,
        "constants": {
            "time_step": world.TIME_STEP,
            "solver_iterations": world.SOLVER_ITERATIONS,
            "workspace_size": scene.SIZE,
            "table_height": scene.TABLE_HEIGHT,
            "object_mass": scene.OBJECT_MASS,
            "object_friction": scene.OBJECT_FRICTION,
            "finger_friction": gripper.FINGER_FRICTION,
            "gear_force": gripper.GEAR_FORCE,
            "tool_force": gripper.TOOL_FORCE,
            "pregrasp_distance": grasping.PREGRASP_DISTANCE,
            "retreat_distance": grasping.RETREAT_DISTANCE,
            "step_length": grasping.STEP_LENGTH,
            "min_opening": grasping.MIN_OPENING,
            "max_consecutive_failures": trials.MAX_CONSECUTIVE_FAILURES,
            "max_no_grasp": trials.MAX_NO_GRASP,
            "min_points": trials.MIN_POINTS,
        },
        "versions": {
            "python": platform.python_version(),
            **{name: _version(name) for name in ("edgegrasp", "numpy", "pybullet")},
        },
    }


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


class _Runner:
    """A simulation with a planner, for one process."""

    def __init__(self, config: BenchmarkConfig, make_planner: PlannerFactory) -> None:
        self.config = config
        self.simulation = ClutterSimulation(
            {config.scene: config.object_set()}, start_contact_fails=config.start_contact_fails
        )
        self.planner = make_planner()

    def run(self, index: int) -> Round:
        config = self.config
        return run_round(
            self.simulation,
            self.planner,
            config.scene,
            seed=config.seed,
            index=index,
            num_objects=config.num_objects,
            noise_std=config.noise_std,
        )


def _run_here(config: BenchmarkConfig, make_planner: PlannerFactory) -> Iterator[Round]:
    runner = _Runner(config, make_planner)
    try:
        yield from map(runner.run, range(config.rounds))
    finally:
        runner.simulation.close()


_worker: _Runner | None = None  # one in each worker process, made by its initialiser


def _start_worker(config: BenchmarkConfig, make_planner: PlannerFactory) -> None:
    global _worker
    _worker = _Runner(config, make_planner)


def _run_in_worker(index: int) -> Round:
    assert _worker is not None
    return _worker.run(index)


def _run_pool(
    config: BenchmarkConfig, make_planner: PlannerFactory, workers: int
) -> Iterator[Round]:
    # Forked children would share the parent's physics servers and threads.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        workers, context, initializer=_start_worker, initargs=(config, make_planner)
    ) as pool:
        yield from pool.map(_run_in_worker, range(config.rounds))
