"""What scenes of the `scene` network's training images are made of: meshes of objects and arms."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import open3d as o3d
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64
from edgegrasp_sim.engine.urdf import parse_obj
from edgegrasp_training.household import Mesh, household_mesh
from edgegrasp_training.shapes import NUM_DRAWN, drawn_shape

NUM_POOL, NUM_ARMS = 900, 60
ARMS = "franka_panda/panda.urdf", "xarm/xarm6_robot.urdf", "kuka_iiwa/model.urdf"
SOFT_SHARE = 0.25  # of the objects, bent and crumpled as bags, clothes and blister packs are


class PoolMesh(NamedTuple):
    """An object's surface, and points spread over it."""

    mesh: Mesh
    samples: Float64  # (S, 3) metres


def make_pool(rng: np.random.Generator, objects: Sequence[Path]) -> list[PoolMesh]:
    """Objects to draw from: of a set, drawn at random, hollow, and of a household."""
    texts = [objects[k].read_text() for k in rng.permutation(len(objects))[: NUM_POOL // 3]]
    texts += [drawn_shape(int(k)) for k in rng.permutation(NUM_DRAWN)[: NUM_POOL // 5]]
    meshes = [merged([surface for _, surface in parse_obj(text)]) for text in texts]
    while len(meshes) < NUM_POOL:
        meshes.append(merged(household_mesh(rng)[1]))
    return [
        pool_mesh(rng, softened(rng, mesh) if rng.random() < SOFT_SHARE else mesh)
        for mesh in meshes
    ]


def make_arms(rng: np.random.Generator) -> list[Mesh]:
    """Robot arms in random poses, their last link at the origin: PyBullet's own models."""
    import pybullet
    import pybullet_data
    import trimesh

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


def merged(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    start = np.cumsum([0] + [len(points) for points, _ in parts[:-1]])
    triangles = [each + first for (_, each), first in zip(parts, start, strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """A mesh of at most so many triangles: many times faster to cast rays at."""
    if len(mesh[1]) <= triangles:
        return mesh
    surface = _surface(mesh)
    surface = surface.simplify_quadric_decimation(triangles)
    return np.asarray(surface.vertices).copy(), np.asarray(surface.triangles).astype(np.int64)


def softened(rng: np.random.Generator, mesh: Mesh) -> Mesh:
    """A mesh bent by waves in random directions, most of them longer than half of the object."""
    surface = _surface(mesh)
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


def _posed(
    rng: np.random.Generator, body: int, links: Sequence[tuple[int, Mesh]], client: int
) -> Mesh:
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


def _surface(mesh: Mesh) -> o3d.geometry.TriangleMesh:
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh[0]), o3d.utility.Vector3iVector(mesh[1].astype(np.int32))
    )
