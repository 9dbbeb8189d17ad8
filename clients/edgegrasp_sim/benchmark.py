"""Many rounds of clutter removal, in one process or several, resumable."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import platform
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, TypeAlias

from edgegrasp_sim import grasping, gripper, scene, trials, world
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.protocol import Protocol, load_protocol
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trials import PATIENCE, Closes, Planner, Round, run_round
from edgegrasp_sim.window import ShownPlanner, Window

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from edgegrasp_sim.results import ResultFolder

# Makes the planner in the process that uses it; must be picklable if there are several.
PlannerFactory: TypeAlias = Callable[[], Planner]
Task: TypeAlias = tuple[int, int]  # seed and index of a round

MAX_CRASHES = 3  # in a row without a finished round between them
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
PACKAGES = ("edgegrasp", "numpy", "scipy", "pybullet", "torch", "open3d-cpu")


@dataclass(frozen=True, slots=True)
class BenchmarkConfig:
    """What to run.

    Attributes:
        scene: kind of the scenes.
        protocol: the constants.
        rounds: how many for each seed.
        seeds: with a round's number, a seed gives the round's scene, views and noise.
        objects: folder in the layout `<scene>/<split>/*.urdf`; the built-in set if None.
        split: of that folder.
        patience: seconds to go on asking a planner that is unavailable.
    """

    scene: SceneKind
    rounds: int
    seeds: tuple[int, ...] = (0,)
    protocol: Protocol = field(default_factory=lambda: load_protocol("edgegrasp"))
    objects: Path | None = None
    split: str = "test"
    patience: float = PATIENCE

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; run at least 1")
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError(f"seeds is {self.seeds}; pass numbers of 0 or more")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds is {self.seeds}; pass each seed once")

    def object_set(self) -> ObjectSet:
        """The objects to draw scenes from.

        Raises:
            FileNotFoundError: `objects` does not hold this scene and split.
        """
        if self.objects is None:
            return ObjectSet.builtin(self.scene)
        return ObjectSet.from_folder(self.objects, self.scene, self.split)

    def tasks(self) -> list[Task]:
        """Seed and index of every round, in order."""
        return [(seed, index) for seed in self.seeds for index in range(self.rounds)]


def run_benchmark(
    config: BenchmarkConfig,
    make_planner: PlannerFactory,
    *,
    workers: int = 1,
    ray: str | None = None,
    folder: ResultFolder | None = None,
    on_round: Callable[[Round], None] | None = None,
    gui: bool = False,
) -> list[Round]:
    """Run all rounds that `folder` does not hold yet, wherever: outcomes stay the same.

    Args:
        config: what to run.
        make_planner: called once in every process.
        workers: processes; with 1 all runs in this one. The rounds of a worker process that
            dies are run again by another.
        ray: address of a Ray cluster to run the workers on; see `run_on_ray`.
        folder: keeps each round as it finishes; opened by the caller.
        on_round: told of every round as it is done, in any order.
        gui: show PyBullet's window; with one worker only.

    Returns:
        All rounds of `config`, by seed and index.

    Raises:
        ValueError: `workers` below 1, or the planner's pose is no rigid transform.
        FileNotFoundError: the object folder does not hold the scene.
        PlannerUnavailableError: the planner stayed away for longer than the patience.
        RuntimeError: worker processes keep dying, or there is no such Ray cluster.
    """
    if workers < 1:
        raise ValueError(f"workers is {workers}; use at least 1")
    config.object_set()  # a wrong folder shall fail here, not in every worker
    tasks = config.tasks()
    kept = folder.rounds() if folder is not None else []
    rounds = {(r.seed, r.index): r for r in kept if (r.seed, r.index) in set(tasks)}
    missing = [task for task in tasks if task not in rounds]
    workers = max(1, min(workers, len(missing)))
    if ray is not None:
        from edgegrasp_sim.ray_cluster import run_on_ray

        run = run_on_ray(ray, config, make_planner, missing, workers)
    elif workers == 1:
        run = _run_here(config, make_planner, missing, gui)
    else:
        run = _run_pools(config, make_planner, missing, workers)
    for done in run:
        rounds[done.seed, done.index] = done
        if folder is not None:
            folder.add(done)
        if on_round is not None:
            on_round(done)
    return [rounds[task] for task in tasks]


def manifest(config: BenchmarkConfig, planner: dict[str, Any]) -> dict[str, Any]:
    """What is needed to get the same figures again.

    Args:
        config: what is run.
        planner: how grasps are planned: its name, the weights' name and digest, options.
    """
    objects = config.object_set()
    return {
        "run": {
            "scene": config.scene.value,
            "protocol": config.protocol.to_json(),
            "objects": {
                "name": objects.name,
                "models": len(objects.models),
                "digest": objects_digest(objects),
            },
            "planner": planner,
            "constants": constants(),
        },
        "rounds": config.rounds,
        "seeds": list(config.seeds),
        "objects_folder": str(config.objects) if config.objects is not None else None,
        "split": config.split,
        "versions": {
            "python": platform.python_version(),
            **{name: _version(name) for name in PACKAGES},
        },
        "host": {
            "name": platform.node(),
            "platform": platform.platform(),
            "machine": platform.machine(),
            "processors": os.cpu_count(),
        },
    }


def constants() -> dict[str, float]:
    """The simulator's own constants, the same under every protocol."""
    return {
        "time_step": world.TIME_STEP,
        "solver_iterations": world.SOLVER_ITERATIONS,
        "gravity": world.GRAVITY,
        "table_friction": scene.TABLE_FRICTION,
        "object_mass": scene.OBJECT_MASS,
        "object_friction": scene.OBJECT_FRICTION,
        "packed_attempts": scene.PACKED_ATTEMPTS,
        "pile_drop_height": scene.PILE_DROP_HEIGHT,
        "rest_speed": scene.REST_SPEED,
        "max_opening": gripper.MAX_OPENING,
        "hand_mass": gripper.HAND_MASS,
        "finger_friction": gripper.FINGER_FRICTION,
        "finger_spinning_friction": gripper.FINGER_SPINNING_FRICTION,
        "finger_force": gripper.FINGER_FORCE,
        "gear_force": gripper.GEAR_FORCE,
        "tool_force": gripper.TOOL_FORCE,
        "close_seconds": gripper.CLOSE_SECONDS,
        "collision_depth": gripper.COLLISION_DEPTH,
        "pregrasp_distance": grasping.PREGRASP_DISTANCE,
        "retreat_distance": grasping.RETREAT_DISTANCE,
        "side_grasp_angle": grasping.SIDE_GRASP_ANGLE,
        "step_length": grasping.STEP_LENGTH,
        "min_opening": grasping.MIN_OPENING,
        "min_points": trials.MIN_POINTS,
    }


def objects_digest(objects: ObjectSet) -> str:
    """SHA-256 of the names, scales and descriptions of a set's objects."""
    digest = hashlib.sha256()
    for model in objects.models:
        digest.update(f"{model.name} {model.scale}".encode())
        for file in model.files:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def available_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


class RoundRunner:
    """A simulation with a planner, for one process."""

    def __init__(
        self, config: BenchmarkConfig, make_planner: PlannerFactory, gui: bool = False
    ) -> None:
        self.config = config
        self.planner: Planner = make_planner()
        self.simulation = ClutterSimulation({config.scene: config.object_set()}, gui=gui)
        if gui:
            self.planner = ShownPlanner(self.planner, Window(self.simulation.world))

    def run(self, task: Task) -> Round:
        """Run the round of a seed and an index."""
        seed, index = task
        config = self.config
        return run_round(
            self.simulation,
            self.planner,
            config.scene,
            config.protocol,
            seed=seed,
            index=index,
            patience=config.patience,
        )

    def close(self) -> None:
        """Give back what simulation and planner hold."""
        self.simulation.close()
        if isinstance(self.planner, Closes):
            self.planner.close()


def _run_here(
    config: BenchmarkConfig, make_planner: PlannerFactory, tasks: Sequence[Task], gui: bool
) -> Iterator[Round]:
    if not tasks:
        return
    runner = RoundRunner(config, make_planner, gui)
    try:
        yield from map(runner.run, tasks)
    finally:
        runner.close()


_worker: RoundRunner | None = None  # one in each worker process, made by its initialiser


def _start_worker(config: BenchmarkConfig, make_planner: PlannerFactory) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    _worker = RoundRunner(config, make_planner)


def _run_in_worker(task: Task) -> Round:
    assert _worker is not None
    return _worker.run(task)


def _run_pools(
    config: BenchmarkConfig, make_planner: PlannerFactory, tasks: Sequence[Task], workers: int
) -> Iterator[Round]:
    """Run rounds in processes; where one dies, the pool breaks and another takes its place."""
    missing, crashes = list(tasks), 0
    while missing:
        finished = 0
        try:
            for done in _run_pool(config, make_planner, missing, workers):
                finished += 1
                missing.remove((done.seed, done.index))
                yield done
        except BrokenProcessPool:
            crashes = 1 if finished else crashes + 1
            if crashes >= MAX_CRASHES:
                raise RuntimeError(
                    f"worker processes died {crashes} times in a row with {len(missing)} rounds "
                    "left; run with one worker to see why"
                ) from None


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started meanwhile use one thread each: with all cores busy, more only wait."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update({name: value or "1" for name, value in before.items()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]


def _run_pool(
    config: BenchmarkConfig, make_planner: PlannerFactory, tasks: Sequence[Task], workers: int
) -> Iterator[Round]:
    # Forked children would share the parent's physics servers and threads.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        workers, context, initializer=_start_worker, initargs=(config, make_planner)
    )
    try:
        with _one_thread_each():
            futures = [pool.submit(_run_in_worker, task) for task in tasks]
        for future in as_completed(futures):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)
