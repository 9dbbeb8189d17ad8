"""Many rounds of clutter removal, resumable: in this process, in several, or on a Ray cluster."""

import ctypes
import importlib
import multiprocessing
import os
import platform
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

from edgegrasp_sim import hand, objects, scene, surroundings, trial
from edgegrasp_sim.engine import choose_engine, engine_constants
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.protocol import Protocol, load_protocol
from edgegrasp_sim.results import ResultFolder
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import PATIENCE, Planner, Round, run_round

# Makes the planner in the process that uses it; must be picklable if there are several.
PlannerFactory: TypeAlias = Callable[[], Planner]
Task: TypeAlias = tuple[int, int]  # seed and index of a round
MAX_CRASHES = 3  # in a row, without a finished round between them
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
PACKAGES = ("edgegrasp", "numpy", "scipy", "pybullet", "mujoco", "torch", "open3d-cpu")
CONSTANTS: tuple[tuple[ModuleType, tuple[str, ...]], ...] = (  # of each module, for the manifest
    (surroundings, ("table_friction",)),
    (scene, ("packed_attempts", "pile_drop_height", "rest_speed")),
    (objects, ("object_mass", "object_friction")),
    (hand, ("max_opening", "hand_mass", "finger_friction")),
    (hand, ("finger_force", "tool_force", "close_seconds")),
    (hand, ("pregrasp_distance", "retreat_distance", "side_grasp_angle", "step_length")),
    (hand, ("min_opening",)),
    (trial, ("min_points",)),
)
PR_SET_PDEATHSIG = 1  # of Linux's prctl
LOCAL_RAY = "local"  # address of a cluster that is started on this machine for the run


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
        patience: seconds to keep asking a planner that is unavailable.
        engine: to simulate with; by default see `choose_engine`, with the protocol's.
        gripper: the fields of a gripper file; by default the Panda's hand.
    """

    scene: SceneKind
    rounds: int
    seeds: tuple[int, ...] = (0,)
    protocol: Protocol = field(default_factory=lambda: load_protocol("edgegrasp"))
    objects: Path | None = None
    split: str = "test"
    patience: float = PATIENCE
    engine: str = ""
    gripper: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; run at least 1")
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError(f"seeds is {self.seeds}; pass numbers of 0 or more")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds is {self.seeds}; pass each seed once")
        chosen = choose_engine(self.engine, self.protocol.engine).name
        object.__setattr__(self, "engine", chosen)

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
) -> list[Round]:
    """Run all rounds that `folder` does not hold yet; outcomes do not depend on where.

    Args:
        config: what to run.
        make_planner: called once in every process.
        workers: processes; with 1 all runs in this one. If a worker dies, another runs its
            rounds again.
        ray: address of a Ray cluster to run the workers on; see `_run_on_ray`.
        folder: keeps each round as it finishes; opened by the caller.
        on_round: called with every round as it finishes, in any order.

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
    config.object_set()  # fail here on a wrong folder, not in every worker
    tasks = config.tasks()
    kept = folder.rounds() if folder is not None else []
    rounds = {(r.seed, r.index): r for r in kept if (r.seed, r.index) in set(tasks)}
    missing = [task for task in tasks if task not in rounds]
    workers = max(1, min(workers, len(missing)))
    if ray is not None:
        run = _run_on_ray(ray, config, make_planner, missing, workers)
    elif workers == 1:
        run = _run_here(config, make_planner, missing)
    else:
        run = _run_in_processes(config, make_planner, missing, workers)
    for done in run:
        rounds[done.seed, done.index] = done
        if folder is not None:
            folder.add(done)
        if on_round is not None:
            on_round(done)
    return [rounds[task] for task in tasks]


def manifest(config: BenchmarkConfig, planner: dict[str, Any]) -> dict[str, Any]:
    """All that is needed to reproduce the figures.

    Args:
        config: what is run.
        planner: how grasps are planned: its name, the weights' name and digest, options.
    """
    drawn = config.object_set()
    # Named where it is not the Panda's, so that earlier results can be resumed.
    hand = {} if config.gripper is None else {"gripper": config.gripper}
    return {
        "run": {
            "scene": config.scene.value,
            "protocol": config.protocol.to_json(),
            "objects": {"name": drawn.name, "models": len(drawn.models), "digest": drawn.digest},
            "planner": planner,
            "engine": config.engine,
            "constants": constants(config.engine),
            **hand,
        },
        "rounds": config.rounds,
        "seeds": list(config.seeds),
        "objects_folder": str(config.objects) if config.objects is not None else None,
        "split": config.split,
        "versions": {"python": platform.python_version()} | {n: _version(n) for n in PACKAGES},
        "host": {
            "name": platform.node(),
            "platform": platform.platform(),
            "machine": platform.machine(),
            "processors": os.cpu_count(),
        },
    }


def constants(engine: str) -> dict[str, float]:
    """The simulator's own constants, the same under every protocol."""
    return engine_constants(engine) | {
        name: getattr(module, name.upper()) for module, names in CONSTANTS for name in names
    }


def available_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class RoundRunner:
    """A simulation with a planner, for one process.

    Args:
        config: what to run.
        make_planner: called once.
        digest: that the objects must have, if they are read on another machine.

    Raises:
        ValueError: the objects have another digest.
    """

    def __init__(
        self,
        config: BenchmarkConfig,
        make_planner: PlannerFactory,
        *,
        digest: str | None = None,
    ) -> None:
        objects = config.object_set()
        if digest not in (None, objects.digest):
            raise ValueError(
                f"the objects in {config.objects} differ between the machines of the cluster; put "
                "the same folder at the same path on each"
            )
        self.config = config
        self.planner: Planner = make_planner()
        self.simulation = ClutterSimulation(
            {config.scene: objects}, engine=config.engine, gripper=config.gripper
        )

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
        """Release what simulation and planner hold."""
        self.simulation.close()
        if close := getattr(self.planner, "close", None):
            close()


def _run_here(
    config: BenchmarkConfig, make_planner: PlannerFactory, tasks: Sequence[Task]
) -> Iterator[Round]:
    if not tasks:
        return
    runner = RoundRunner(config, make_planner)
    try:
        yield from map(runner.run, tasks)
    finally:
        runner.close()


def _run_in_processes(
    config: BenchmarkConfig, make_planner: PlannerFactory, tasks: Sequence[Task], workers: int
) -> Iterator[Round]:
    """Run rounds in processes; if one dies, the pool breaks and a new one takes its place."""
    missing, crashes = list(tasks), 0
    while missing:
        # Forked children would share the parent's physics servers.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(
            workers, context, initializer=_start_worker, initargs=(config, make_planner)
        )
        try:
            with _one_thread_each():
                futures = [pool.submit(_run_in_worker, task) for task in missing]
            for future in as_completed(futures):
                done = future.result()
                crashes = 0
                missing.remove((done.seed, done.index))
                yield done
        except BrokenProcessPool:
            crashes += 1
            if crashes >= MAX_CRASHES:
                raise RuntimeError(
                    f"worker processes died {crashes} times in a row with {len(missing)} rounds "
                    "left; run with one worker to see why"
                ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def end_with_parent() -> None:
    """Have this process ended when its parent ends, however that comes about."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


_worker: RoundRunner | None = None  # of a worker process, made by its initialiser


def _start_worker(config: BenchmarkConfig, make_planner: PlannerFactory) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    end_with_parent()
    _worker = RoundRunner(config, make_planner)


def _run_in_worker(task: Task) -> Round:
    assert _worker is not None
    return _worker.run(task)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Make processes started meanwhile use one thread each: all cores are busy anyway."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update({name: value or "1" for name, value in before.items()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]


def _run_on_ray(
    address: str,
    config: BenchmarkConfig,
    make_planner: PlannerFactory,
    tasks: Sequence[Task],
    workers: int,
) -> Iterator[Round]:
    """Run rounds in the actors of a Ray cluster.

    Each of its machines needs this package, the same objects at the same path, and what the
    planner needs. An actor that dies is restarted, and so is its round.

    Args:
        address: of the cluster, as `ray.init` takes it; `local` starts one on this machine.
        config: what to run.
        make_planner: called once in every actor.
        tasks: the rounds.
        workers: actors at most; no more are started than the cluster has processors.

    Yields:
        The rounds, in the order in which they finish.

    Raises:
        RuntimeError: Ray is not installed, there is no such cluster, or actors keep dying.
    """
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError:
        raise RuntimeError("ray is not installed: pip install 'edgegrasp[ray]'") from None
    if not tasks:
        return
    own: dict[str, Any] = {}
    if address == LOCAL_RAY:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # only read from there
        own = {"num_cpus": workers, "include_dashboard": False}
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **own)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise RuntimeError(f"no Ray cluster at {address!r}: {error}") from error
    try:
        workers = max(1, min(workers, int(ray.cluster_resources().get("CPU", 1))))
        actor: Any = ray.remote(
            num_cpus=1, max_restarts=MAX_CRASHES * len(tasks), max_task_retries=MAX_CRASHES
        )(RoundRunner)
        digest = config.object_set().digest
        runners = [actor.remote(config, make_planner, digest=digest) for _ in range(workers)]
        pool = ray.util.ActorPool(runners)
        yield from pool.map_unordered(lambda runner, task: runner.run.remote(task), tasks)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayActorError as error:
        raise RuntimeError(f"a Ray actor died again and again: {error}") from error
    finally:
        ray.shutdown()


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None
