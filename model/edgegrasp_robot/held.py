"""What a closed hand holds, and whether it can be taken away."""

import numpy as np
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Bools, Float64
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.options import Collision
from edgegrasp_model.results import Grasp
from edgegrasp_model.scene.obstacles import box_pose
from edgegrasp_model.scene.scene import Scene
from edgegrasp_robot.surroundings import moved

STEP = 0.005  # metres along the way
BESIDE = 0.01  # metres: what is nearer than that to the held object touches it already
MEETS = 0.003  # metres between points that touch
SINKS = 0.001  # metres that the held object may go down toward the support


def can_leave(
    grasp: Grasp,
    scene: Scene,
    gripper: Gripper,
    way: Float64,
    collision: Collision,
) -> bool:
    """Whether what a grasp holds can go along a straight way without meeting anything seen.

    Args:
        grasp: The grasp.
        scene: What is held and what is around it.
        gripper: The hand.
        way: (3,) metres, cloud frame.
        collision: Obstacles beside the cloud.
    """
    points = scene.points_in_cloud.astype(np.float64)
    held = _held(grasp, scene, gripper)
    if not held.any():
        return True
    near = cKDTree(points[held]).query(points, distance_upper_bound=BESIDE)[0] <= BESIDE
    others = points[~near]
    tree = cKDTree(others) if len(others) else None
    lowest = _lowest(scene, points[held])
    steps = max(1, int(np.ceil(np.linalg.norm(way) / STEP)))
    for share in np.arange(1, steps + 1) / steps:
        there = points[held] + share * way
        if tree is not None and np.isfinite(tree.query(there, distance_upper_bound=MEETS)[0]).any():
            return False
        if _lowest(scene, there) < lowest - SINKS:
            return False
        for T_cloud_box, half in map(box_pose, collision.obstacles):
            T_box_cloud = np.linalg.inv(T_cloud_box.astype(np.float64))
            inside = np.abs(moved(T_box_cloud, there)) < half
            if inside.all(axis=1).any():
                return False
    return True


def _held(grasp: Grasp, scene: Scene, gripper: Gripper) -> Bools:
    """The points (V,) of the object that a grasp is on, and those between the fingers."""
    T_hand_cloud = np.linalg.inv(grasp.T_cloud_hand.astype(np.float64))
    x, y, z = np.abs(moved(T_hand_cloud, scene.points_in_cloud)).T
    between = (x < gripper.pad_half_width) & (y < gripper.max_opening / 2)
    between &= (z > gripper.palm_z) & (z < gripper.max_tip_z)
    if grasp.object is None:
        return np.asarray(between)
    held: Bools = between | (scene.object_of_point == grasp.object)
    return held


def _lowest(scene: Scene, points: Float64) -> float:
    """How high the lowest of points (N, 3), cloud frame, is over the support; 0 without one."""
    if scene.support is None:
        return 0.0
    return float(scene.support.heights(scene.frame.points(points)).min())
