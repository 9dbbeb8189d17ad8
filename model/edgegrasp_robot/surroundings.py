"""What an arm must not touch: the seen cloud, the support, obstacles; and where it may start."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from roboplan import core
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Bools, Float64
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import Box, OrientedBox, RobotArm
from edgegrasp_model.scene.obstacles import box_pose
from edgegrasp_model.scene.scene import Scene
from edgegrasp_robot.robot import HAND, Robot, touching

CELL = 0.01  # metres, side of a voxel
AROUND = 2.0  # metres from the arm's base: what is beyond is left out
SEEN_SELF = 0.02  # metres from the arm within which the camera sees the arm itself
INSIDE = 10  # voxels of objects that may lie within the arm, as the camera errs
SLAB = (6.0, 6.0, 0.5)  # metres, of the support
GREY = np.ones(4)

Obstacle = tuple[str, core.Box | core.OcTree, Float64]  # its name, shape and pose in the base frame


@contextmanager
def surrounded(
    robot: Robot,
    scene: Scene,
    points: object,
    asked: RobotArm,
    boxes: Sequence[Box | OrientedBox],
) -> Iterator[set[int | None]]:
    """Put what is around the robot into its scenes, and take it away afterwards.

    The hand may touch it in `robot.straight`: there it goes where the detection found it free.

    Args:
        robot: The robot.
        scene: What the camera's cloud shows.
        points: (..., 3) metres, cloud frame: the whole cloud.
        asked: Where the robot is.
        boxes: Obstacles beside the cloud, cloud frame.

    Yields:
        Numbers of objects that are the arm itself, as the camera sees it.

    Raises:
        InvalidRequest: It touches something where it is, or stands within an object.
    """
    joints = np.array(asked.joints)
    T_base_cloud = np.reshape(asked.T_base_cloud, (4, 4))
    own = _own_objects(robot, joints, scene, T_base_cloud)
    around = [_box(row, box, T_base_cloud) for row, box in enumerate(boxes)]
    T_base_scene = T_base_cloud @ np.linalg.inv(scene.frame.T_canonical_cloud)
    if scene.support is not None:
        around.append(_support(scene, T_base_scene))
    if (cloud := _cloud(robot, joints, scene, points, T_base_scene)) is not None:
        around.append(cloud)
    names = [name for name, _, _ in around]
    for planned in (robot.scene, robot.straight):
        _add(planned, robot, around)
    try:
        robot.straight.setCollisions([(HAND, name) for name in names], False)
        if robot.scene.hasCollisions(joints):
            again = robot.model.scene(robot.name, robot.base_frame, robot.flange_frame)
            _add(again, robot, around)
            pair = touching(again, robot.model, joints, names)
            fix = "Send the joints as they are, T_base_cloud and obstacles in the right frame."
            raise InvalidRequest("options.robot.joints", f"a start where {pair} touch", fix)
        yield own
    finally:
        for planned in (robot.scene, robot.straight):
            for name in names:
                planned.removeGeometry(name)


def _add(planned: core.Scene, robot: Robot, around: Sequence[Obstacle]) -> None:
    """Put obstacles into a scene; they and the links that no joint moves may touch each other."""
    T_root_base = planned.forwardKinematics(robot.home, robot.base_frame)
    for name, shape, pose in around:
        add = planned.addBoxGeometry if isinstance(shape, core.Box) else planned.addOcTreeGeometry
        add(name, "universe", shape, np.asfortranarray(T_root_base @ pose), GREY)  # type: ignore[arg-type]
    names = [name for name, _, _ in around]
    still = combinations([*robot.model.standing, *names], 2)
    pairs = [(one, other) for one, other in still if other in names]
    planned.setCollisions(pairs, False)


def _own_objects(
    robot: Robot, joints: Float64, scene: Scene, T_base_cloud: Float64
) -> set[int | None]:
    """Numbers of objects that are the arm itself, as the camera sees it."""
    of_object = scene.object_of_point >= 0
    number = scene.object_of_point[of_object]
    objects = moved(T_base_cloud, scene.points_in_cloud[of_object])
    near = np.bincount(number[_near_robot(robot, joints, objects, SEEN_SELF)], minlength=1)
    within = np.bincount(number[_near_robot(robot, joints, objects, CELL / 2)], minlength=1)
    own: set[int | None] = set()
    for row in np.flatnonzero(near):
        if near[row] > 0.5 * np.sum(number == row):
            own.add(int(row))
        elif row < len(within) and within[row] > INSIDE:
            value = f"a pose that puts the arm into object {row}"
            fix = "Send where the cloud's frame is in the arm's base frame, and the joints now."
            raise InvalidRequest("options.robot.T_base_cloud", value, fix)
    return own


def _near_robot(robot: Robot, joints: Float64, points: Float64, distance: float) -> Bools:
    """Which points (N, 3) of the base frame lie within a distance of the robot.  # (N,)."""
    T_root_base = robot.scene.forwardKinematics(joints, robot.base_frame)
    options = core.RobotBodyFilterOptions(distance, num_threads=1)
    return core.RobotBodyFilter(robot.scene, options).computeMask(
        joints, np.ascontiguousarray(moved(T_root_base, points))
    )


def _box(row: int, box: Box | OrientedBox, T_base_cloud: Float64) -> Obstacle:
    T_cloud_box, half = box_pose(box)
    return f"collision.obstacles.{row}", core.Box(*(2 * half)), T_base_cloud @ T_cloud_box


def _support(scene: Scene, T_base_scene: Float64) -> Obstacle:
    """A slab below the support plane, its middle below the arm's base."""
    assert scene.support is not None
    normal = np.array(scene.support.normal)
    base = np.linalg.inv(T_base_scene)[:3, 3]
    T_scene_slab = np.eye(4)
    T_scene_slab[:3, :3] = Rotation.align_vectors(normal[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
    depth = scene.support.heights(base) + SLAB[2] / 2
    T_scene_slab[:3, 3] = base - depth * normal
    return "the support", core.Box(*SLAB), T_base_scene @ T_scene_slab


def _cloud(
    robot: Robot,
    joints: Float64,
    scene: Scene,
    points: object,
    T_base_scene: Float64,
) -> Obstacle | None:
    """Voxels of the cloud, without the support's and the arm's own; None: there are none."""
    flat = np.asarray(points).reshape(-1, 3)
    if scene.support is None:
        kept = np.isfinite(flat).all(axis=1)
    else:  # in single precision, as most of an image is of the support
        plane = np.append(scene.support.normal, -scene.support.offset)
        plane = (plane @ scene.frame.T_canonical_cloud).astype(flat.dtype)
        kept = flat @ plane[:3] > CELL / 2 - plane[3]  # NaN is not
    seen = scene.frame.points(flat[kept])
    base = np.linalg.inv(T_base_scene)[:3, 3]
    seen = seen[np.einsum("ij,ij->i", seen - base, seen - base) < AROUND**2]
    if len(seen) == 0:
        return None
    cell = np.floor(seen / CELL).astype(np.int64)
    corner = cell.min(axis=0)
    taken = np.zeros(cell.max(axis=0) - corner + 1, dtype=bool)
    taken[tuple((cell - corner).T)] = True
    centers = (np.argwhere(taken) + corner + 0.5) * CELL
    centers = centers[~_near_robot(robot, joints, moved(T_base_scene, centers), SEEN_SELF)]
    if len(centers) == 0:
        return None
    # Columns as coal's octrees have them: center, size, how probably it is occupied, and from
    # which probability on it counts; octomap knows no certainty.
    cells = np.column_stack([centers, np.tile([CELL, 0.97, 0.5], (len(centers), 1))])
    return "the cloud", core.OcTree(list(cells), CELL), T_base_scene


def moved(T_b_a: Float64, points: ArrayLike) -> Float64:
    """Points (N, 3) of frame a in frame b."""
    found: Float64 = np.asarray(points, np.float64) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    return found
