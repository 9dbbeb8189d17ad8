"""Labelled simulated scenes for `edgegrasp benchmark-real`, independent of the training generators.

    python benchmarks/heldout_scenes.py --objects OBJECTS --output SCENES --seed 0
    edgegrasp benchmark-real --scenes SCENES --output RESULTS

Tables, heaps, trays, bins and shelves in rooms, with the test objects of `OBJECTS`, which are for
evaluation only, observed by depth cameras with their faults; with `--robots`, also robots. Files
are named by kind.
"""

from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pybullet_data
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer import Option, run

from edgegrasp_camera.arrays import Float64
from edgegrasp_sim.camera import FAR_SHARE, look_at, unproject_to_world
from edgegrasp_sim.engine import SimCamera
from edgegrasp_sim.engine.with_pybullet import PybulletWorld
from edgegrasp_sim.objects import CLUTTER, ObjectSet
from edgegrasp_sim.scene import SceneObject, load_object, wait_for_rest
from edgegrasp_sim.sensor import random_sensor

KINDS = ("table", "heap", "tray", "bin", "shelf")
FIRST, SUPPORT = 2, 0.01  # the first object's label; minimum share of the support in an image
SIZES = ((320, 240), (424, 240), (512, 424), (640, 480))
TOUCHED = 0.015  # metres from a surface within which a faulty reading keeps its label
WINDOW = 4  # pixels around a reading in which its surface is searched for
LEAST = 0.001  # share of an image's pixels; an object with fewer is not labelled
FLAT = 0.004  # metres from the plane within which the body that carries objects is the support
FAR = 12.0  # metres
# PyBullet's models: arms, which stand next to the objects, and robots that hang above them.
ARMS = ("franka_panda/panda.urdf", "kuka_iiwa/model.urdf", "xarm/xarm6_with_gripper.urdf")
HANGING = ("pr2_gripper.urdf", "laikago/laikago.urdf", "mini_cheetah/mini_cheetah.urdf")
HANGING += ("quadruped/vision60.urdf", "aliengo/aliengo.urdf", "quadruped/spirit40.urdf")
CLEAR = 0.015  # metres between a robot and the objects


class SceneAtRest(NamedTuple):
    """A scene at rest; the objects stand on z = 0."""

    support: int  # the body that carries the objects
    polar: tuple[float, float]  # degrees of the camera from the vertical
    azimuth: tuple[float, float]  # degrees
    distance: tuple[float, float]  # metres
    reach: float  # greatest distance of objects from the middle, metres


class SceneBuilder:
    """A world, with the objects and background of its scenes."""

    def __init__(self, objects: Path, rng: np.random.Generator) -> None:
        self.world, self.rng = PybulletWorld(), rng
        self.sets = [ObjectSet.from_folder(objects, kind, "test") for kind in CLUTTER]
        self.objects: list[SceneObject] = []

    def box(self, size: object, centre: object, turn: Rotation | None = None) -> int:
        """A box that never moves; full extent and centre in metres."""
        body = self.world.add_box(np.asarray(size), np.asarray(centre), friction=0.6)
        if turn is not None:
            body.set_pose(np.asarray(centre, dtype=float), turn.as_quat().tolist())
        return body.uid

    def room(self, below: float) -> None:
        """A floor, two walls in a corner, and perhaps a cupboard, a beam and a monitor."""
        rng, turn = self.rng, Rotation.from_euler("z", self.rng.uniform(-30, 30), degrees=True)
        self.box((12, 12, 0.1), (0, 0, -below - 0.05))
        behind, beside = rng.uniform(0.7, 4.0), rng.choice([-1, 1]) * rng.uniform(0.8, 4.0)
        for size, place in (((8, 0.1, 5), (0, behind, 1)), ((0.1, 8, 5), (beside, 0, 1))):
            self.box(size, turn.apply(place), turn)
        if rng.random() < 0.5:
            self.box((0.8, 0.4, 1.8), turn.apply((rng.uniform(-1, 1), behind - 0.25, 0.9 - below)))
        if rng.random() < 0.3:
            lean = Rotation.from_euler("xyz", [*rng.uniform(-20, 20, 2), 0], degrees=True)
            self.box((0.06, 0.06, 2.4), (rng.uniform(-0.9, 0.9), behind * 0.7, 0), lean)

    def background(self, count: int, around: float) -> None:
        """Cartons, monitors on a foot and low boards on z = 0, all too large for a hand."""
        for _ in range(count):
            angle, rng = self.rng.uniform(0, np.pi), self.rng
            turn = Rotation.from_euler("z", rng.uniform(0, 360), degrees=True)
            kind = rng.integers(3)
            size = [(0.5, 0.3, 0.32), (0.55, 0.03, 0.34), (0.46, 0.2, 0.035)][kind]
            size = np.asarray(size) * rng.uniform(0.9, 1.3, size=3)
            away = around + rng.uniform(0.02, 0.2) + 0.5 * float(np.hypot(*size[:2]))
            x, y = away * np.cos(angle), away * np.sin(angle)
            lift = 0.12 if kind == 1 else 0.0
            self.box(size, (x, y, lift + size[2] / 2), turn)
            if lift:
                self.box((0.04, 0.03, lift), (x, y, lift / 2), turn)
                self.box((0.26, 0.2, 0.012), (x, y, 0.006), turn)

    def robot(self) -> None:
        """A robot in a random pose that touches no object; no robot after 40 failed tries."""
        rng, client = self.rng, self.world.client
        for _ in range(40):
            stands, angle = rng.random() < 0.4, rng.uniform(0, 2 * np.pi)
            away = rng.uniform(0.45, 0.7) if stands else rng.uniform(0.12, 0.4)
            place = [away * np.cos(angle), away * np.sin(angle), 0.0]
            turn = Rotation.from_euler("z", angle + np.pi) if stands else Rotation.random(rng=rng)
            place[2] = 0.0 if stands else rng.uniform(0.1, 0.4)
            file = Path(pybullet_data.getDataPath()) / rng.choice(ARMS if stands else HANGING)
            body = client.loadURDF(str(file), place, turn.as_quat().tolist(), useFixedBase=True)
            for joint in range(client.getNumJoints(body)):
                low, high = client.getJointInfo(body, joint)[8:10]
                client.resetJointState(body, joint, rng.uniform(*sorted((low, high))))
            others = [one.body.uid for one in self.objects]
            if not any(client.getClosestPoints(body, other, CLEAR) for other in others):
                return
            client.removeBody(body)

    def drop(self, count: int, half: tuple[float, float], height: float, upright: float) -> None:
        """Drop objects or stand them upright, within half extents (2,) around the middle."""
        for _ in range(count):
            models = self.sets[int(self.rng.random() < 0.5)]
            standing = self.rng.random() < upright
            yaw = Rotation.from_euler("z", self.rng.uniform(0, 360), degrees=True)
            turn = yaw if standing else Rotation.random(rng=self.rng)
            scale, model = float(self.rng.uniform(0.65, 1.05)), models.sample(self.rng)
            x, y = self.rng.uniform(-1, 1, size=2) * half
            new = load_object(self.world, model, (x, y, 2.0), turn.as_quat().tolist(), scale)
            lift = float(new.body.position[2] - new.body.bounds[0, 2]) + height
            new.body.set_pose((x, y, lift), turn.as_quat().tolist())
            self.world.detect_collisions()
            if any(contact.distance < -0.002 for contact in new.body.contacts()):
                new.body.remove()
            else:
                self.objects.append(new)
                wait_for_rest(self.world, self.objects, 1.5)

    def table(self) -> SceneAtRest:
        """Separate objects on a table with an edge near them."""
        size = self.rng.uniform(0.6, 1.4, size=2)
        top = self.box((*size, 0.04), (*self.rng.uniform(-0.15, 0.15, size=2), -0.02))
        self.room(self.rng.uniform(0.5, 0.9))
        self.background(int(self.rng.integers(1, 4)), 0.2)
        self.drop(int(self.rng.integers(3, 10)), (0.2, 0.18), 0.004, 0.6)
        return SceneAtRest(top, (15, 75), (190, 350), (0.5, 1.4), 0.3)

    def heap(self) -> SceneAtRest:
        """Objects in a heap on a table, or on a floor."""
        top = self.box((1.6, 1.2, 0.05), (0, 0, -0.025))
        self.room(self.rng.choice([0.05, self.rng.uniform(0.5, 0.9)]))
        self.background(int(self.rng.integers(0, 3)), 0.25)
        self.drop(int(self.rng.integers(7, 14)), (0.05, 0.05), 0.16, 0.0)
        return SceneAtRest(top, (0, 65), (190, 350), (0.45, 1.2), 0.3)

    def tray(self) -> SceneAtRest:
        """Objects on a tray with a low rim that stands on a table."""
        x, y = self.rng.uniform((0.32, 0.24), (0.5, 0.36)) / 2
        floor, rim = self.box((2 * x, 2 * y, 0.008), (0, 0, -0.004)), self.rng.uniform(0.01, 0.04)
        self.walls(x, y, rim, self.rng.uniform(0, 35), 0.004)
        self.box((1.4, 1.0, 0.04), (0, 0, -0.028))
        self.room(self.rng.uniform(0.5, 0.9))
        self.background(int(self.rng.integers(0, 3)), 0.3)
        self.drop(int(self.rng.integers(3, 9)), (x - 0.05, y - 0.05), 0.01, 0.5)
        return SceneAtRest(floor, (0, 65), (190, 350), (0.45, 1.1), max(x, y))

    def bin(self) -> SceneAtRest:
        """Objects poured into a bin, with or without a rim, its walls upright or sloped."""
        x, y = self.rng.uniform((0.28, 0.22), (0.6, 0.42)) / 2
        floor, deep = self.box((2 * x, 2 * y, 0.3), (0, 0, -0.15)), self.rng.uniform(0.06, 0.25)
        self.walls(x, y, deep, self.rng.uniform(0, 30), self.rng.choice([0.003, 0.008, 0.02]))
        self.room(0.3)
        self.drop(int(self.rng.integers(4, 22)), (x / 2, y / 2), deep * 0.6, 0.0)
        near = max(0.45, 1.1 * deep + 0.3)
        return SceneAtRest(floor, (0, 35), (0, 360), (near, near + 0.6), max(x, y))

    def shelf(self) -> SceneAtRest:
        """Objects in a compartment observed from the front, with other compartments around it."""
        wide, deep, high = self.rng.uniform((0.45, 0.25, 0.26), (0.9, 0.45, 0.45))
        board = self.rng.uniform(0.012, 0.03)
        levels = -board / 2, high + board / 2, -high - 2 * board, 2 * high + 2 * board
        low, *_ = [self.box((wide, deep, board), (0, 0, level)) for level in levels]
        for side in (-1, 1):
            self.box((board, deep, 3 * high + 6 * board), (side * (wide + board) / 2, 0, high / 2))
        if self.rng.random() < 0.8:
            self.box((wide, 0.01, 3 * high), (0, deep / 2, high / 2))
        self.room(1.0)
        self.drop(int(self.rng.integers(2, 7)), (wide / 2 - 0.06, deep / 2 - 0.05), 0.004, 0.6)
        return SceneAtRest(low, (55, 88), (245, 295), (0.5, 1.1), wide / 2)

    def walls(self, x: float, y: float, high: float, slope: float, thick: float) -> None:
        """Four walls around half extents x and y, which lean outward by `slope` degrees."""
        length = high / np.cos(np.radians(slope))
        for turn in range(4):
            half, along = (x, y) if turn % 2 == 0 else (y, x)
            yaw = Rotation.from_euler("z", 90 * turn, degrees=True)
            lean = yaw * Rotation.from_euler("y", slope, degrees=True)
            foot = yaw.apply((half + thick / 2, 0, 0))
            size = (thick, 2 * along + 2 * thick + high * np.tan(np.radians(slope)), length)
            self.box(size, foot + lean.apply((0, 0, length / 2)), lean)


def render_labelled_image(maker: SceneBuilder, made: SceneAtRest) -> dict[str, Float64]:
    """The image of a random depth camera, and its labels."""
    rng = maker.rng
    width, height = SIZES[int(rng.integers(len(SIZES)))]
    focal = width / 2 / np.tan(np.radians(rng.uniform(40, 75)) / 2)
    camera = SimCamera(width, height, float(focal), width / 2, height / 2, 0.1, FAR)
    polar, azimuth = np.radians(rng.uniform(*made.polar)), np.radians(rng.uniform(*made.azimuth))
    level = np.sin(polar) * np.array([np.cos(azimuth), np.sin(azimuth)])
    target = np.array([*rng.uniform(-0.05, 0.05, size=2), 0.05])
    away = max(rng.uniform(*made.distance), 0.8 * made.reach * focal / width * 2)
    T_world_camera = look_at(target + away * np.array([*level, np.cos(polar)]), target)
    roll = Rotation.from_euler("z", rng.normal(0, 12), degrees=True).as_matrix()
    T_world_camera[:3, :3] = T_world_camera[:3, :3] @ roll
    true, body = maker.world.render(T_world_camera, camera)
    depth = random_sensor(rng).apply(true, camera, rng)
    heights = np.full(true.shape, np.inf)
    heights[true < FAR_SHARE * FAR] = unproject_to_world(true, T_world_camera, camera)[:, 2]
    label = ((body == made.support) & (np.abs(heights) < FLAT)).astype(np.uint8)
    for number, item in enumerate(maker.objects):
        label[body == item.body.uid] = FIRST + number
    label = on_the_surface(label, true, depth)
    little = np.bincount(label.ravel(), minlength=FIRST) < LEAST * label.size
    label[little[label] & (label >= FIRST)] = 0
    millimetres = np.rint(1000 * np.nan_to_num(depth)).clip(0, 65535).astype(np.uint16)
    return {
        "depth": millimetres,
        "intrinsics": np.array([focal, focal, width / 2, height / 2 - 1], dtype=np.float32),
        "labels": np.where(millimetres > 0, label, 0).astype(np.uint8),
        "support_normal": T_world_camera[2, :3].astype(np.float32),  # world z, camera frame
        "support_offset": np.float32(-T_world_camera[2, 3]),
    }


def on_the_surface(label: NDArray[np.uint8], true: Float64, depth: Float64) -> NDArray[np.uint8]:
    """Labels (H, W) of the nearby surface that each reading lies on, 0 without a surface."""
    off = np.abs(depth - true)
    best, found = off.copy(), label.copy()
    for shift in product(range(-WINDOW, WINDOW + 1), repeat=2):
        there = np.abs(depth - np.roll(true, shift, axis=(0, 1)))
        nearer = (off > TOUCHED) & (there < best)
        best[nearer] = there[nearer]
        found[nearer] = np.roll(label, shift, axis=(0, 1))[nearer]
    return np.where(best <= TOUCHED, found, 0).astype(np.uint8)


def main(
    objects: Annotated[Path, Option()],
    output: Annotated[Path, Option()],
    seed: int = 0,
    each: Annotated[int, Option(help="Scenes of each kind.")] = 12,
    robots: Annotated[bool, Option(help="Add one or two robots to each; no shelves.")] = False,
) -> None:
    """Make the scenes."""
    output.mkdir(parents=True, exist_ok=True)
    for number, index in np.ndindex(len(KINDS) - robots, each):
        rng = np.random.default_rng([seed, number, index])
        labels = np.zeros((1, 1))
        while labels.max() < FIRST or (labels == 1).mean() < SUPPORT:
            maker = SceneBuilder(objects, rng)
            made = getattr(maker, KINDS[number])()
            for _ in range(int(rng.integers(1, 3)) if robots else 0):
                maker.robot()
            arrays = render_labelled_image(maker, made)
            labels = arrays["labels"]
            maker.world.close()
        np.savez_compressed(output / f"{KINDS[number]}_{index:02d}.npz", **arrays)


if __name__ == "__main__":
    run(main)
