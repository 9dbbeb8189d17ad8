"""`edgegrasp benchmark-tracking`: follow grasps through a camera's images, then execute them."""

import itertools
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from typer import Option

from edgegrasp_camera.arrays import Float64
from edgegrasp_cli.detect import DetectorFlags, open_client
from edgegrasp_cli.flags import takes_flags
from edgegrasp_lab.real_scenes import RealScene, load_scenes
from edgegrasp_sim.camera import look_at
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.sensor import STRUCTURED_LIGHT
from edgegrasp_sim.simulation import ClutterSimulation

RATE = 30.0  # images a second
NOISE, MISSING = (0.0003, 0.0015), 0.005  # metres, and metres per depth squared; share of pixels
EYE, TARGET = np.array([0.15, -0.35, 0.65]), np.array([0.15, 0.15, 0.05])  # of the camera, metres
OBJECTS = 3  # in a simulated scene
REPEATED = 8  # images of a still scene in which the first grasp is found without tracking
ALIKE = 0.02, 10.0  # metres and degrees; grasps that differ by less count as the same
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # a hand with two equal fingers is symmetric to it


@dataclass(frozen=True)
class Motion:
    """How objects and the camera move between the first answer and the grasp."""

    seconds: float = 1.0
    speed: float = 0.0  # horizontal speed of the object to grasp, metres a second
    belt: bool = False  # whether the other objects move with it
    shift: float = np.inf  # metres after which it stops
    turn: float = 0.0  # rotation about the vertical until it stops, degrees
    camera: float = 0.0  # speed of the camera toward the objects, metres a second


MOTIONS = {
    "still": Motion(seconds=10.0),
    "pushed": Motion(speed=0.1, shift=0.02, turn=20.0),
    "belt-5": Motion(speed=0.05, belt=True),
    "belt-10": Motion(speed=0.1, belt=True),
    "belt-20": Motion(speed=0.2, belt=True),
    "hand-camera": Motion(camera=0.2),
}


@dataclass
class Followed:
    """How the first grasp of a scene was followed."""

    # For each answer that contains it: time in seconds, errors in mm and in degrees.
    off: list[tuple[float, float, float]] = field(default_factory=list)
    latency: list[float] = field(default_factory=list)  # seconds, of all answers
    switches: int = 0  # number of changes to another first grasp, or to none
    first: Any = None  # the first grasp; None: there was none
    last: Any = None  # the last first grasp
    success: dict[str, bool] = field(default_factory=dict)
    alike: float | None = None  # share of image pairs with the same first grasp, without tracking


class RecordedScene:
    """A recorded still scene; each image has new noise of a depth camera."""

    def __init__(self, scene: RealScene) -> None:
        self.points = scene.points

    def image_at(self, seconds: float) -> dict[str, Any]:
        """The image at a time, as arguments of `GraspClient.detect`; points (R, 3)."""
        rng, depth = np.random.default_rng(round(seconds * RATE)), self.points[:, 2]
        apart = (NOISE[0] + NOISE[1] * depth**2) * rng.standard_normal(len(depth)) / depth
        noisy = (self.points * (1.0 + apart[:, None])).astype(np.float32)
        seen = np.isfinite(noisy[:, 0]) & (rng.random(len(depth)) > MISSING)
        return {"cloud": noisy[seen], "viewpoint": (0.0, 0.0, 0.0)}

    def choose_object(self, T_cloud_tcp: Float64) -> None:
        """Choose the object nearest to a grasp, which moves from now on; here no object moves."""

    def object_motion(self, seconds: float) -> Float64:
        """(4, 4) T_now_start of the chosen object, cloud frame."""
        return np.eye(4)


class SimulatedScene:
    """Objects on a table or a belt, under a structured-light camera; world frame."""

    def __init__(
        self, simulation: ClutterSimulation, motion: Motion, rng: np.random.Generator
    ) -> None:
        self.simulation, self.motion, self.rng = simulation, motion, rng
        self.start, self.held = simulation.placements, 0
        self.places = np.array([one.position for one in self.start])
        angle = rng.uniform(0.0, 2.0 * np.pi)
        self.way = np.array([np.cos(angle), np.sin(angle), 0.0])
        self.sense = float(rng.choice([-1.0, 1.0]))

    def image_at(self, seconds: float) -> dict[str, Any]:
        """The points (H, W, 3)."""
        self._place(seconds)
        nearer = self.motion.camera * seconds / np.linalg.norm(TARGET - EYE)
        eye = EYE + nearer * (TARGET - EYE)
        seen = self.simulation.observe_from(
            [look_at(eye, TARGET)], self.rng, noise_std=0.0, faults=[STRUCTURED_LIGHT], table="auto"
        )
        return {"cloud": seen.image, "viewpoint": tuple(eye.tolist())}

    def choose_object(self, T_cloud_tcp: Float64) -> None:
        """Choose the object whose centre is nearest."""
        self.held = int(np.linalg.norm(self.places - T_cloud_tcp[:3, 3], axis=1).argmin())

    def object_motion(self, seconds: float) -> Float64:
        """A translation, and a rotation about the object's centre."""
        motion, place, T = self.motion, self.places[self.held], np.eye(4)
        gone = min(motion.speed * seconds, motion.shift)
        turn = self.sense * motion.turn * gone / motion.shift
        T[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        T[:3, 3] = place + gone * self.way - T[:3, :3] @ place
        return T

    def execute(self, done: Followed) -> dict[str, bool]:
        """Try the first grasp at the start, and the first and the last grasp at the end."""
        first, last, end = done.first, done.last, self.motion.seconds
        tries = {"still": (first, 0.0), "open_loop": (first, end), "followed": (last, end)}
        success: dict[str, bool] = {}
        for name, (grasp, seconds) in tries.items():
            self._place(seconds)
            tried = None if grasp is None else self.simulation.try_grasp(grasp.T_cloud_hand)
            success[name] = tried is not None and tried.success
        return success

    def _place(self, seconds: float) -> None:
        """Move objects to their poses at a time."""
        T = self.object_motion(seconds)
        for number, start in enumerate(self.start):
            if self.motion.belt or number == self.held:
                place = T[:3, :3] @ start.position + T[:3, 3]
                turn = Rotation.from_matrix(T[:3, :3]) * Rotation.from_quat(start.quaternion_xyzw)
                self.simulation.move(number, place.tolist(), turn.as_quat().tolist())


Scene = RecordedScene | SimulatedScene


@takes_flags()
def benchmark_tracking(
    scenes: Annotated[
        list[Path] | None, Option(help="Folder of recorded still scenes, .npz; default: simulated.")
    ] = None,
    objects: Annotated[
        Path | None, Option(help="Folder of packed/test/*.urdf; default: built-in objects.")
    ] = None,
    motion: Annotated[
        list[str] | None, Option(help=f"{', '.join(MOTIONS)}; may be repeated; default: all.")
    ] = None,
    rounds: Annotated[int, Option(min=1, help="Simulated scenes for each motion.")] = 20,
    seconds: Annotated[float | None, Option(min=0.1, help="Default: each motion's own.")] = None,
    output: Annotated[Path, Option(help="Folder for results.json and jitter.svg.")] = Path(
        "results/tracking"
    ),
    *,
    flags: DetectorFlags,
) -> None:
    """Follow a grasp at 30 images a second, then execute it in simulation.

    The scene keeps moving while an answer is computed; images that arrive meanwhile are dropped.
    An answer takes the processor time of its computation; with --server, the time until it arrives.
    """
    names = motion or (["still"] if scenes else list(MOTIONS))
    if unknown := [name for name in names if name not in MOTIONS]:
        raise ValueError(f"--motion: got {unknown[0]!r}. Choose one of {', '.join(MOTIONS)}.")
    if scenes and set(names) != {"still"}:
        raise ValueError("--motion: got it with --scenes, which stand still. Leave it out.")
    clock = time.perf_counter if flags.server else time.process_time
    done: dict[str, list[Followed]] = {}
    with open_client(flags) as client:
        for name in names:
            moving = MOTIONS[name] if seconds is None else replace(MOTIONS[name], seconds=seconds)
            if scenes:
                made: Any = ((one.name, RecordedScene(one)) for one in load_scenes(scenes))
            else:
                made = ((name, one) for one in simulated(objects, moving, rounds))
            for label, scene in made:
                followed = follow(client, scene, moving.seconds, clock)
                if followed.first is not None:
                    followed.success = {} if scenes else scene.execute(followed)
                    if name == "still":
                        followed.alike = found_again(client, scene)
                    done.setdefault(label, []).append(followed)
    rows = {name: summary(each) for name, each in done.items()}
    output.mkdir(parents=True, exist_ok=True)
    (output / "results.json").write_text(json.dumps(rows, indent=1) + "\n")
    _plot(output / "jitter.svg", done)
    table = Table("", *next(iter(rows.values()), {}), box=None)
    for label, row in rows.items():
        table.add_row(label, *("-" if value is None else f"{value:.4g}" for value in row.values()))
    Console(width=130, markup=False, emoji=False).print(table)


def follow(client: Any, scene: Scene, seconds: float, clock: Callable[[], float]) -> Followed:
    """Follow the first grasp of a scene, which starts to move once that grasp is found."""
    from edgegrasp_client import GraspTracker

    tracker, done, now, shown = GraspTracker(top_k=10), Followed(), 0.0, None
    while now < seconds:
        taken = np.floor(now * RATE + 1e-6) / RATE  # the latest image
        image, start = scene.image_at(taken), clock()
        found = client.detect(**image, **tracker.options())
        spent = clock() - start
        tracker.take(found)
        best = found.grasps[0] if found.grasps else None
        if done.first is None:
            if best is None:
                return done
            done.first, shown = best, best.id
            scene.choose_object(best.T_cloud_tcp)
            continue
        now = max(taken + 1.0 / RATE, taken + spent)
        done.latency.append(spent)
        before, shown = shown, best and best.id
        done.switches += int(shown != before)
        done.last = best or done.last
        if best is not None and best.id == done.first.id:
            true = scene.object_motion(now) @ done.first.T_cloud_tcp
            apart = np.linalg.norm(best.T_cloud_tcp[:3, 3] - true[:3, 3])
            done.off.append((now, 1000 * float(apart), _degrees(best.T_cloud_tcp, true)))
    return done


def found_again(client: Any, scene: Scene) -> float:
    """Share of image pairs of a still scene with the same first grasp, without tracking."""
    images = [client.detect(**scene.image_at(number / RATE)).grasps for number in range(REPEATED)]
    alike = [
        bool(some and others) and _alike(some[0].T_cloud_tcp, others[0].T_cloud_tcp)
        for some, others in itertools.combinations(images, 2)
    ]
    return sum(alike) / len(alike)


def _alike(one: Float64, other: Float64) -> bool:
    near = np.linalg.norm(one[:3, 3] - other[:3, 3]) <= ALIKE[0]
    return bool(near and min(_degrees(one, other), _degrees(one @ HALF_TURN, other)) <= ALIKE[1])


def _degrees(one: Float64, other: Float64) -> float:
    """The angle between the rotations of two poses (4, 4), degrees."""
    return float(np.degrees(Rotation.from_matrix(one[:3, :3].T @ other[:3, :3]).magnitude()))


def summary(done: list[Followed]) -> dict[str, Any]:
    """Figures over some scenes: medians and 95 %, and how many grasps held an object."""
    off = np.array([each for one in done for each in one.off]).reshape(-1, 3)
    latency = 1000 * np.array([each for one in done for each in one.latency])
    return {
        "scenes": len(done),
        "images": len(latency),
        "switches": sum(one.switches for one in done),
        **{
            f"{name}_{share}": float(np.percentile(values, share)) if len(values) else None
            for name, values in {"mm": off[:, 1], "degrees": off[:, 2], "ms": latency}.items()
            for share in (50, 95)
        },
        **{name: sum(one.success[name] for one in done) for name in done[0].success},
        "alike": None if done[0].alike is None else float(np.mean([one.alike for one in done])),
    }


def simulated(objects: Path | None, motion: Motion, rounds: int) -> Iterator[SimulatedScene]:
    """Simulated scenes; each is valid until the next one."""
    kind = SceneKind.PACKED
    with ClutterSimulation(ObjectSet.from_folder(objects, kind), engine="mujoco") as simulation:
        for number in range(rounds):
            rng = np.random.default_rng(number)
            if simulation.reset(kind, rng, num_objects=OBJECTS):
                yield SimulatedScene(simulation, motion, rng)


def _plot(path: Path, done: dict[str, list[Followed]]) -> None:
    """Plot the distance of the first grasp from its true position over time."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 2.8), layout="constrained")
    for name, each in done.items():
        seconds, away, _ = np.reshape(each[0].off, (-1, 3)).T
        axes.plot(seconds, away, label=name, linewidth=1)
    axes.set(xlabel="seconds", ylabel="mm", ylim=(0, None))
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(path)
    pyplot.close(figure)
