"""Obstacles of an arm (cloud, support, boxes of the request), and the check of its start."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from roboplan import core
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Bools, Float64, Floats
from edgegrasp_model.errors import InvalidRequest, StartCollision
from edgegrasp_model.options import Box, OrientedBox, RobotArm, SupportPlane
from edgegrasp_model.scene.cloud import CanonicalFrame, pose_matrix, unit
from edgegrasp_model.scene.obstacles import box_pose
from edgegrasp_model.scene.scene import Scene
from edgegrasp_model.scene.support import heights_over, plane_in
from edgegrasp_robot.robot import HAND, Robot, touching

VOXEL_SIZE = 0.01  # metres, side of a voxel
SHELL = 0.1  # metres of distance from a camera, in which the voxel nearest in angle hides
MARGIN = 0.4  # voxels around a point: noise and the arm's controller are off by millimetres
MAX_RANGE = 2.0  # metres from the arm's base; farther points are left out
SELF_DISTANCE = 0.02  # metres; points this near to the arm are the arm itself
MAX_VOXELS_INSIDE = 10  # voxels of objects that may lie inside the arm, given camera errors
SUPPORT_SIZE = (6.0, 6.0, 0.5)  # metres, of the support
LOW_BASE = -0.05  # metres over the support; a lower base does not stand on it
FOOT_HEIGHT = 0.015  # metres at the foot of a load that may touch what it stands on
NEAR_HELD = 0.02  # metres from a load within which voxels belong to it
GREY = np.ones(4)
HELD_NAME = "what is held"

Obstacle = tuple[str, core.Box | core.OcTree, Float64]  # its name, shape and pose in the base frame


class Load(NamedTuple):
    """What a hand carries, as an upright box where it is grasped; base frame."""

    points: Float64  # (H, 3)
    T_base_box: Float64  # (4, 4) its z is up
    half: Float64  # (3,)
    below: float  # metres by which it may extend below the box, where no camera sees

    @property
    def above_its_foot(self) -> tuple[float, Float64]:
        """The box without its foot: how much higher its middle is, and half its lengths."""
        cut = min(FOOT_HEIGHT, self.half[2])
        return cut / 2, self.half - (0.0, 0.0, cut / 2)


class ArmObstacles(NamedTuple):
    """What an arm must not touch."""

    own: set[int]  # numbers of objects that are the arm itself, as the camera sees it
    boxes: list[Obstacle]  # the support and the request's obstacles
    voxels: Float64  # (V, 3) centers of voxels of the cloud and of unseen space, base frame

    def all(self) -> list[Obstacle]:
        """Every obstacle."""
        if not len(self.voxels):
            return self.boxes
        # Columns of coal's octrees: centre, size, probability of being occupied, and the threshold;
        # octomap does not allow a probability of 1.
        cells = np.tile([0.0, 0.0, 0.0, VOXEL_SIZE, 0.97, 0.5], (len(self.voxels), 1))
        cells[:, :3] = self.voxels
        return [*self.boxes, ("the cloud", core.OcTree(list(cells), VOXEL_SIZE), np.eye(4))]

    def without(self, load: Load) -> "ArmObstacles":
        """The obstacles without a load that is taken away."""
        around = np.abs(transform(np.linalg.inv(load.T_base_box), self.voxels))
        inside = around < load.half + VOXEL_SIZE  # and unseen space right behind it
        near = cKDTree(load.points).query(self.voxels, distance_upper_bound=NEAR_HELD)[0]
        own = inside.all(axis=1) | (near <= NEAR_HELD)
        return self._replace(voxels=self.voxels[~own])


@contextmanager
def scene_with_load(
    robot: Robot, obstacles: ArmObstacles, load: Load, T_base_hand: Floats
) -> Iterator[core.Scene]:
    """A scene in which the hand holds a load as at the grasp, without its foot, which may touch."""
    scene, (off, half) = robot.carrying_scene, load.above_its_foot
    # The planner expects the pose in the frame of the joint that carries the flange.
    T_base_joint = scene.forwardKinematics(robot.home, robot.joint_names[-1], robot.base_frame)
    T_joint_hand = np.linalg.inv(T_base_joint) @ robot.forward_kinematics(robot.home)
    T_joint_box = T_joint_hand @ np.linalg.inv(T_base_hand) @ load.T_base_box
    T_joint_box[:3, 3] += off * T_joint_box[:3, 2]
    pose, box = np.asfortranarray(T_joint_box), core.Box(*(2 * half))
    with _standing_in([scene], robot, obstacles.all()):
        scene.addBoxGeometry(HELD_NAME, robot.flange_frame, box, pose, GREY)
        scene.setCollisions(HELD_NAME, HAND, False)
        try:
            yield scene
        finally:
            with suppress(RuntimeError):  # the load may have been put down
                scene.removeGeometry(HELD_NAME)


@contextmanager
def arm_obstacles(
    robot: Robot,
    scene: Scene,  # what the camera's cloud shows
    robot_option: RobotArm,  # where the robot is
    boxes: Sequence[Box | OrientedBox],  # obstacles in addition to the cloud, cloud frame
) -> Iterator[ArmObstacles]:
    """Add the obstacles to the robot's scenes, and remove them afterwards; yields them.

    The hand may touch them in `robot.straight`, since the detection has checked it there.
    InvalidRequest: the start is in collision, or the base stands inside an object.
    """
    joints = np.array(robot_option.joints)
    T_base_cloud = np.reshape(robot_option.T_base_cloud, (4, 4))
    own = _own_objects(robot, joints, scene, T_base_cloud)
    known: list[Obstacle] = []
    for row, (T_cloud_box, half) in enumerate(map(box_pose, boxes)):
        place = T_base_cloud @ T_cloud_box
        known.append((f"collision.obstacles.{row}", core.Box(*(2 * half)), place))
    in_base = CanonicalFrame(T_base_cloud @ np.linalg.inv(scene.frame.T_canonical_cloud))
    support = None
    if scene.support is not None:
        support = plane_in(in_base, scene.support)
        known.append(("the support", *_slab(support, scene.readings, T_base_cloud)))
    voxels = _voxels(support, scene.readings, T_base_cloud)
    voxels = voxels[~_near_robot(robot, joints, voxels, SELF_DISTANCE)]
    if robot_option.avoid_unseen:
        hidden = _hidden(support, voxels, in_base.points_from_cloud(scene.viewpoints))
        hidden = hidden[~_near_robot(robot, joints, hidden, SELF_DISTANCE)]
        voxels = np.concatenate([voxels, hidden])
    found = ArmObstacles(own, known, voxels)
    obstacles = found.all()
    names = [name for name, _, _ in obstacles]
    with _standing_in([robot.scene, robot.straight_scene], robot, obstacles):
        robot.straight_scene.setCollisions([(HAND, name) for name in names], False)
        if robot.scene.hasCollisions(joints):
            again = robot.model.scene(robot)
            with _standing_in([again], robot, obstacles):
                pair = touching(again, robot.model, joints, names)
            fix = "Send the actual joints and T_base_cloud, and obstacles in the cloud's frame."
            raise StartCollision("options.robot.joints", f"a start where {pair} touch", fix)
        yield found


@contextmanager
def _standing_in(
    scenes: Sequence[core.Scene], robot: Robot, obstacles: Sequence[Obstacle]
) -> Iterator[None]:
    """Add obstacles to scenes temporarily; they may touch each other and links that never move."""
    T_root_base = robot.scene.forwardKinematics(robot.home, robot.base_frame)
    names = [name for name, _, _ in obstacles]
    still = combinations([*robot.model.standing, *names], 2)
    pairs = [(one, other) for one, other in still if other in names]
    for planned in scenes:
        for name, shape, pose in obstacles:
            box = isinstance(shape, core.Box)
            add = planned.addBoxGeometry if box else planned.addOcTreeGeometry
            add(name, "universe", shape, np.asfortranarray(T_root_base @ pose), GREY)  # type: ignore[arg-type]
        planned.setCollisions(pairs, False)
    try:
        yield
    finally:
        for planned in scenes:
            for name in names:
                planned.removeGeometry(name)


def _slab(support: SupportPlane, points: Floats, T_base_cloud: Float64) -> tuple[core.Box, Float64]:
    """The support, a plane in the base frame, as a slab and its pose T_base_slab (4, 4).

    The slab lies below the plane. If the plane is above the base, it covers only the points (N, 3).
    """
    upright = Rotation.align_vectors([support.normal], [[0.0, 0.0, 1.0]])[0].as_matrix()
    size, middle = np.array(SUPPORT_SIZE), np.zeros(3)
    if -support.offset < LOW_BASE:
        seen = transform(T_base_cloud, points)
        seen = seen[np.abs(heights_over(support, seen)) < VOXEL_SIZE]
        if len(seen):
            low, high = np.percentile(seen @ upright[:, :2], (0.5, 99.5), axis=0)
            size, middle[:2] = np.array([*(high - low), 2 * VOXEL_SIZE]), (low + high) / 2
    middle[2] = support.offset - size[2] / 2
    return core.Box(*size), pose_matrix(upright, upright @ middle)


def _own_objects(robot: Robot, joints: Float64, scene: Scene, T_base_cloud: Float64) -> set[int]:
    """Numbers of detected objects that are the arm itself."""
    of_object = scene.object_of_point >= 0
    number = scene.object_of_point[of_object]
    objects = transform(T_base_cloud, scene.points_in_cloud[of_object])
    near = _near_robot(robot, joints, objects, SELF_DISTANCE)
    within = _near_robot(robot, joints, objects, VOXEL_SIZE / 2)
    own: set[int] = set()
    for row in np.unique(number[near]).tolist():
        if near[number == row].mean() > 0.5:
            own.add(row)
        elif within[number == row].sum() > MAX_VOXELS_INSIDE:
            value = f"a pose that puts the arm into object {row}"
            fix = "Send where the cloud's frame is in the arm's base frame, and the joints now."
            raise InvalidRequest("options.robot.T_base_cloud", value, fix)
    return own


def _near_robot(robot: Robot, joints: Float64, points: Float64, distance: float) -> Bools:
    """Which points (N, 3) of the base frame lie within a distance of the robot, (N,)."""
    T_root_base = robot.scene.forwardKinematics(joints, robot.base_frame)
    options = core.RobotBodyFilterOptions(distance, num_threads=1)
    placed = np.ascontiguousarray(transform(T_root_base, points))
    return core.RobotBodyFilter(robot.scene, options).computeMask(joints, placed)


def _voxels(support: SupportPlane | None, points: Floats, T_base_cloud: Float64) -> Float64:
    """Centers (V, 3) of the voxels of points (N, 3), base frame, without the support's.

    Their grid is fixed to the base, so it does not depend on which part of a cloud was selected.
    """
    if support is not None:  # in single precision, since most of an image is support
        plane = np.append(support.normal, -support.offset)
        plane = (plane @ T_base_cloud).astype(points.dtype)
        height = points @ plane[:3] + plane[3]
        if -support.offset < LOW_BASE:  # what lies below is in the arm's way too
            height = np.abs(height)
        points = points[height > VOXEL_SIZE / 2]
    cells = points @ (T_base_cloud[:3, :3].T / VOXEL_SIZE).astype(points.dtype)
    cells += (T_base_cloud[:3, 3] / VOXEL_SIZE).astype(points.dtype)
    cells = cells[np.einsum("ij,ij->i", cells, cells) < (MAX_RANGE / VOXEL_SIZE) ** 2]
    return _centers(cells, shifts=(-MARGIN, MARGIN))


def _hidden(support: SupportPlane | None, voxels: Float64, viewpoints: Float64) -> Float64:
    """Centers (U, 3) of voxels that `voxels` hide from every camera (W, 3), above the support."""
    first, *others = viewpoints
    places, step, cells = voxels, VOXEL_SIZE * unit(voxels - first), [np.empty((0, 3), np.int16)]
    while len(places):  # until the last ray leaves the range
        places = places + step
        near = np.einsum("ij,ij->i", places, places) < MAX_RANGE**2
        places, step = places[near], step[near]
        above = support is None or heights_over(support, places) > VOXEL_SIZE / 2
        cells.append(np.floor(places[above] / VOXEL_SIZE).astype(np.int16).reshape(-1, 3))
    hidden = _centers(np.concatenate(cells))
    for eye in others:
        hidden = hidden[_behind(voxels - eye, hidden - eye)]
    return hidden


def _behind(seen: Float64, places: Float64) -> Bools:
    """Which places (N, 3) are behind a voxel (V, 3); both relative to a camera."""
    away, hidden = np.linalg.norm(seen, axis=1), np.zeros(len(places), dtype=bool)
    # By shells, since a voxel farther away may be nearer in angle.
    for shell in np.unique(away // SHELL):
        own, left = seen[away // SHELL == shell], np.flatnonzero(~hidden)
        widest = VOXEL_SIZE / max(shell * SHELL, VOXEL_SIZE)  # radians
        tree, ways = cKDTree(unit(own)), unit(places[left])
        aside, row = tree.query(ways, distance_upper_bound=widest)
        there = np.append(np.linalg.norm(own, axis=1), np.inf)[row]
        behind = np.linalg.norm(places[left], axis=1) - there > VOXEL_SIZE / 2
        hidden[left] = behind & (aside * there < VOXEL_SIZE)
    return hidden


def _centers(places: Floats, shifts: Sequence[float] = (0.0,)) -> Float64:
    """Centers (V, 3) of the voxels that contain places (N, 3), in cells.

    Each place counts at every combination of the ascending shifts along the axes.
    """
    if len(places) == 0:
        return np.empty((0, 3))
    columns = np.ascontiguousarray(places.T)
    cells = [np.floor(columns + shift).astype(np.int32) for shift in shifts]
    corner = cells[0].min(axis=1)[:, None]
    size = cells[-1].max(axis=1) - corner[:, 0] + 1
    taken, strides = np.zeros(size, dtype=bool), np.array([[size[1] * size[2]], [size[2]], [1]])
    steps = [(each - corner) * strides for each in cells]
    for x, y, z in product(steps, repeat=3):
        taken.reshape(-1)[x[0] + y[1] + z[2]] = True
    return np.asarray((np.argwhere(taken) + corner.T + 0.5) * VOXEL_SIZE)


def transform(T_b_a: Floats, points: ArrayLike) -> Float64:
    """Points (N, 3) of frame a in frame b."""
    return np.asarray(np.asarray(points, np.float64) @ T_b_a[:3, :3].T + T_b_a[:3, 3])
