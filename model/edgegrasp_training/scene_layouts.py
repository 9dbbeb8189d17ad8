"""The scenes in the training images of the `scene` network.

A scene is a set of meshes: objects on a table, on the floor, in a bin, in a tray or on shelves, and
background around them. Objects are placed geometrically, each as low as the objects below it
permit; a physics engine would be too slow for so many scenes.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import open3d as o3d
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64, Int64
from edgegrasp_sim.objects import Mesh
from edgegrasp_training.household import lofted
from edgegrasp_training.shapes import joined

OTHER, SUPPORT, OBJECT = 0, 1, 2  # labels; objects are numbered from OBJECT
MAX_OBJECTS = 96
CELL = 0.005  # metres, cell of the height map on which objects are placed
REACH = 0.9  # metres that the height map extends to either side
APART = np.array([0.015, 0.015, 0.0])  # metres between objects that do not touch
LONGEST_OBJECT = 0.36  # metres; longer bodies are background
EMPTY_SHARE, FEW_SHARE = 0.03, 0.2  # shares of the scenes with no object, with one to three objects
FULL_SHARE = 0.3  # share of the bins in which objects lie from wall to wall
CROWDED_SHARE = 0.35  # share of the tables and floors with large background close to the objects


class PoolMesh(NamedTuple):
    """An object's surface, and points sampled on it."""

    mesh: Mesh
    samples: Float64  # (S, 3) metres


@dataclass(eq=False)
class SceneMeshes:
    """The meshes of a scene, and the range of camera poses."""

    rng: np.random.Generator  # for all random choices
    pool: Sequence[PoolMesh]  # objects to draw from
    parts: list[tuple[Mesh, int]] = field(default_factory=list)  # meshes with their labels
    centres: list[Float64] = field(default_factory=list)  # of the objects
    elevation: tuple[float, float] = (0.25, 1.5)  # radians above level, of the camera
    azimuth: tuple[float, float] = (-np.pi, np.pi)  # radians, 0 along x
    distance: tuple[float, float] = (0.3, 1.9)  # metres
    spread: float = 0.1  # metres around the target

    def add(self, mesh: Mesh, label: int = OTHER) -> None:
        """Add background or a support."""
        self.parts.append((mesh, label))

    def add_box(self, size: ArrayLike, centre: ArrayLike, yaw: float = 0.0) -> None:
        """Add a box to the background; see `box`."""
        self.add(box(size, centre, yaw))

    def add_object(self, mesh: Mesh) -> None:
        """Add an object, numbered in order; objects beyond MAX_OBJECTS are left out."""
        if len(self.centres) < MAX_OBJECTS:
            self.parts.append((mesh, OBJECT + len(self.centres)))
            self.centres.append((mesh[0].min(axis=0) + mesh[0].max(axis=0)) / 2)

    def any_of_pool(self) -> PoolMesh:
        """A random object of the pool."""
        return self.pool[int(self.rng.integers(len(self.pool)))]


def draw_scene(
    rng: np.random.Generator, pool: Sequence[PoolMesh], arms: Sequence[Mesh]
) -> SceneMeshes:
    """Draw a scene of a random kind."""
    shares = np.array([0.34, 0.33, 0.17, 0.09, 0.07])
    kind = int(rng.choice(len(shares), p=shares / shares.sum()))
    scene = SceneMeshes(rng, pool)
    (_table, _bin, _shelf, _tray, _floor)[kind](scene)
    if rng.random() < (0.25, 0.15, 0.1, 0.25, 0.25)[kind]:
        scene.add(_machine(scene, arms))
    return scene


def _machine(scene: SceneMeshes, arms: Sequence[Mesh]) -> Mesh:
    """A robot arm, or a chain of links of any shape; its end is near the objects."""
    rng = scene.rng
    end = np.array([*rng.normal(0.0, 0.22, 2), rng.uniform(0.01, 0.45)])
    if arms and rng.random() < 0.5:
        points, triangles = arms[int(rng.integers(len(arms)))]
        return points @ _turn(rng.uniform(0, 2 * np.pi)).T + end, triangles
    links: list[Mesh] = []
    away = np.array([*rng.normal(size=2), abs(rng.normal())])  # away and up
    way, wide = rng.normal(size=3), rng.uniform(0.015, 0.09)
    way[2] = abs(way[2])
    for _ in range(int(rng.integers(3, 9))):
        way = way / np.linalg.norm(way)
        points, triangles = scene.any_of_pool().mesh
        low, high = points.min(axis=0), points.max(axis=0)
        slim = ((points - (low + high) / 2) / (high - low))[:, np.argsort(high - low)]
        size = np.array([*wide * rng.uniform(0.6, 1.5, 2), rng.uniform(0.05, 0.4)])
        spin = Rotation.from_rotvec((0.0, 0.0, rng.uniform(0, 2 * np.pi)))
        turn = Rotation.align_vectors(way[None], np.array([[0.0, 0.0, 1.0]]))[0] * spin
        links.append((turn.apply(slim * size) + end + way * size[2] / 2, triangles))
        end = end + 0.95 * size[2] * way
        way = way + rng.normal(0.0, 0.6, 3) + 0.5 * away
        wide *= rng.uniform(0.9, 1.35)
    return merged(links)


def _table(scene: SceneMeshes) -> None:
    rng, scene.elevation = scene.rng, (0.12, 1.57)
    x, y = half = (rng.uniform(0.25, 0.9), rng.uniform(0.2, 0.6))
    height = rng.uniform(0.3, 0.95)
    scene.add(_surface(rng, half, rng.choice([0.0, 0.0, 0.012])), SUPPORT)
    scene.add_box((2 * x, 2 * y, 0.03), (0, 0, -0.03))
    middle = -0.04 - height / 2
    if rng.random() < 0.5:
        scene.add_box((2 * x, 2 * y, height), (0, 0, middle))
    else:
        for leg in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            place = leg[0] * 0.9 * x, leg[1] * 0.9 * y, middle
            scene.add_box((0.05, 0.05, height), place)
    _room(scene, -height - 0.04)
    if rng.random() < 0.25:  # a step in the table, or another table next to it
        side = rng.uniform(0.15, 0.6)
        step = rng.choice([-1, 1, -1]) * rng.uniform(0.01, 0.25)
        scene.add_box((2 * side, 2.2 * y, 0.3), (x + side, 0, step - 0.15))
    heights = HeightMap(half)
    _distractors(scene, heights)
    _fill(scene, heights)


def _floor(scene: SceneMeshes) -> None:
    scene.elevation, scene.distance = (0.2, 1.57), (0.5, 2.2)
    _room(scene, 0.0, SUPPORT)
    heights = HeightMap((0.7, 0.7))
    _distractors(scene, heights)
    _fill(scene, heights)


def _bin(scene: SceneMeshes) -> None:
    rng, scene.distance, scene.spread = scene.rng, (0.4, 1.5), 0.07
    half = (rng.uniform(0.12, 0.35), rng.uniform(0.1, 0.28))
    depth = rng.uniform(0.03, 0.35)
    flush = rng.random() < 0.2
    round_bin = not flush and rng.random() < 0.12
    scene.elevation = (0.45 if depth < 0.1 else 0.75, 1.57)
    if round_bin:  # an ellipse around the rectangle
        scene.add(joined(lofted(_ROUND, np.outer((0.0, 1.0), half), [0.0, 0.0])), SUPPORT)
    else:
        scene.add(_surface(rng, half, 0.004), SUPPORT)
    _open_box(scene, half, depth, flush, round_bin)
    if not round_bin:
        scene.add_box((2 * half[0] + 0.004, 2 * half[1] + 0.004, 0.01), (0, 0, -0.012))
    heights = HeightMap(half, walls=depth)
    if rng.random() < 0.12:  # a wall between compartments
        size, place = np.array([0.006, 2 * half[1], depth]), rng.uniform(-0.4, 0.4) * half[0]
        size[2] *= rng.uniform(0.3, 1.0)
        scene.add_box(size, (place, 0, size[2] / 2))
        y, z = rng.uniform(-0.5, 0.5, (2, 3000))
        points = np.stack([np.full(3000, place), y * size[1], (z + 0.5) * size[2]], axis=1)
        heights.put(points)
    fill, around = rng.uniform(-0.15, 1.5), rng.uniform(0.3, 1.0) * max(half)
    if rng.random() < FULL_SHARE:
        fill, around = rng.uniform(0.5, 1.5), rng.uniform(1.0, 2.0) * max(half)
    while fill > 0 and len(scene.centres) < 70:
        if heights.within(half).mean() > fill * depth * 0.9:
            break
        put = _lay_objects(scene, heights, 3, "heap", around=around, ceiling=depth + 0.16)
        if not put and rng.random() < 0.3:
            break
    below = -0.013
    if rng.random() < 0.5 and not flush:  # on a table, which may carry other objects
        x, y = table = (half[0] + rng.uniform(0.1, 0.6), half[1] + rng.uniform(0.1, 0.6))
        beside = rng.random() < 0.25
        top = box((2 * x, 2 * y, 0.04), (0, 0, below - 0.02))
        scene.add(top, SUPPORT if beside else OTHER)
        if beside:
            near = HeightMap(table)
            near.within((half[0] + 0.08, half[1] + 0.08))[:] = 1.0
            _lay_objects(scene, near, int(rng.integers(1, 6)), "spread", (0, 0, below))
        below -= 0.04 + rng.uniform(0.2, 0.8)
    elif not flush and rng.random() < 0.5:
        below -= rng.uniform(0.0, 0.8)
    _room(scene, below - 0.001)


def _tray(scene: SceneMeshes) -> None:
    """A low tray on a table, with objects in it and perhaps next to it."""
    rng, scene.elevation = scene.rng, (0.35, 1.57)
    half = (rng.uniform(0.14, 0.32), rng.uniform(0.1, 0.22))
    depth = rng.uniform(0.01, 0.05)
    scene.add(_surface(rng, half, 0.002), SUPPORT)
    _open_box(scene, half, depth, flush=False)
    _fill(scene, HeightMap(half))
    x, y = table = (half[0] + rng.uniform(0.1, 0.6), half[1] + rng.uniform(0.1, 0.5))
    scene.add(box((2 * x, 2 * y, 0.04), (0, 0, -0.031)), SUPPORT)
    near = HeightMap(table)
    near.within((half[0] + 0.07, half[1] + 0.07))[:] = 1.0
    if rng.random() < 0.6:
        _lay_objects(scene, near, int(rng.integers(1, 7)), "spread", (0, 0, -0.011))
    _room(scene, -0.05 - rng.uniform(0.3, 0.8))


def _shelf(scene: SceneMeshes) -> None:
    """Boards one above another, observed from the front (+x)."""
    rng, scene.azimuth, scene.distance = scene.rng, (-0.7, 0.7), (0.4, 1.4)
    x, y = half = (rng.uniform(0.12, 0.3), rng.uniform(0.2, 0.6))
    gap, board = rng.uniform(0.22, 0.55), rng.uniform(0.01, 0.04)
    levels = int(rng.integers(1, 4))
    main = int(rng.integers(levels))
    back, sides = rng.random() < 0.8, rng.random() < 0.8
    for number in range(levels):
        level = (number - main) * (gap + board)
        before = len(scene.centres)
        if number == main or rng.random() < 0.6:
            how = str(rng.choice(["spread", "touching", "heap"], p=[0.5, 0.35, 0.15]))
            count, origin = _count(rng, 6), (0.0, 0.0, level)
            _lay_objects(scene, HeightMap(half), count, how, origin, 0.15, gap - 0.02)
        used = number == main or len(scene.centres) > before
        slab = box((2 * x, 2 * y, board), (0, 0, level - board / 2))
        scene.add(slab, SUPPORT if used else OTHER)
    top = (levels - main) * (gap + board)
    low = -main * (gap + board) - board
    tall, middle = top - low, (top + low) / 2
    if rng.random() < 0.8:
        scene.add_box((2 * x, 2 * y, board), (0, 0, top - board / 2))
    if back:
        scene.add_box((0.01, 2 * y, tall), (-x - 0.005, 0, middle))
    if sides:
        for sign in (-1, 1):
            scene.add_box((2 * x, board, tall), (0, sign * (y + board / 2), middle))
    for wall in np.arange(-y, y, rng.uniform(0.3, 0.9))[1:]:
        if rng.random() < 0.15:
            scene.add_box((2 * x, board, tall), (0, wall, middle))
    scene.add_box((0.1, 8, 4), (-x - rng.uniform(0.05, 1.5), 0, 0))
    _room(scene, low - rng.uniform(0.02, 1.2))
    scene.elevation = (0.2, 1.0) if rng.random() < 0.3 else (-0.05, 0.75)


def _fill(scene: SceneMeshes, heights: "HeightMap") -> None:
    rng = scene.rng
    how = str(rng.choice(["spread", "touching", "heap"], p=[0.45, 0.3, 0.25]))
    count = _count(rng, {"spread": 6, "touching": 9, "heap": 11}[how])
    _lay_objects(scene, heights, count, how, around=rng.uniform(0.05, 0.22))


def _count(rng: np.random.Generator, mean: float) -> int:
    """A number of objects: none, a few as at the end of clearing, or about `mean`."""
    few = rng.random() < FEW_SHARE
    if rng.random() < EMPTY_SHARE:
        return 0
    return int(rng.integers(1, 4)) if few else 1 + int(rng.poisson(mean))


def _room(scene: SceneMeshes, floor: float, label: int = OTHER) -> None:
    """A floor at a height, walls, and large background around."""
    rng = scene.rng
    if label == SUPPORT or rng.random() < 0.85:
        scene.add(box((30, 30, 0.02), (0, 0, floor - 0.01)), label)
    for yaw in rng.uniform(0, 2 * np.pi) + np.arange(4) * np.pi / 2:
        if rng.random() < 0.45:
            away = rng.uniform(0.6, 6.0)
            scene.add_box((0.1, 14, 3.5), (*_aside(yaw, away), floor + 1.7), yaw)
    for _ in range(int(rng.integers(0, 6))):
        yaw, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 4.0)
        size = rng.uniform(0.1, 0.9, 3)
        stand = floor + (rng.uniform(0, 0.6) if rng.random() < 0.3 else 0.0)
        scene.add_box(size, (*_aside(yaw, away), stand + size[2] / 2), rng.uniform(0, 3))
    for _ in range(int(rng.integers(0, 5))):  # small background out of reach
        yaw, away = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 3.0)
        points, triangles = scene.any_of_pool().mesh
        points = points * rng.uniform(1.0, 3.0)
        place = np.array([*_aside(yaw, away), floor - points[:, 2].min()])
        scene.add((points + place, triangles))
    for _ in range(int(rng.integers(0, 4))):
        away = rng.uniform(0.5, 2.5)
        scene.add(_frame(rng, (*_aside(rng.uniform(0, 2 * np.pi), away), floor + 0.03)))
    if rng.random() < 0.2:  # a rail, a hose, or a cable that hangs into the view
        away = rng.uniform(0.1, 0.5)
        start = *_aside(rng.uniform(0, 2 * np.pi), away), rng.uniform(0.1, 0.6)
        scene.add(_frame(rng, start) if rng.random() < 0.6 else _cable(rng, start))


def _frame(rng: np.random.Generator, start: ArrayLike) -> Mesh:
    """Connected bars: the foot of a chair, a stand, a camera's rig, a rack."""
    import trimesh

    origin = np.asarray(start, dtype=np.float64)
    ends, bars = [origin], list[Mesh]()
    longest, width = rng.uniform(0.15, 1.2), rng.uniform(0.008, 0.08)
    spokes, straight = rng.random() < 0.4, rng.random() < 0.6  # all from one point; right angles
    for _ in range(int(rng.integers(1, 8))):
        way = np.eye(3)[rng.integers(3)] if straight and not spokes else rng.normal(size=3)
        way[2] = abs(way[2]) * (0.1 if spokes else 1.0)
        way *= longest * rng.uniform(0.4, 1.0) / np.linalg.norm(way)
        first = ends[0 if spokes else int(rng.integers(len(ends)))]
        radius, sections = width * rng.uniform(0.6, 1.0) / 2, int(rng.choice([4, 8]))
        ends_of_bar = np.stack([first, first + way])
        bar = trimesh.creation.cylinder(radius, sections=sections, segment=ends_of_bar)
        bars.append((bar.vertices, bar.faces))
        ends += [first + way, first + way * rng.random()]
    points, triangles = merged(bars)
    return (points - origin) @ _turn(rng.uniform(0, 2 * np.pi)).T + origin, triangles


def _aside(yaw: float, away: float) -> Float64:
    return away * np.array([np.cos(yaw), np.sin(yaw)])


def _distractors(scene: SceneMeshes, heights: "HeightMap") -> None:
    """Large or fixed background on a support: cartons, boards, panels, monitors, cables."""
    rng = scene.rng
    boxes = {  # minimum and maximum size: cartons, boards, pillars, panels
        0: ((0.38, 0.1, 0.04), (0.75, 0.5, 0.5)),
        2: ((0.38, 0.04, 0.006), (0.9, 0.45, 0.06)),
        3: ((0.03, 0.03, 0.4), (0.12, 0.12, 1.2)),
        7: ((0.3, 0.012, 0.25), (1.0, 0.08, 0.9)),
    }
    crowded = rng.random() < CROWDED_SHARE  # the image may show only parts of them

    def put(mesh: Mesh) -> None:
        samples = pool_mesh(rng, mesh)
        centre = (mesh[0].min(axis=0) + mesh[0].max(axis=0)) / 2
        heights.put(samples.samples + centre)
        scene.add(mesh)

    for _ in range(int(rng.integers(0, 5 + 3 * crowded))):
        yaw, sides = rng.uniform(0, 2 * np.pi), rng.uniform(0.15 if crowded else 0.35, 1.1)
        place = sides * np.array([rng.choice([-1, 1]), rng.choice([-1, 1])]) * heights.half
        if rng.random() < 0.5:
            place[int(rng.integers(2))] *= rng.uniform(-1, 1)
        kind = int(rng.integers(8))
        if kind in boxes:
            size = rng.uniform(*boxes[kind])
            put(box(size, (*place, size[2] / 2), yaw))
        elif kind == 1:  # a monitor
            size = rng.uniform((0.38, 0.015, 0.2), (0.7, 0.05, 0.6))
            stand = rng.uniform(0.0, 0.2)
            panel = box(size, (*place, stand + size[2] / 2), yaw)
            pole = box((0.05, 0.05, stand + 0.01), (*place, stand / 2), yaw)
            foot = box((0.22, 0.18, 0.012), (*place, 0.006), yaw)
            put(merged([panel, pole, foot]))
        elif kind == 4:  # stacked boards or cartons
            low = 0.0
            for _ in range(int(rng.integers(2, 4))):
                size = rng.uniform((0.38, 0.12, 0.01), (0.6, 0.35, 0.12))
                shift = rng.normal(0.0, 0.02, 2)
                put(box(size, (*(place + shift), low + size[2] / 2), yaw + rng.normal(0.0, 0.1)))
                low += size[2]
        elif kind == 5:  # a body of any shape, too large to lift
            points, triangles = scene.any_of_pool().mesh
            points = points * (rng.uniform(0.42, 0.9) / np.ptp(points, axis=0).max())
            put((points @ _turn(yaw).T + (*place, -points[:, 2].min()), triangles))
        else:
            put(_cable(rng, place))


def _cable(rng: np.random.Generator, place: ArrayLike) -> Mesh:
    """A cable from a place (2,) on the support, or through a place (3,) above it."""
    start, rise = np.asarray(place), np.zeros(50)
    if len(start) == 3:
        rise = start[2] + np.cumsum(rng.normal(0.0, 0.004) + rng.normal(0.0, 0.004, 50))
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0.0, 0.18, 50))
    step = rng.uniform(0.012, 0.03)
    way = start[:2] + np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    radius = rng.uniform(0.002, 0.008)
    angle = 2 * np.pi * np.arange(6) / 6
    side = np.stack([-np.sin(heading), np.cos(heading)], 1)
    level = way[:, None] + radius * np.cos(angle)[None, :, None] * side[:, None]
    height = rise[:, None, None] + radius + radius * np.sin(angle)[None, :, None]
    return joined(np.concatenate([level, height], axis=2))


def _open_box(
    scene: SceneMeshes, half: tuple[float, float], depth: float, flush: bool, is_round: bool = False
) -> None:
    """Walls around a floor at 0: vertical or sloped, perhaps ribbed or with handles."""
    rng = scene.rng
    slope = depth * rng.uniform(0.0, 0.6) if rng.random() < 0.5 else 0.0
    wall = rng.uniform(0.003, 0.025)
    if flush:
        rim, low, behind = rng.uniform(0.3, 1.0), 0.0, depth - 0.02
    else:
        rim = wall + (rng.uniform(0.0, 0.03) if rng.random() < 0.5 else 0.0)
        low, behind = -0.01, depth - 0.008
    inner, top = np.array(half), np.array(half) + slope
    corners = _ROUND if is_round else np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    sizes = np.array([inner, top, top + rim, top + wall, inner + wall])
    scene.add(joined(lofted(corners, sizes, [low, depth, depth, behind, low])))
    if is_round:
        return
    for _ in range(int(rng.integers(1, 7)) if rng.random() < 0.35 else 0):  # handles and bosses
        axis, sign = int(rng.integers(2)), rng.choice([-1, 1])
        size = rng.uniform((0.02, 0.02, 0.01), (0.15, 0.15, 0.08))
        size[1 - axis] = rng.uniform(0.006, 0.04)
        centre = np.zeros(3)
        centre[2] = depth * rng.uniform(0.1, 1.0)
        centre[axis] = rng.uniform(-0.8, 0.8) * half[axis]
        out = slope * centre[2] / depth + (0.0 if rng.random() < 0.5 else wall)
        centre[1 - axis] = sign * (half[1 - axis] + out)
        scene.add_box(size, centre)
    if rng.random() < 0.3:
        pitch = rng.uniform(0.03, 0.1)
        for axis in (0, 1):
            size = np.full(3, 0.006)
            size[axis], size[2] = slope + 0.008, depth
            for place in np.arange(-half[1 - axis] + 0.02, half[1 - axis], pitch):
                for sign in (-1, 1):
                    centre = np.full(3, depth / 2)
                    centre[axis], centre[1 - axis] = sign * (half[axis] + slope / 2), place
                    scene.add_box(size, centre)


_ROUND = np.sqrt(2) * np.stack(
    [np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12)], axis=1
)


def _surface(rng: np.random.Generator, half: tuple[float, float], bow: float) -> Mesh:
    """A level rectangle, bowed by up to `bow` metres like a cloth or a warped board."""
    n = 24
    x, y = np.meshgrid(np.linspace(-half[0], half[0], n), np.linspace(-half[1], half[1], n))
    z = np.zeros_like(x)
    for _ in range(4):
        wave = rng.normal(0.0, 4.0, 2)
        z += rng.normal(0.0, 0.5) * np.sin(wave[0] * x + wave[1] * y + rng.uniform(0, 6.3))
    z = bow * z / max(np.abs(z).max(), 1e-9) * (rng.random() if bow else 0.0)
    return joined(np.stack([x, y, z], axis=-1), closed=False)


def box(size: ArrayLike, centre: ArrayLike, yaw: float = 0.0) -> Mesh:
    """A box; size and centre (3,) metres."""
    import trimesh

    made = trimesh.creation.box(size)
    return made.vertices @ _turn(yaw).T + np.asarray(centre), made.faces


def pool_mesh(rng: np.random.Generator, mesh: Mesh) -> PoolMesh:
    """A mesh centred on its bounding box, with points sampled on its surface."""
    points, triangles = simplified(mesh, 1500)
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    a, b, c = points[triangles].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) + 1e-12
    pick = rng.choice(len(triangles), 700, p=area / area.sum())
    u, v = rng.random((2, 700, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    samples = a[pick] + u * (b - a)[pick] + v * (c - a)[pick]
    corners = points[:: max(len(points) // 300, 1)]
    return PoolMesh((points, triangles), np.concatenate([samples, corners]))


def merged(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    start = np.cumsum([0] + [len(points) for points, _ in parts[:-1]])
    triangles = [each + first for (_, each), first in zip(parts, start, strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """A mesh with at most this number of triangles, which makes ray casting many times faster."""
    if len(mesh[1]) <= triangles:
        return mesh
    rows = o3d.utility.Vector3iVector(mesh[1].astype(np.int32))
    surface = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(mesh[0]), rows)
    surface = surface.simplify_quadric_decimation(triangles)
    return np.asarray(surface.vertices).copy(), np.asarray(surface.triangles).astype(np.int64)


class HeightMap:
    """Heights of the objects on a level surface, on which further objects are placed."""

    def __init__(self, half: tuple[float, float], walls: float = 0.0) -> None:
        """Height 0 inside a rectangle of half sides `half`, `walls` outside of it, metres."""
        size = round(2 * REACH / CELL)
        self.height = np.full((size, size), walls)
        self.half = half
        self.within(half)[:] = 0.0

    def within(self, half: tuple[float, float]) -> Float64:
        """The heights in a rectangle around the origin; a view."""
        low = [round((REACH - min(each, REACH)) / CELL) for each in half]
        size = len(self.height)
        return self.height[low[0] : size - low[0], low[1] : size - low[1]]

    def cells(self, points: Float64) -> tuple[Int64, Int64]:
        """The cells below points (N, 3)."""
        index = ((points[:, :2] + REACH) / CELL).astype(np.int64)
        index = np.clip(index, 0, len(self.height) - 1)
        return index[:, 0], index[:, 1]

    def put(self, points: Float64) -> None:
        """Add an object's surface to the heights."""
        np.maximum.at(self.height, self.cells(points), points[:, 2])


def _lay_objects(
    scene: SceneMeshes,
    heights: HeightMap,  # of the surface so far; its origin is `origin` of the scene
    count: int,  # number of objects to try
    how: str,
    origin: Sequence[float] = (0.0, 0.0, 0.0),  # (3,) metres
    around: float = 0.25,  # metres, standard deviation of positions if not `spread`
    ceiling: float = np.inf,  # metres, maximum height of an object's top
) -> int:
    """Place objects: `spread` apart, `touching`, or in a `heap`; returns how many were placed."""
    rng, put = scene.rng, 0
    pose = ("any", "lying") if how == "heap" else ("upright", "lying")
    lying = rng.random()
    for _ in range(count):
        drawn = scene.any_of_pool()
        (points, triangles), samples = _turned(rng, drawn, pose[int(rng.random() < lying)])
        room = np.array(heights.half) - np.ptp(points, axis=0)[:2] / 2
        if (room <= 0).any():
            continue
        best, offset = np.inf, None  # the lowest height found, and the shift to it
        for _ in range(1 if how == "heap" else 10):
            place = rng.uniform(-room, room)
            if how != "spread":
                place = np.clip(rng.normal(0.0, around, 2), -room, room)
            moved = samples + np.array([*place, 0.0])
            apart = [moved, moved + APART, moved - APART] if how == "spread" else [moved]
            below = np.concatenate(apart)
            rise = float((heights.height[heights.cells(below)] - below[:, 2]).max())
            lowest = rise + samples[:, 2].min()
            if how != "heap" and lowest > 0.004:
                continue
            if rise + samples[:, 2].max() < ceiling and lowest < best:
                best, offset = lowest, np.array([*place, rise])
            if offset is not None and how == "spread":
                break
        if offset is not None:
            heights.put(samples + offset)
            scene.add_object((points + offset + origin, triangles))
            put += 1
    return put


def _turned(rng: np.random.Generator, drawn: PoolMesh, how: str) -> PoolMesh:
    """An object stretched and rotated: upright, lying on a face of its hull, or at random."""
    (points, triangles), samples = drawn
    factor = np.exp(rng.normal(0.0, 0.12, 3) + rng.normal(0.0, 0.12))
    longest = np.ptp(points, axis=0).max() * factor.max()
    factor *= min(1.0, LONGEST_OBJECT / longest)
    turn = _turn(rng.uniform(0, 2 * np.pi))
    if how == "any":
        turn = Rotation.random(rng=rng).as_matrix()
    elif how == "lying":
        with suppress(QhullError):
            hull = ConvexHull(samples * factor)
            sides = np.diff(hull.points[hull.simplices], axis=1).transpose(1, 0, 2)
            size = np.linalg.norm(np.cross(*sides), axis=1)
            down = hull.equations[int(rng.choice(len(size), p=size / size.sum())), :3]
            to_down, _ = Rotation.align_vectors([[0, 0, -1]], [down])
            turn = turn @ to_down.as_matrix()
    return PoolMesh(((points * factor) @ turn.T, triangles), (samples * factor) @ turn.T)


def _turn(yaw: float) -> Float64:
    return Rotation.from_euler("z", yaw).as_matrix()
