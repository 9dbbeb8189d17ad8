"""What a closed hand holds, whether it can be taken away, and where it is put down."""

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64, Floats
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.options import Collision, Place
from edgegrasp_model.scene.cloud import pose_matrix
from edgegrasp_model.scene.obstacles import SolidBoxes, box_pose, near_pairs, separation
from edgegrasp_model.scene.scene import Scene
from edgegrasp_model.scene.support import heights_over
from edgegrasp_results import DetectedObject, Grasp
from edgegrasp_robot.obstacles import FOOT_HEIGHT, VOXEL_SIZE, Load, transform

WAY_STEP = 0.005  # metres between the positions that are checked
TOUCHING = 0.01  # metres; points nearer to the held object already touch it
CONTACT_DISTANCE = 0.003  # metres between points that touch
STRAY_SHARE = 0.1  # share of held points that may touch others: masks and readings have errors
MAX_SINKING = 0.001  # metres that the held object may go down toward the support
MAX_HIDDEN_FOOT = 0.03  # metres of the foot of an object that may be hidden from the camera
RELEASE_HEIGHT = 0.005  # metres over a region's bottom at which the hand lets go
TURNS_IN_REGION = 8  # of an object about the vertical, in a region
PLACE_SHARES = (0.0, -0.5, 0.5, -1.0, 1.0)  # of the free space in a region, to each side


class HeldPoints(NamedTuple):
    """What a grasp holds, cloud frame."""

    points: Float64  # (H, 3) points of its object and points between the fingers
    others: Float64  # (V, 3) points that it does not already touch


def held_points(grasp: Grasp, scene: Scene, gripper: Gripper) -> HeldPoints:
    """The points of the object that a grasp is on, and those between the fingers."""
    points = scene.points_in_cloud.astype(np.float64)
    T_hand_cloud = np.linalg.inv(grasp.T_cloud_hand.astype(np.float64))
    held = gripper.between_fingers(transform(T_hand_cloud, points).T)
    if grasp.object is not None:
        held |= scene.object_of_point == grasp.object
    if not held.any():
        return HeldPoints(points[held], points)
    own = points[held]
    low, high = own.min(axis=0) - TOUCHING, own.max(axis=0) + TOUCHING
    near = ((points > low) & (points < high)).all(axis=1)
    near[near] = cKDTree(own).query(points[near], distance_upper_bound=TOUCHING)[0] <= TOUCHING
    return HeldPoints(own, points[~near])


def can_leave(
    held: HeldPoints,
    scene: Scene,
    way: Floats,  # (3,) metres, cloud frame
    collision: Collision,  # obstacles in addition to the cloud
) -> bool:
    """Whether what is held can move straight along `way` without touching anything visible."""
    if not len(held.points):
        return True
    ends = np.concatenate([held.points, held.points + way])
    low, high = ends.min(axis=0) - CONTACT_DISTANCE, ends.max(axis=0) + CONTACT_DISTANCE
    others = held.others[((held.others > low) & (held.others < high)).all(axis=1)]
    tree = cKDTree(others)
    if _lowest(scene, held.points + way) < _lowest(scene, held.points) - MAX_SINKING:
        return False
    steps = max(1, int(np.ceil(np.linalg.norm(way) / WAY_STEP)))
    for share in np.arange(1, steps + 1) / steps:
        there = held.points + share * way
        away = tree.query(there, distance_upper_bound=CONTACT_DISTANCE)[0]
        if np.isfinite(away).mean() > STRAY_SHARE:
            return False
        for T_cloud_box, half in map(box_pose, collision.obstacles):
            T_box_cloud = np.linalg.inv(T_cloud_box.astype(np.float64))
            if (np.abs(transform(T_box_cloud, there)) < half).all(axis=1).any():
                return False
    return True


def _lowest(scene: Scene, points: Float64) -> float:
    """Height of the lowest of points (N, 3), cloud frame, over the support; 0 without a support."""
    if scene.support is None:
        return 0.0
    return float(heights_over(scene.support, scene.frame.points_from_cloud(points)).min())


def build_load(
    held: HeldPoints, seen: DetectedObject | None, scene: Scene, T_base_cloud: Float64
) -> Load | None:
    """The upright box of what is held: that of its object, else of its points; None: no points."""
    if not len(held.points):
        return None
    if seen is not None:
        T_cloud_box = pose_matrix(Rotation.from_quat(seen.quaternion).as_matrix(), seen.center)
        half = seen.half_extents.astype(np.float64)
    else:
        upright = scene.frame.points_from_cloud(held.points)
        low, high = upright.min(axis=0), upright.max(axis=0)
        T_scene_box, half = pose_matrix(np.eye(3), (low + high) / 2), (high - low) / 2
        T_cloud_box = np.linalg.inv(scene.frame.T_canonical_cloud) @ T_scene_box
    foot = _lowest(scene, (T_cloud_box[:3, 3] - half[2] * T_cloud_box[:3, 2])[None])
    below = foot if scene.support is not None and 0.0 < foot < MAX_HIDDEN_FOOT else 0.0
    return Load(transform(T_base_cloud, held.points), T_base_cloud @ T_cloud_box, half, below)


def places_for(
    place: Place,
    load: Load,
    voxels: Float64,  # (V, 3) base frame, what is visible around the load
    obstacles: SolidBoxes,  # base frame, in addition to the voxels
    scene: Scene,
    T_base_cloud: Float64,
) -> Iterator[Float64]:
    """Poses T_base_box (4, 4) in which a load touches nothing, a region's middle first.

    It must not touch voxels or obstacles, and its foot must not be pressed into the support.
    """
    T_cloud_base = np.linalg.inv(T_base_cloud)
    in_box = transform(np.linalg.inv(load.T_base_box), load.points)
    for pose in _places(place, load):
        foot = _lowest(scene, transform(T_cloud_base @ pose, in_box)) - load.below
        if foot < (-RELEASE_HEIGHT if place.region is None else 0.0):
            if place.region is None or foot < RELEASE_HEIGHT - FOOT_HEIGHT:
                continue
            pose[2, 3] -= foot  # the region's bottom is slightly too low
        off, half = load.above_its_foot
        around = np.abs(transform(np.linalg.inv(pose), voxels) - (0.0, 0.0, off))
        if (around < half + VOXEL_SIZE / 2).all(axis=1).any():
            continue
        size = np.maximum(load.half - RELEASE_HEIGHT, 1e-6)
        box = SolidBoxes.from_hands(pose[None].astype(np.float32), np.array([[-size, size]]))
        pairs = near_pairs(box, obstacles, 0.0)
        if not any(
            (separation(box.take(near), each, np.zeros(3)) < 0).any() for near, each in pairs
        ):
            yield pose


def _places(place: Place, load: Load) -> Iterator[Float64]:
    if place.region is None:
        yield np.reshape(np.array(place.T_base_object), (4, 4))
        return
    low, high = np.array(place.region.min), np.array(place.region.max)
    shares = sorted(product(PLACE_SHARES, PLACE_SHARES), key=lambda pair: np.hypot(*pair))
    ways = product(range(TURNS_IN_REGION), range(len(shares)))
    for turn, spot in sorted(ways, key=sum):  # other turns and other spots alternate
        about = Rotation.from_euler("z", 2 * np.pi * turn / TURNS_IN_REGION).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = about @ load.T_base_box[:3, :3]
        reach = np.abs(pose[:3, :3]) @ load.half  # of the turned box, along the base's axes
        reach[2] += load.below / 2 + RELEASE_HEIGHT / 2
        room = (high - low) / 2 - reach
        if (room > 0.0).all():
            pose[:2, 3] = ((low + high) / 2)[:2] + shares[spot] * room[:2]
            pose[2, 3] = low[2] + 2 * reach[2] - np.abs(pose[2, :3]) @ load.half
            yield pose
