"""Many rounds of clutter removal, resumable."""

import itertools
import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, TypeAlias

from edgegrasp_sim import engine as engines
from edgegrasp_sim import fixed_parts, hand, scene
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.protocol import Protocol, load_protocol
from edgegrasp_sim.results import ResultFolder
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import MIN_SEEN, Planner, Round, RoundDriver
from edgegrasp_sim.workers import run_tasks

# Makes the planner in the process that uses it; must be picklable for several processes.
PlannerFactory: TypeAlias = Callable[[], Planner]
PACKAGES = ("edgegrasp", "numpy", "scipy", "pybullet", "mujoco", "torch", "open3d-cpu")


@dataclass(frozen=True, slots=True)
class BenchmarkConfig:
    """What to run."""

    scene: SceneKind  # kind of the scenes
    rounds: int  # how many for each seed
    seeds: tuple[int, ...] = (0,)  # a seed and a round's number determine scene, views and noise
    protocol: Protocol = field(default_factory=lambda: load_protocol("edgegrasp"))  # the constants
    objects: Path | None = None  # `<scene>/<split>/*.urdf`; None: the built-in set
    split: str = "test"  # of that folder
    engine: str = ""  # to simulate with; default: `choose_engine` with the protocol's engine
    gripper: dict[str, Any] | None = None  # fields of a gripper file; None: the Panda's hand
    arm: engines.ArmModel | None = None  # the arm that carries the hand; None: the hand floats

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; run at least 1")
        if not self.seeds or min(self.seeds) < 0 or len({*self.seeds}) < len(self.seeds):
            raise ValueError(f"seeds is {self.seeds}; pass numbers of 0 or more, each seed once")
        object.__setattr__(self, "engine", engines.choose_engine(self.engine, self.protocol.engine))

    def object_set(self) -> ObjectSet:
        """The objects to draw scenes from; FileNotFoundError if `objects` contains none."""
        return ObjectSet.from_folder(self.objects, self.scene, self.split)

    def simulation(self, digest: str) -> ClutterSimulation:
        """The simulation for its rounds; raises ValueError if its objects have another digest."""
        objects = self.object_set()
        objects.check_same(digest)
        return ClutterSimulation(
            objects,
            engine=self.engine,
            gripper=self.gripper,
            arm=self.arm,
            min_opening=self.protocol.round.min_opening,
        )


def run_benchmark(
    config: BenchmarkConfig,  # what to run
    make_planner: PlannerFactory,  # called once in every process
    folder: ResultFolder,  # keeps each round as it finishes; opened by the caller
    workers: int | None = 1,  # how many rounds at a time, and
    ray: str | None = None,  # address of a Ray cluster to run them on: see `run_tasks`
) -> Iterator[Round]:
    """Run the rounds that `folder` lacks; yields each as it finishes. See `run_tasks`."""
    digest = config.object_set().digest  # fails here on a wrong folder, not in every worker
    kept = {(done.seed, done.index) for done in folder.rounds()}
    tasks = itertools.product(config.seeds, range(config.rounds))
    missing = [task for task in tasks if task not in kept]
    make_runner = partial(RoundRunner, config, make_planner, digest)
    for _, done in run_tasks(make_runner, missing, workers=workers, ray=ray):
        folder.add(done)
        yield done


def manifest(config: BenchmarkConfig, planner: dict[str, Any]) -> dict[str, Any]:
    """All that is needed to reproduce the figures; `planner` has name, weights, digest, options."""
    drawn = config.object_set()
    # The Panda's hand is not named, so that earlier results can be resumed.
    carried: dict[str, Any] = {} if config.gripper is None else {"gripper": config.gripper}
    if config.arm is not None:
        carried["arm"] = config.arm.joint_names
    return {
        "run": {
            "scene": config.scene.value,
            "protocol": config.protocol.to_json(),
            "objects": {"name": drawn.name, "models": len(drawn.models), "digest": drawn.digest},
            "planner": planner,
            "engine": config.engine,
            "constants": constants(config.engine),
            **carried,
        },
        "rounds": config.rounds,
        "seeds": list(config.seeds),
        "objects_folder": str(config.objects) if config.objects is not None else None,
        "split": config.split,
        "versions": {"python": platform.python_version()}
        | {each.name: each.version for each in distributions() if each.name in PACKAGES},
        "host": {
            "name": platform.node(),
            "platform": platform.platform(),
            "machine": platform.machine(),
            "processors": os.cpu_count(),
        },
    }


def constants(engine: str) -> dict[str, float]:
    """The simulator's own constants, the same under every protocol."""
    panda, world = hand.panda(), engines.world_type(engine)
    return world.constants | {
        "time_step": engines.TIME_STEP,
        "gravity": engines.GRAVITY,
        "collision_depth": world.collision_depth,
        "table_friction": fixed_parts.TABLE_FRICTION,
        "packed_attempts": scene.PACKED_ATTEMPTS,
        "pile_drop_height": scene.PILE_DROP_HEIGHT,
        "rest_speed": scene.REST_SPEED,
        "object_mass": engines.OBJECT_MASS,
        "object_friction": engines.OBJECT_FRICTION,
        "max_opening": panda.max_opening,
        "hand_mass": panda.mass,
        "finger_friction": panda.finger_friction,
        "finger_force": panda.finger_force,
        "tool_force": panda.tool_force,
        "close_seconds": hand.CLOSE_SECONDS,
        "pregrasp_distance": hand.PREGRASP_DISTANCE,
        "retreat_distance": hand.RETREAT_DISTANCE,
        "side_grasp_angle": hand.SIDE_GRASP_ANGLE,
        "step_length": hand.STEP_LENGTH,
        "min_points": MIN_SEEN,
    }


class RoundRunner:
    """A simulation with a planner, for one process."""

    def __init__(self, config: BenchmarkConfig, make_planner: PlannerFactory, digest: str) -> None:
        self.config, self.simulation = config, config.simulation(digest)
        self.planner: Planner = make_planner()

    def __call__(self, task: tuple[int, int]) -> Round:
        """Run the round of a seed and an index."""
        seed, index = task
        where = self.simulation, self.config.scene, self.config.protocol
        return RoundDriver(*where, seed=seed, index=index).run(self.planner)

    def close(self) -> None:
        """Close the simulation and the planner."""
        self.simulation.world.close()
        if close := getattr(self.planner, "close", None):
            close()
