"""`edgegrasp benchmark`, and `edgegrasp compare` for its results."""

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from rich.console import Console
from rich.progress import Progress, TimeElapsedColumn
from typer import Argument, Option

from edgegrasp_cli.flags import option_flags, parse_option_flags, takes_flags
from edgegrasp_lab.flags import ClusterFlags, PlannerFlags
from edgegrasp_model.gripper import gripper_fields
from edgegrasp_sim import results
from edgegrasp_sim.benchmark import BenchmarkConfig, manifest, run_benchmark
from edgegrasp_sim.engine import ArmModel
from edgegrasp_sim.fixed_parts import MIDDLE, TABLE_HEIGHT
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import CameraRules, load_protocol
from edgegrasp_sim.report import key_figures, write_report
from edgegrasp_sim.results import RATE_LABELS, ResultFolder, rate_text

FAR = 0.5  # metres from the arm's base to the middle of a scene
LIFT = {"retreat_length": 0.1, "retreat_direction": "up"}  # metres
# Options of a detection that are set by the simulation, the protocol or another flag.
DECIDED = (
    *("model", "gripper", "seed", "viewpoint", "up", "support", "objects", "workspace"),
    *("top_k", "debug", "robot", "previous"),
)


class BenchmarkFlags(ClusterFlags, PlannerFlags):
    """The flags of `edgegrasp benchmark`."""

    scene: str | None = None
    """packed, pile, bin, bin-full, bin-deep, table or shelf; default: the protocol's, or pile"""
    protocol: str = "edgegrasp"
    """edgegrasp, giga, vgn, bin, table, shelf, ur5-pile, or a .toml file"""
    rounds: int | None = None
    """Rounds for each seed; default: the protocol's"""
    seed: tuple[int, ...] = ()
    """Seed of scenes, views and noise; may be repeated"""
    objects: Path | None = None
    """Folder of SCENE/SPLIT/*.urdf, *.obj or *.stl; default: the built-in objects"""
    split: str = "test"
    """Part of the objects to use: test or train"""
    gripper: str | None = None
    """Hand to grasp with: a gripper's name or .toml file; default: the Panda"""
    output: Path | None = None
    """Folder for manifest, attempts, figures and report; an existing benchmark is resumed"""
    report: bool = True
    """Whether to write report.html, which takes a while"""
    gate: Path | None = None
    """summary.json of a result that this one must not fall below"""


@takes_flags(options=option_flags(*DECIDED, defaults=False))
def benchmark(*, flags: BenchmarkFlags, options: dict[str, Any]) -> None:
    """Clear simulated clutter with a planner's grasps and count the successes.

    GSR: successes / attempts. DR: objects removed / present. The protocol defines a round.
    Options of the detection are the protocol's unless a flag is given.
    """
    with TemporaryDirectory() as scratch:
        folder = ResultFolder(flags.output or Path(scratch))
        config, fields = _plan(flags, parse_option_flags(options))
        print(f"engine: {config.engine}")
        run_rounds(config, flags, fields, folder)
        summary = folder.finish()
        if flags.output is not None and flags.report:
            print(f"report: {write_report(folder, summary)}")
        planner = results.planner_title(folder.manifest()["run"]["planner"])
        lines = (f"{name}: {value}" for name, value in key_figures(summary))
        print(f"{planner}: " + "\n".join(lines))
    if flags.gate is not None:
        if below := results.gate_failures(summary, flags.gate):
            sys.exit("edgegrasp benchmark: below the gate: " + "; ".join(below))
        print("not below the gate")


def _plan(flags: BenchmarkFlags, options: dict[str, Any]) -> tuple[BenchmarkConfig, dict[str, Any]]:
    """The benchmark to run, and the options of its requests."""
    rules = load_protocol(flags.protocol)
    # The Panda's hand has its own shapes.
    hand = gripper_fields(flags.gripper) if flags.gripper not in (None, "panda") else None
    arm = None
    if hand is not None:
        options = options | {"gripper": hand}
    if flags.robot is not None:
        if flags.gripper is not None:
            raise ValueError(f"gripper is {flags.gripper}; leave it out: {flags.robot} has its own")
        arm, hand, fields = benchmark_arm(flags.robot, rules.camera)
        asked = options.get("collision", {})  # a mode alone is allowed
        asked = asked if isinstance(asked, dict) else {"mode": asked}
        options = fields | options | {"collision": fields["collision"] | asked}
    config = BenchmarkConfig(
        SceneKind(flags.scene or rules.kind or SceneKind.PILE),
        rules.rounds if flags.rounds is None else flags.rounds,
        flags.seed or rules.seeds,
        rules,
        flags.objects.resolve() if flags.objects is not None else None,
        flags.split,
        flags.engine or ("mujoco" if flags.robot else ""),
        hand,
        arm,
    )
    if flags.ray not in (None, "local") and flags.planner == "server" and flags.server is None:
        wanted = "pass --server with an address that the cluster reaches, or --planner in-process"
        raise ValueError(f"ray is {flags.ray!r}; {wanted}")
    return config, options


def benchmark_arm(
    name: str, camera: CameraRules
) -> tuple[ArmModel, dict[str, Any] | None, dict[str, Any]]:
    """The robot's arm, on the camera's side of a scene, like an arm with a wrist camera.

    Returns:
        The arm, the fields of its hand's file (None: the Panda's), and the options of each request.

    Raises:
        InvalidRobot: the file cannot be used.
    """
    from edgegrasp_robot import load_robot  # an extra

    robot = load_robot(name)
    # The base is on the table, on the camera's side; its x points to the middle of the scene.
    azimuth = np.deg2rad(sum(camera.azimuth_degrees) / 2)
    out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    T_world_base = np.eye(4)
    T_world_base[:3, 0], T_world_base[:3, 1] = -out, np.cross([0.0, 0.0, 1.0], -out)
    T_world_base[:3, 3] = np.array([MIDDLE, MIDDLE, TABLE_HEIGHT]) + FAR * out
    T_root_base = robot.scene.forwardKinematics(robot.home, robot.base_frame)
    arm = ArmModel(
        robot.model.arm,
        T_world_base @ np.linalg.inv(T_root_base),
        robot.flange_frame,
        robot.T_flange_hand,
        robot.joint_names,
        robot.home,
    )
    T_base_world = np.linalg.inv(T_world_base).tolist()
    asked = {"name": robot.name, "T_base_cloud": T_base_world, "joints": robot.home.tolist()}
    hand = None if robot.gripper.name == "panda" else robot.gripper_geometry.model_dump()
    return arm, hand, {"robot": asked, "collision": LIFT}


def compare(
    first: Annotated[Path, Argument(help="Folder that `benchmark --output` wrote.")],
    second: Annotated[Path, Argument(help="Another, of the same scenes.")],
    output: Annotated[Path | None, Option(help="JSON file to write: the figures.")] = None,
) -> None:
    """Compare two benchmarks scene by scene, with 95 % confidence intervals."""
    figures = results.compare(ResultFolder(first), ResultFolder(second))
    if output is not None:
        output.write_text(json.dumps(figures, indent=1) + "\n")
    for name, label in RATE_LABELS.items():
        row = figures[name]
        difference = {"value": row["difference"], "wilson_95": row["difference_95"]}
        rates = " and ".join(rate_text(row[run]) for run in ("first", "second"))
        print(f"{label} %: {rates}; paired difference {rate_text(difference)}")
    better, worse = figures["second_better"], figures["second_worse"]
    print(
        f"{figures['scenes']} scenes: the second removed more objects in {better}, fewer in "
        f"{worse}, as many in {figures['scenes'] - better - worse}."
    )


def run_rounds(
    config: BenchmarkConfig, flags: BenchmarkFlags, options: dict[str, Any], folder: ResultFolder
) -> None:
    """Run the rounds that a folder lacks, with a progress bar."""
    from edgegrasp_lab.planners import open_planner  # loads gRPC, which --help does not need

    # Fails on a wrong folder before a server is started, and prepares meshes once for all workers.
    with Console(stderr=True).status("reading objects"):
        config.object_set()
    counts = np.zeros(len(results.COUNTS), np.int64)
    with open_planner(flags, config.protocol.planning, options) as planner:
        facts = manifest(config, planner.facts)
        if flags.gate is not None:  # another file fails here, not after hours
            results.gate_failures(results.summary_of(facts["run"], []), flags.gate)
        folder.open(facts)
        with Progress(*Progress.get_default_columns(), TimeElapsedColumn()) as progress:
            kept, total = len(folder.rounds()), config.rounds * len(config.seeds)
            bar = progress.add_task(config.scene, total=total, completed=kept)
            for done in run_benchmark(config, planner.make, folder, flags.workers, flags.ray):
                counts += results.count_outcomes([done])[:, 0]
                successes, attempts, objects = counts
                text = f"{config.scene} GSR {successes}/{attempts} DR {successes}/{objects}"
                progress.update(bar, advance=1, description=text)
