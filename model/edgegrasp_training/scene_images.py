"""Labelled depth images of simulated scenes, to train the `scene` network on.

A scene is a set of meshes: objects on a table, on the floor, in a bin, in a tray or on shelves, and
what else stands around. Objects are put down geometrically, each as low as what lies there already
lets it: no physics engine could make as many scenes in the time. Every ray knows what it hits, so
each pixel is labelled. The images then get the faults of depth cameras.

One command makes the whole data set again: `edgegrasp generate-scenes FOLDER --objects OBJECTS`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Array, Bools, Float32, Float64, Int64
from edgegrasp_sim.camera import look_at
from edgegrasp_sim.engine import Intrinsics
from edgegrasp_sim.engine.urdf import parse_obj
from edgegrasp_sim.sensor import random_sensor
from edgegrasp_training.household import household_mesh
from edgegrasp_training.shapes import NUM_DRAWN, drawn_shape

Mesh = tuple[Float64, Int64]  # (V, 3) metres, (F, 3)

WIDTH, HEIGHT = 320, 240  # pixels
DEPTH_UNIT = 0.0002  # metres of a stored depth; 16 bits reach 13 m
OTHER, SUPPORT, OBJECT = 0, 1, 2  # stored labels; objects are numbered from OBJECT
MAX_OBJECTS = 96
VIEWS_PER_SCENE = 4
SCENES_PER_FILE = 50
FILES_PER_POOL = 20  # that draw from the same objects
LEVEL = 0.85  # least z of a support's normal: its edges are labelled other
CELL = 0.005  # metres, of the height map that objects are put down on
REACH = 0.9  # metres that it extends to either side
APART = np.array([0.015, 0.015, 0.0])  # metres between objects that do not touch
LONGEST_OBJECT = 0.36  # metres; a longer one is background
NUM_POOL, NUM_ARMS = 900, 60
ARMS = "franka_panda/panda.urdf", "xarm/xarm6_robot.urdf", "kuka_iiwa/model.urdf"
WRONG = 0.02, 0.01  # metres, and share of the depth, by which a reading shows nothing real
UNSEEN_WALLS = 0.25  # of the images, in which steep background has no readings, or few
EMPTY_SHARE = 0.03  # of the scenes that have no object
SOFT_SHARE = 0.25  # of the objects, bent and crumpled as bags, clothes and blister packs are


class PoolMesh(NamedTuple):
    """An object's surface, and points spread over it."""

    mesh: Mesh
    samples: Float64  # (S, 3) metres


class SceneImage(NamedTuple):
    """A depth image with labels; camera frame: x right, y down, z forward; metres."""

    depth: NDArray[np.uint16]  # (H, W) in DEPTH_UNIT, 0 without a reading
    label: NDArray[np.uint8]  # (H, W) OTHER, SUPPORT, or OBJECT and up
    centre: Float32  # (MAX_OBJECTS, 3) of each object's box
    camera: Float32  # (4,) fx, fy, cx, cy in pixels
    up: Float32  # (3,) away from gravity
    plane: Float32  # (4,) of the main support: unit normal, offset


@dataclass
class SceneMeshes:
    """What a scene is made of, and where a camera should look."""

    parts: list[tuple[Mesh, int]] = field(default_factory=list)  # and the label of each
    centres: list[Float64] = field(default_factory=list)  # of the objects
    elevation: tuple[float, float] = (0.25, 1.5)  # radians above level, of the camera
    azimuth: tuple[float, float] = (-np.pi, np.pi)  # radians, 0 along x
    distance: tuple[float, float] = (0.3, 1.9)  # metres
    spread: float = 0.1  # metres around the target
    level: float = 0.0  # metres, of the main support

    _casting: o3d.t.geometry.RaycastingScene | None = None

    def casting(self) -> o3d.t.geometry.RaycastingScene:
        """What rays are cast at; once the scene is complete."""
        if self._casting is None:
            self._casting = _casting(self.parts)
        return self._casting

    def add(self, mesh: Mesh, label: int = OTHER) -> None:
        """Add background or a support."""
        self.parts.append((mesh, label))

    def add_object(self, mesh: Mesh) -> None:
        """Add an object, numbered in order; the last ones are left out where there are too many."""
        if len(self.centres) < MAX_OBJECTS:
            self.parts.append((mesh, OBJECT + len(self.centres)))
            self.centres.append((mesh[0].min(axis=0) + mesh[0].max(axis=0)) / 2)


class HeightMap:
    """How high what lies on a level surface reaches; objects are put down on it."""

    def __init__(self, half: tuple[float, float], walls: float = 0.0) -> None:
        """Free inside of a rectangle.

        Args:
            half: of its length and width, metres.
            walls: metres, height outside of it.
        """
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

    def rest(self, points: Float64) -> float:
        """How far an object with these surface points (N, 3) has to be raised to lie."""
        return float((self.height[self.cells(points)] - points[:, 2]).max())

    def put(self, points: Float64) -> None:
        """Let an object lie there."""
        np.maximum.at(self.height, self.cells(points), points[:, 2])


def make_image(rng: np.random.Generator, scene: SceneMeshes, pose: Float64) -> SceneImage | None:
    """Render a scene as a depth camera at `pose` (T_world_camera) sees it.

    Returns:
        The image; None where something hides the view or no object of the scene is in it.
    """
    focal = WIDTH / 2 / np.tan(np.radians(rng.uniform(35, 80)) / 2)
    camera = Intrinsics(WIDTH, HEIGHT, focal, WIDTH / 2, HEIGHT / 2, 0.1, 13.0)
    depth, label, steep = _cast(scene.casting(), scene.parts, camera, pose)
    close = (depth < 0.22).mean()
    seen = np.bincount(label.ravel(), minlength=OBJECT + MAX_OBJECTS)[OBJECT:]
    if close > 0.15 or (scene.centres and (seen > 25).sum() < 1):
        return None
    noisy, label = _faults(rng, depth, label, camera, pose, scene)
    if rng.random() < UNSEEN_WALLS:  # which leaves their rims floating
        noisy[steep & (label == OTHER) & (_blobs(rng, depth.shape) < rng.uniform(0.3, 1.0))] = (
            np.nan
        )
    stored = np.nan_to_num(np.clip(noisy / DEPTH_UNIT, 0, 65535)).astype(np.uint16)
    turn, place = pose[:3, :3], pose[:3, 3]
    centre = np.zeros((MAX_OBJECTS, 3), dtype=np.float32)
    if scene.centres:
        centre[: len(scene.centres)] = (np.array(scene.centres) - place) @ turn
    up = turn[2]
    plane = np.append(up, scene.level - place[2])
    intrinsics = np.array([focal, focal, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5])
    as_float = (intrinsics.astype(np.float32), up.astype(np.float32), plane.astype(np.float32))
    return SceneImage(stored, label, centre, *as_float)


def draw_pose(rng: np.random.Generator, scene: SceneMeshes) -> Float64:
    """A camera pose T_world_camera (4, 4) that looks at the scene's objects."""
    target = np.array([*rng.normal(0.0, scene.spread, 2), scene.level + rng.uniform(-0.05, 0.15)])
    if scene.centres and rng.random() < 0.7:
        target = scene.centres[int(rng.integers(len(scene.centres)))].copy()
        target += rng.normal(0.0, scene.spread, 3) * (1, 1, 0.3)
    low, high = np.sin(scene.elevation)
    elevation = float(np.arcsin(rng.uniform(low, high)))
    azimuth = rng.uniform(*scene.azimuth)
    distance = float(np.exp(rng.uniform(*np.log(scene.distance))))
    way = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
    pose = look_at(target + distance * np.array([*way, np.sin(elevation)]), target)
    roll = rng.normal(0.0, 0.1) if rng.random() < 0.65 else rng.uniform(-np.pi, np.pi)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll).as_matrix()
    return pose


def draw_scene(
    rng: np.random.Generator, pool: Sequence[PoolMesh], arms: Sequence[Mesh]
) -> SceneMeshes:
    """Any of the kinds of scenes."""
    draw: list[tuple[float, Callable[..., SceneMeshes]]] = [
        (0.34, _table),
        (0.33, _bin),
        (0.17, _shelf),
        (0.09, _tray),
        (0.07, _floor),
    ]
    shares = np.array([share for share, _ in draw])
    make = draw[int(rng.choice(len(draw), p=shares / shares.sum()))][1]
    return make(rng, pool, arms)


def generate(
    folder: Path, objects: Sequence[Path], files: int, seed: int, part: int, parts: int
) -> None:
    """Write numbered files of images, those that are not there yet.

    Args:
        folder: Gets `scenes-NNNN.npz`.
        objects: OBJ files of training objects.
        files: How many files of SCENES_PER_FILE scenes, with VIEWS_PER_SCENE images each.
        seed: Of all that is random.
        part: Which share of the files this process writes, from 0.
        parts: How many shares there are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn = -1
    for number in range(part, files, parts):
        path = folder / f"scenes-{number:04d}.npz"
        if path.exists():
            continue
        if drawn != number // FILES_PER_POOL:
            drawn = number // FILES_PER_POOL
            rng = np.random.default_rng([seed, drawn, 7])
            pool, arms = make_pool(rng, objects), make_arms(rng)
        rng = np.random.default_rng([seed, number])
        images: list[SceneImage] = []
        while len(images) < SCENES_PER_FILE * VIEWS_PER_SCENE:
            scene = draw_scene(rng, pool, arms)
            for _ in range(VIEWS_PER_SCENE):
                image = make_image(rng, scene, draw_pose(rng, scene))
                images += [] if image is None else [image]
        partial = path.with_suffix(".partial.npz")
        arrays = {
            name: np.stack(each)
            for name, each in zip(SceneImage._fields, zip(*images, strict=True), strict=True)
        }
        np.savez(partial, allow_pickle=False, **arrays)
        partial.replace(path)


# --- rendering ---


def _casting(parts: Sequence[tuple[Mesh, int]]) -> o3d.t.geometry.RaycastingScene:
    casting = o3d.t.geometry.RaycastingScene(nthreads=1)
    for (points, triangles), _ in parts:
        casting.add_triangles(
            _tensor(points.astype(np.float32)),
            _tensor(triangles.astype(np.uint32)),
        )
    return casting


def _tensor(array: Array) -> Any:
    """An array as Open3D takes it."""
    return o3d.core.Tensor(array)  # type: ignore[call-overload]


def _cast(
    casting: o3d.t.geometry.RaycastingScene,
    parts: Sequence[tuple[Mesh, int]],
    camera: Intrinsics,
    pose: Float64,
) -> tuple[Float64, NDArray[np.uint8], Bools]:
    """Depth (H, W) in metres, `far` where nothing is hit, labels (H, W), and where it is steep."""
    y, x = np.indices((camera.height, camera.width)) + 0.5
    rays = np.stack(
        [(x - camera.centre_x), (y - camera.centre_y), np.full(x.shape, camera.focal_length)], -1
    )
    direction = rays / camera.focal_length @ pose[:3, :3].T
    both = np.concatenate([np.broadcast_to(pose[:3, 3], direction.shape), direction], axis=-1)
    hit = casting.cast_rays(_tensor(both.astype(np.float32)), nthreads=1)
    depth = np.minimum(hit["t_hit"].numpy().astype(np.float64), camera.far)
    labels = np.array([label for _, label in parts] + [OTHER])
    which = np.minimum(hit["geometry_ids"].numpy().astype(np.int64), len(parts))
    label = labels[which]
    steep = np.abs(hit["primitive_normals"].numpy()[..., 2]) < LEVEL
    label[(label == SUPPORT) & steep] = OTHER
    return depth, label.astype(np.uint8), steep


def _faults(
    rng: np.random.Generator,
    depth: Float64,
    label: NDArray[np.uint8],
    camera: Intrinsics,
    pose: Float64,
    scene: SceneMeshes,
) -> tuple[Float64, NDArray[np.uint8]]:
    """The image as a real camera gives it, NaN without a reading, and what its readings show."""
    numbers = np.arange(OBJECT, OBJECT + len(scene.centres))
    glass = numbers[rng.random(len(numbers)) < 0.03]
    if len(glass):
        rest = [part for part in scene.parts if part[1] not in glass]
        behind, behind_label, _ = _cast(_casting(rest), rest, camera, pose)
        through = np.isin(label, glass) & (_blobs(rng, depth.shape) < rng.uniform(0.2, 1.0))
        depth, label = np.where(through, behind, depth), np.where(through, behind_label, label)
    if rng.random() < 0.12:
        noisy = depth + rng.normal(0.0, rng.uniform(0.0, 0.0015), depth.shape)
        noisy[depth >= 0.999 * camera.far] = np.nan
    else:
        noisy = random_sensor(rng).apply(depth, camera, rng)
    dark = np.append(numbers[rng.random(len(numbers)) < 0.08], [SUPPORT] * (rng.random() < 0.05))
    if len(dark):
        noisy[np.isin(label, dark) & (_blobs(rng, depth.shape) < rng.uniform(0.2, 0.9))] = np.nan
    if rng.random() < 0.15:  # patches that a lamp or a shiny surface blinds
        noisy[_blobs(rng, depth.shape, 40) < rng.uniform(0.02, 0.25)] = np.nan
    if rng.random() < 0.08:  # ghosts: reflections and wrong matches
        ghost = _blobs(rng, depth.shape, 16) < rng.uniform(0.002, 0.02)
        noisy[ghost] *= rng.uniform(0.6, 1.1)
    far = rng.uniform(2.5, 13.0)
    noisy[noisy > far] = np.nan
    if rng.random() < 0.3:  # a camera's least distance
        noisy[noisy < rng.uniform(0.2, 0.35)] = np.nan
    # Flying pixels and ghosts show nothing that is there.
    wrong = np.abs(noisy - depth) > WRONG[0] + WRONG[1] * depth
    return noisy, np.where(wrong, OTHER, label).astype(np.uint8)


def _blobs(rng: np.random.Generator, shape: tuple[int, ...], size: int = 10) -> Float64:
    """Smooth noise (H, W) whose values are spread evenly from 0 to 1."""
    coarse = rng.normal(size=(shape[0] // size + 2, shape[1] // size + 2))
    zoomed = ndimage.zoom(coarse, size, order=1)[: shape[0], : shape[1]]
    spread = np.sort(zoomed[::6, ::6].ravel())
    return np.asarray(np.searchsorted(spread, zoomed) / len(spread))


# --- objects ---


def make_pool(rng: np.random.Generator, objects: Sequence[Path]) -> list[PoolMesh]:
    """Objects to draw from: of a set, drawn at random, hollow, and of a household."""
    chosen = rng.permutation(len(objects))[: NUM_POOL // 3]
    meshes = [_mesh(objects[k].read_text()) for k in chosen]
    meshes += [_mesh(drawn_shape(int(k))) for k in rng.permutation(NUM_DRAWN)[: NUM_POOL // 5]]
    while len(meshes) < NUM_POOL:
        meshes.append(merged(household_mesh(rng).parts))
    return [
        pool_mesh(rng, softened(rng, mesh) if rng.random() < SOFT_SHARE else mesh)
        for mesh in meshes
    ]


def pool_mesh(rng: np.random.Generator, mesh: Mesh) -> PoolMesh:
    """A mesh about its box's centre, with points spread over its surface."""
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


def _mesh(obj: str) -> Mesh:
    """All of an OBJ file as one mesh."""
    return merged([surface for _, surface in parse_obj(obj)])


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """A mesh of at most so many triangles: many times faster to cast rays at."""
    if len(mesh[1]) <= triangles:
        return mesh
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh[0]), o3d.utility.Vector3iVector(mesh[1].astype(np.int32))
    )
    surface = surface.simplify_quadric_decimation(triangles)
    return np.asarray(surface.vertices).copy(), np.asarray(surface.triangles).astype(np.int64)


def softened(rng: np.random.Generator, mesh: Mesh) -> Mesh:
    """A mesh bent by waves in random directions, most of them longer than half of the object."""
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh[0]), o3d.utility.Vector3iVector(mesh[1].astype(np.int32))
    )
    while len(surface.triangles) < 1000:
        surface = surface.subdivide_midpoint()
    points = np.asarray(surface.vertices).copy()
    longest = np.ptp(points, axis=0).max()
    for _ in range(8):
        length = longest * np.exp(rng.uniform(-1.8, 0.4))
        direction, shift = rng.normal(size=(2, 3))
        direction *= 2 * np.pi / length / np.linalg.norm(direction)
        shift *= rng.uniform(0.0, 0.06) * length
        points += shift * np.sin(points @ direction + rng.uniform(0, 2 * np.pi))[:, None]
    return points, np.asarray(surface.triangles).astype(np.int64)


def merged(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    start = np.cumsum([0] + [len(points) for points, _ in parts[:-1]])
    triangles = [each + first for (_, each), first in zip(parts, start, strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)


def make_arms(rng: np.random.Generator) -> list[Mesh]:
    """Robot arms in random poses, their last link at the origin: PyBullet's own models."""
    import pybullet
    import pybullet_data
    import trimesh

    if NUM_ARMS == 0:
        return []
    folder, arms = Path(pybullet_data.getDataPath()), []
    client = pybullet.connect(pybullet.DIRECT)
    for name in ARMS:
        body = pybullet.loadURDF(str(folder / name), physicsClientId=client)
        links: list[tuple[int, Mesh]] = []
        for shape in pybullet.getVisualShapeData(body, physicsClientId=client):
            path = Path(shape[4].decode())
            if shape[2] == pybullet.GEOM_MESH and path.is_file():
                surface = trimesh.load_mesh(path, process=False)
                points = np.asarray(surface.vertices) * np.asarray(shape[3])
                points = points @ Rotation.from_quat(shape[6]).as_matrix().T + shape[5]
                links.append((shape[1], simplified((points, np.asarray(surface.faces)), 800)))
        arms += [_posed(rng, body, links, client) for _ in range(NUM_ARMS // len(ARMS))]
    pybullet.disconnect(client)
    return arms


def _posed(
    rng: np.random.Generator, body: int, links: Sequence[tuple[int, Mesh]], client: int
) -> Mesh:
    """An arm in a random pose."""
    import pybullet

    for joint in range(pybullet.getNumJoints(body, physicsClientId=client)):
        low, high = pybullet.getJointInfo(body, joint, physicsClientId=client)[8:10]
        low, high = (low, high) if low < high else (-1.0, 1.0)
        pybullet.resetJointState(body, joint, rng.uniform(low, high), physicsClientId=client)
    placed = []
    for link, (points, faces) in links:
        place, turn = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        if link >= 0:
            state = pybullet.getLinkState(body, link, 0, 1, physicsClientId=client)
            place, turn = state[4:6]
        placed.append((points @ Rotation.from_quat(turn).as_matrix().T + place, faces))
    points, faces = merged(placed)
    return points - placed[-1][0].mean(axis=0), faces


def _turned(rng: np.random.Generator, drawn: PoolMesh, how: str) -> PoolMesh:
    """An object stretched and turned: upright, lying on a face of its hull, or any way."""
    (points, triangles), samples = drawn
    factor = np.exp(rng.normal(0.0, 0.12, 3) + rng.normal(0.0, 0.12))
    longest = np.ptp(points, axis=0).max() * factor.max()
    factor *= min(1.0, LONGEST_OBJECT / longest)
    turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    if how == "any":
        turn = Rotation.random(rng=rng).as_matrix()
    elif how == "lying":
        try:
            hull = ConvexHull(samples * factor)
            size = 0.5 * np.linalg.norm(
                np.cross(*np.diff(hull.points[hull.simplices], axis=1).transpose(1, 0, 2)), axis=1
            )
            down = hull.equations[int(rng.choice(len(size), p=size / size.sum())), :3]
            to_down, _ = Rotation.align_vectors([[0, 0, -1]], [down])
            turn = turn @ to_down.as_matrix()
        except QhullError:
            pass
    scaled = factor * np.ones(3)
    return PoolMesh(((points * scaled) @ turn.T, triangles), (samples * scaled) @ turn.T)


def _lay_objects(
    rng: np.random.Generator,
    scene: SceneMeshes,
    pool: Sequence[PoolMesh],
    heights: HeightMap,
    count: int,
    how: str,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    around: float = 0.25,
    ceiling: float = np.inf,
) -> int:
    """Put objects down: `spread` apart, `touching` beside each other, or in a `heap`.

    Args:
        rng: Source of the draws.
        scene: Gets them.
        pool: To draw from.
        heights: What lies there; its origin is `origin` of the scene.
        count: How many are tried.
        how: As above.
        origin: (3,) metres.
        around: Metres, standard deviation of their places where they lie in a heap.
        ceiling: Metres above which nothing reaches.

    Returns:
        How many were put down.
    """
    put = 0
    pose = ("any", "lying") if how == "heap" else ("upright", "lying")
    lying = rng.random()
    for _ in range(count):
        drawn = pool[int(rng.integers(len(pool)))]
        drawn = _turned(rng, drawn, pose[int(rng.random() < lying)])
        (points, triangles), samples = drawn
        half = np.ptp(points, axis=0)[:2] / 2
        room = np.array(heights.half) - half
        if (room <= 0).any():
            continue
        offset = _lowest_place(rng, samples, heights, how, room, around, ceiling)
        if offset is None:
            continue
        heights.put(samples + offset)
        scene.add_object((points + offset + origin, triangles))
        put += 1
    return put


def _lowest_place(
    rng: np.random.Generator,
    samples: Float64,
    heights: HeightMap,
    how: str,
    room: Float64,
    around: float,
    ceiling: float,
) -> Float64 | None:
    """The shift (3,) that puts an object's points lowest, of some tried; None: it fits nowhere."""
    best: tuple[float, Float64] | None = None
    for _ in range(1 if how == "heap" else 10):
        place = rng.uniform(-room, room)
        if how != "spread":
            place = np.clip(rng.normal(0.0, around, 2), -room, room)
        moved = samples + np.array([*place, 0.0])
        apart = [moved, moved + APART, moved - APART] if how == "spread" else [moved]
        rise = heights.rest(np.concatenate(apart))
        lowest = rise + samples[:, 2].min()
        if how != "heap" and lowest > 0.004:
            continue
        if rise + samples[:, 2].max() < ceiling and (best is None or lowest < best[0]):
            best = (lowest, np.array([*place, rise]))
        if best is not None and how == "spread":
            break
    return None if best is None else best[1]


# --- kinds of scenes ---


def box(size: ArrayLike, centre: ArrayLike, yaw: float = 0.0) -> Mesh:
    """A box; size and centre (3,) metres."""
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    turn = Rotation.from_euler("z", yaw).as_matrix()
    return (corners * np.asarray(size)) @ turn.T + np.asarray(centre), _BOX_FACES


_BOX_FACES = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
     (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
)  # fmt: skip


def _surface(rng: np.random.Generator, half: tuple[float, float], bow: float) -> Mesh:
    """A level rectangle, bowed by up to `bow` metres as a cloth or a warped board is."""
    n = 24
    x, y = np.meshgrid(np.linspace(-half[0], half[0], n), np.linspace(-half[1], half[1], n))
    z = np.zeros_like(x)
    for _ in range(4):
        wave = rng.normal(0.0, 4.0, 2)
        z += rng.normal(0.0, 0.5) * np.sin(wave[0] * x + wave[1] * y + rng.uniform(0, 6.3))
    z = bow * z / max(np.abs(z).max(), 1e-9) * (rng.random() if bow else 0.0)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    return points, np.concatenate(
        [np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]
    )


def _count(rng: np.random.Generator, mean: float) -> int:
    return 0 if rng.random() < EMPTY_SHARE else 1 + int(rng.poisson(mean))


def _room(
    rng: np.random.Generator,
    scene: SceneMeshes,
    floor: float,
    pool: Sequence[PoolMesh],
    label: int = OTHER,
) -> None:
    """A floor at a height, walls, and large background around."""
    if label == SUPPORT or rng.random() < 0.85:
        scene.add(box((30, 30, 0.02), (0, 0, floor - 0.01)), label)
    for yaw in rng.uniform(0, 2 * np.pi) + np.arange(4) * np.pi / 2:
        if rng.random() < 0.45:
            away = rng.uniform(0.6, 6.0)
            place = away * np.array([np.cos(yaw), np.sin(yaw)])
            scene.add(box((0.1, 14, 3.5), (*place, floor + 1.7), yaw))
    for _ in range(int(rng.integers(0, 6))):
        yaw, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 4.0)
        size = rng.uniform(0.1, 0.9, 3)
        stand = floor + (rng.uniform(0, 0.6) if rng.random() < 0.3 else 0.0)
        where = (*(away * np.array([np.cos(yaw), np.sin(yaw)])), stand + size[2] / 2)
        scene.add(box(size, where, rng.uniform(0, 3)))
    for _ in range(int(rng.integers(0, 5))):  # small background out of reach
        yaw, away = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 3.0)
        (points, triangles), _ = pool[int(rng.integers(len(pool)))]
        points = points * rng.uniform(1.0, 3.0)
        where = (*(away * np.array([np.cos(yaw), np.sin(yaw)])), floor - points[:, 2].min())
        scene.add((points + where, triangles))


def _distractors(
    rng: np.random.Generator,
    scene: SceneMeshes,
    heights: HeightMap,
    half: tuple[float, float],
    pool: Sequence[PoolMesh],
) -> None:
    """Large or fixed background on a support: cartons, boards, monitors, pillars, cables."""

    def put(mesh: Mesh) -> None:
        samples = pool_mesh(rng, mesh)
        centre = (mesh[0].min(axis=0) + mesh[0].max(axis=0)) / 2
        heights.put(samples.samples + centre)
        scene.add(mesh)

    for _ in range(int(rng.integers(0, 5))):
        yaw = rng.uniform(0, 2 * np.pi)
        place = rng.uniform(0.35, 1.1) * np.array([rng.choice([-1, 1]), rng.choice([-1, 1])]) * half
        if rng.random() < 0.5:
            place[int(rng.integers(2))] *= rng.uniform(-1, 1)
        kind = rng.integers(7)
        if kind == 0:
            size = rng.uniform((0.38, 0.1, 0.04), (0.75, 0.5, 0.5))
            put(box(size, (*place, size[2] / 2), yaw))
        elif kind == 1:
            size = rng.uniform((0.38, 0.015, 0.2), (0.7, 0.05, 0.6))
            stand = rng.uniform(0.0, 0.2)
            panel = box(size, (*place, stand + size[2] / 2), yaw)
            pole = box((0.05, 0.05, stand + 0.01), (*place, stand / 2), yaw)
            foot = box((0.22, 0.18, 0.012), (*place, 0.006), yaw)
            put(merged([panel, pole, foot]))
        elif kind == 2:
            size = rng.uniform((0.38, 0.04, 0.006), (0.9, 0.45, 0.06))
            put(box(size, (*place, size[2] / 2), yaw))
        elif kind == 3:
            size = rng.uniform((0.03, 0.03, 0.4), (0.12, 0.12, 1.2))
            put(box(size, (*place, size[2] / 2), yaw))
        elif kind == 4:  # boards or cartons on top of each other
            low = 0.0
            for _ in range(int(rng.integers(2, 4))):
                size = rng.uniform((0.38, 0.12, 0.01), (0.6, 0.35, 0.12))
                shift = rng.normal(0.0, 0.02, 2)
                put(box(size, (*(place + shift), low + size[2] / 2), yaw + rng.normal(0.0, 0.1)))
                low += size[2]
        elif kind == 5:  # something of any shape, too large to lift
            drawn = pool[int(rng.integers(len(pool)))]
            longest = np.ptp(drawn.mesh[0], axis=0).max()
            points = drawn.mesh[0] * (rng.uniform(0.42, 0.9) / longest)
            turn = Rotation.from_euler("z", yaw).as_matrix()
            put((points @ turn.T + (*place, -points[:, 2].min()), drawn.mesh[1]))
        else:
            put(_cable(rng, place))


def _cable(rng: np.random.Generator, place: Float64) -> Mesh:
    """A long bent tube on the support."""
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0.0, 0.18, 50))
    step = rng.uniform(0.012, 0.03)
    way = place + np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    radius = rng.uniform(0.002, 0.008)
    angle = 2 * np.pi * np.arange(6) / 6
    side = np.stack([-np.sin(heading), np.cos(heading)], 1)
    points = np.concatenate(
        [
            (way[:, None] + radius * np.cos(angle)[None, :, None] * side[:, None]),
            np.broadcast_to(radius + radius * np.sin(angle)[None, :, None], (50, 6, 1)),
        ],
        axis=2,
    )
    this = (np.arange(49)[:, None] * 6 + np.arange(6)).ravel()
    beside = (np.arange(49)[:, None] * 6 + (np.arange(6) + 1) % 6).ravel()
    return points.reshape(-1, 3), np.concatenate(
        [np.stack([this, beside, beside + 6], 1), np.stack([this, beside + 6, this + 6], 1)]
    )


def _add_arm(
    rng: np.random.Generator, scene: SceneMeshes, arms: Sequence[Mesh], share: float = 0.25
) -> None:
    """A robot that reaches into the picture."""
    if arms and rng.random() < share:
        points, triangles = arms[int(rng.integers(len(arms)))]
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        place = (*rng.normal(0.0, 0.25, 2), scene.level + rng.uniform(0.02, 0.5))
        scene.add((points @ turn.T + place, triangles))


def _table(rng: np.random.Generator, pool: Sequence[PoolMesh], arms: Sequence[Mesh]) -> SceneMeshes:
    scene = SceneMeshes(elevation=(0.12, 1.57))
    half = (rng.uniform(0.25, 0.9), rng.uniform(0.2, 0.6))
    height = rng.uniform(0.3, 0.95)
    top = _surface(rng, half, rng.choice([0.0, 0.0, 0.012]))
    scene.add(top, SUPPORT)
    scene.add(box((2 * half[0], 2 * half[1], 0.03), (0, 0, -0.03)))
    if rng.random() < 0.5:
        scene.add(box((2 * half[0], 2 * half[1], height), (0, 0, -0.04 - height / 2)))
    else:
        for x in (-1, 1):
            for y in (-1, 1):
                scene.add(
                    box(
                        (0.05, 0.05, height),
                        (x * 0.9 * half[0], y * 0.9 * half[1], -0.04 - height / 2),
                    )
                )
    _room(rng, scene, -height - 0.04, pool)
    if rng.random() < 0.25:  # a step in the table, or another one beside it
        side = rng.uniform(0.15, 0.6)
        step = rng.choice([-1, 1, -1]) * rng.uniform(0.01, 0.25)
        scene.add(box((2 * side, 2.2 * half[1], 0.3), (half[0] + side, 0, step - 0.15)))
    heights = HeightMap(half)
    _distractors(rng, scene, heights, half, pool)
    _fill(rng, scene, pool, heights)
    _add_arm(rng, scene, arms)
    return scene


def _floor(rng: np.random.Generator, pool: Sequence[PoolMesh], arms: Sequence[Mesh]) -> SceneMeshes:
    scene = SceneMeshes(elevation=(0.2, 1.57), distance=(0.5, 2.2))
    _room(rng, scene, 0.0, pool, SUPPORT)
    heights = HeightMap((0.7, 0.7))
    _distractors(rng, scene, heights, (0.7, 0.7), pool)
    _fill(rng, scene, pool, heights)
    _add_arm(rng, scene, arms)
    return scene


def _fill(
    rng: np.random.Generator, scene: SceneMeshes, pool: Sequence[PoolMesh], heights: HeightMap
) -> None:
    """Objects on a table: apart, touching, or in a heap."""
    how = str(rng.choice(["spread", "touching", "heap"], p=[0.45, 0.3, 0.25]))
    count = _count(rng, {"spread": 6, "touching": 9, "heap": 11}[how])
    _lay_objects(rng, scene, pool, heights, count, how, around=rng.uniform(0.05, 0.22))


def _open_box(
    rng: np.random.Generator, half: tuple[float, float], depth: float, flush: bool
) -> list[Mesh]:
    """Four walls of an open box whose floor is at 0: vertical or sloped, perhaps ribbed."""
    slope = depth * rng.uniform(0.0, 0.6) if rng.random() < 0.5 else 0.0
    wall = rng.uniform(0.003, 0.025)
    rim = (
        rng.uniform(0.3, 1.0)
        if flush
        else wall + (rng.uniform(0.0, 0.03) if rng.random() < 0.5 else 0.0)
    )
    inner, top = np.array(half), np.array(half) + slope
    outer = top + rim
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    meshes = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        low = 0.0 if flush else -0.01
        lines = [
            (inner, low),
            (top, depth),
            (outer, depth),
            (top + wall, depth - 0.008 if not flush else depth - 0.02),
        ]
        lines += [(inner + wall, low)]
        points = np.array([(*(end * size), z) for size, z in lines for end in (a, b)])
        strips = [(2 * j, 2 * j + 1, 2 * j + 3, 2 * j + 2) for j in range(len(lines) - 1)]
        meshes.append(
            (points, np.array([t for p, q, r, s in strips for t in ((p, q, r), (p, r, s))]))
        )
    if rng.random() < 0.3:
        pitch = rng.uniform(0.03, 0.1)
        for axis in (0, 1):
            for place in np.arange(-half[1 - axis] + 0.02, half[1 - axis], pitch):
                for sign in (-1, 1):
                    centre = np.zeros(3)
                    centre[axis], centre[1 - axis], centre[2] = (
                        sign * (half[axis] + slope / 2),
                        place,
                        depth / 2,
                    )
                    size = np.full(3, 0.006)
                    size[axis], size[2] = slope + 0.008, depth
                    meshes.append(box(size, centre))
    return meshes


def _bin(rng: np.random.Generator, pool: Sequence[PoolMesh], arms: Sequence[Mesh]) -> SceneMeshes:
    scene = SceneMeshes(elevation=(0.75, 1.57), distance=(0.4, 1.5), spread=0.07)
    half = (rng.uniform(0.12, 0.35), rng.uniform(0.1, 0.28))
    depth = rng.uniform(0.03, 0.35)
    flush = rng.random() < 0.2
    if depth < 0.1:
        scene.elevation = (0.45, 1.57)
    scene.add(_surface(rng, half, 0.004), SUPPORT)
    for mesh in _open_box(rng, half, depth, flush):
        scene.add(mesh)
    scene.add(box((2 * half[0] + 0.004, 2 * half[1] + 0.004, 0.01), (0, 0, -0.012)))
    heights = HeightMap(half, walls=depth)
    fill = rng.uniform(-0.15, 1.5)
    around = rng.uniform(0.3, 1.0) * max(half)
    while fill > 0 and len(scene.centres) < 70:
        if heights.within(half).mean() > fill * depth * 0.9:
            break
        if (
            not _lay_objects(
                rng, scene, pool, heights, 3, "heap", around=around, ceiling=depth + 0.16
            )
            and rng.random() < 0.3
        ):
            break
    below = -0.013
    if rng.random() < 0.5 and not flush:  # on a table, on which others may lie
        table = (half[0] + rng.uniform(0.1, 0.6), half[1] + rng.uniform(0.1, 0.6))
        beside = rng.random() < 0.25
        scene.add(
            box((2 * table[0], 2 * table[1], 0.04), (0, 0, below - 0.02)),
            SUPPORT if beside else OTHER,
        )
        if beside:
            near = HeightMap(table)
            near.within((half[0] + 0.08, half[1] + 0.08))[:] = 1.0
            _lay_objects(rng, scene, pool, near, int(rng.integers(1, 6)), "spread", (0, 0, below))
        below -= 0.04 + rng.uniform(0.2, 0.8)
    elif not flush and rng.random() < 0.5:
        below -= rng.uniform(0.0, 0.8)
    _room(rng, scene, below - 0.001, pool)
    _add_arm(rng, scene, arms, 0.15)
    return scene


def _tray(rng: np.random.Generator, pool: Sequence[PoolMesh], arms: Sequence[Mesh]) -> SceneMeshes:
    """A low tray on a table, objects in it and perhaps beside it."""
    scene = SceneMeshes(elevation=(0.35, 1.57))
    half = (rng.uniform(0.14, 0.32), rng.uniform(0.1, 0.22))
    depth = rng.uniform(0.01, 0.05)
    scene.add(_surface(rng, half, 0.002), SUPPORT)
    for mesh in _open_box(rng, half, depth, flush=False):
        scene.add(mesh)
    heights = HeightMap(half)
    _fill(rng, scene, pool, heights)
    table = (half[0] + rng.uniform(0.1, 0.6), half[1] + rng.uniform(0.1, 0.5))
    scene.add(box((2 * table[0], 2 * table[1], 0.04), (0, 0, -0.031)), SUPPORT)
    near = HeightMap(table)
    near.within((half[0] + 0.07, half[1] + 0.07))[:] = 1.0
    if rng.random() < 0.6:
        _lay_objects(rng, scene, pool, near, int(rng.integers(1, 7)), "spread", (0, 0, -0.011))
    _room(rng, scene, -0.05 - rng.uniform(0.3, 0.8), pool)
    _add_arm(rng, scene, arms)
    return scene


def _shelf(rng: np.random.Generator, pool: Sequence[PoolMesh], arms: Sequence[Mesh]) -> SceneMeshes:
    """Boards one above the other, seen from the front (+x)."""
    scene = SceneMeshes(elevation=(-0.05, 0.75), azimuth=(-0.7, 0.7), distance=(0.4, 1.4))
    half = (rng.uniform(0.12, 0.3), rng.uniform(0.2, 0.6))
    gap, board = rng.uniform(0.22, 0.55), rng.uniform(0.01, 0.04)
    levels = int(rng.integers(1, 4))
    main = int(rng.integers(levels))
    back, sides = rng.random() < 0.8, rng.random() < 0.8
    for number in range(levels):
        level = (number - main) * (gap + board)
        floor_of = (0.0, 0.0, level)
        heights = HeightMap(half)
        before = len(scene.centres)
        if number == main or rng.random() < 0.6:
            how = str(rng.choice(["spread", "touching", "heap"], p=[0.5, 0.35, 0.15]))
            _lay_objects(rng, scene, pool, heights, _count(rng, 6), how, floor_of, 0.15, gap - 0.02)
        used = number == main or len(scene.centres) > before
        scene.add(
            box((2 * half[0], 2 * half[1], board), (0, 0, level - board / 2)),
            SUPPORT if used else OTHER,
        )
    top = (levels - main) * (gap + board)
    low = -main * (gap + board) - board
    if rng.random() < 0.8:
        scene.add(box((2 * half[0], 2 * half[1], board), (0, 0, top - board / 2)))
    if back:
        scene.add(box((0.01, 2 * half[1], top - low), (-half[0] - 0.005, 0, (top + low) / 2)))
    if sides:
        for sign in (-1, 1):
            scene.add(
                box(
                    (2 * half[0], board, top - low),
                    (0, sign * (half[1] + board / 2), (top + low) / 2),
                )
            )
    for wall in np.arange(-half[1], half[1], rng.uniform(0.3, 0.9))[1:]:
        if rng.random() < 0.15:
            scene.add(box((2 * half[0], board, top - low), (0, wall, (top + low) / 2)))
    scene.add(box((0.1, 8, 4), (-half[0] - rng.uniform(0.05, 1.5), 0, 0)))
    _room(rng, scene, low - rng.uniform(0.02, 1.2), pool)
    if rng.random() < 0.3:
        scene.elevation = (0.2, 1.0)
    _add_arm(rng, scene, arms, 0.1)
    return scene
