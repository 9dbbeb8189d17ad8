"""Collision checks of the hand, its clearance, and the opening that its fingers need."""

from collections.abc import Callable

import numpy as np

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats
from edgegrasp_model.candidates.edge_grasps import support_clearance
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_kernels import (
    any_point_in_boxes,
    any_point_on_way,
    points_in_hand_boxes,
    signed_distance_to_boxes,
)
from edgegrasp_model.hand_view import HandView
from edgegrasp_model.options import Collision, SupportPlane
from edgegrasp_model.scene.cloud import UP, Cloud
from edgegrasp_model.scene.obstacles import SolidBoxes, separation, signed_distance
from edgegrasp_model.scene.scene import Scene
from edgegrasp_model.scene.segment import FIXED
from edgegrasp_model.unseen import enters_unseen

FINGER_CLEARANCE = 0.005  # metres left free between each finger and the object
MIN_FIXED = 8  # voxels of background between the fingers that keep them from closing
TOUCH = 1e-6  # metres between the support plane and a hand that was retracted from it


def collides(
    scene: Scene,
    T_cloud_hand: Float32,  # (E, 4, 4), canonical frame
    gripper: Gripper,  # fingers open to the maximum
    request: Collision,
) -> Bools:
    """Which open hands (E,) collide at the grasp, on the approach or the retreat.

    With the cloud, the support plane, an obstacle or space that no camera saw, or that close on
    background. The margin is added on every side of each box of the hand.
    """
    hit = hits(scene, T_cloud_hand, gripper, request)
    free = np.flatnonzero(~hit)
    hit[free] = closes_on_background(scene, T_cloud_hand[free], gripper)
    hit[free] |= enters_unseen(scene.depths, T_cloud_hand[free], gripper)
    return hit


def hits(scene: Scene, T_cloud_hand: Float32, gripper: Gripper, request: Collision) -> Bools:
    """Which open hands collide with the cloud, the support plane or an obstacle.  # (E,)."""
    hit = hits_cloud(scene.cloud, T_cloud_hand, gripper, request)
    if scene.support is not None:
        hit |= hits_support(T_cloud_hand, scene.support, gripper, request)
    if scene.obstacles is not None:
        hit |= hits_obstacles(T_cloud_hand, scene.obstacles, gripper, request)
    return hit


CollisionCheck = Callable[[Scene, Float32, Gripper, Collision], Bools]


def closes_on_background(scene: Scene, T_cloud_hand: Float32, gripper: Gripper) -> Bools:
    """Which hands have a wall, a rim or other background between their fingers.  # (E,)."""
    fixed = scene.cloud.points[scene.object_of_point == FIXED]
    half, opening = gripper.pad_half_width, gripper.max_opening
    low = np.array([-half, -opening / 2, gripper.palm_z], dtype=np.float32)
    high = np.array([half, opening / 2, gripper.tip_z], dtype=np.float32)
    hand, _, _ = points_in_hand_boxes(fixed, T_cloud_hand, low, high)
    return np.bincount(hand, minlength=len(T_cloud_hand)) >= MIN_FIXED


def hits_cloud(cloud: Cloud, T_cloud_hand: Float32, gripper: Gripper, request: Collision) -> Bools:
    """Which open hands contain a point of the cloud.  # (E,)."""
    boxes = inflated_boxes(gripper, request)
    swept = swept_boxes(boxes, request)
    hit = any_point_in_boxes(cloud.points, T_cloud_hand, swept)
    if request.retreat_direction == "up" and request.retreat_length > 0:
        free = np.flatnonzero(~hit)
        way = request.retreat_length * UP
        hit[free] = any_point_on_way(cloud.points, T_cloud_hand[free], boxes, way)
    return hit


def hits_support(
    T_cloud_hand: Float32, support: SupportPlane, gripper: Gripper, request: Collision
) -> Bools:
    """Which hands come closer to the support plane than the margin.  # (E,)."""
    normal = np.asarray(support.normal)
    height = support_clearance(T_cloud_hand, support, gripper)
    rise = -T_cloud_hand[:, :3, 2] @ normal  # per metre of way back
    lowest = np.minimum(height, height + approach_sweep_length(request) * rise)
    if request.retreat_direction == "up":
        lowest = np.minimum(lowest, height + request.retreat_length * (UP @ normal))
    return np.asarray(lowest < request.margin - TOUCH)


def hits_obstacles(
    T_cloud_hand: Float32, obstacles: SolidBoxes, gripper: Gripper, request: Collision
) -> Bools:
    """Which open hands overlap a box.  # (E,)."""
    grown = inflated_boxes(gripper, request)
    at_rest = SolidBoxes.of_hands(T_cloud_hand, swept_boxes(grown, request))
    hit = _hits_any(at_rest, obstacles, None)
    if request.retreat_direction == "up" and request.retreat_length > 0:
        hands = SolidBoxes.of_hands(T_cloud_hand, grown)
        hit |= _hits_any(hands, obstacles, request.retreat_length * UP.astype(np.float64))
    return np.asarray(hit.reshape(len(T_cloud_hand), len(grown)).any(axis=1))


def clearances(scene: Scene, T_cloud_hand: Float32, gripper: Gripper) -> Float32:
    """Metres (E,) from open hands (E, 4, 4) at the grasp to the nearest point, support or obstacle.

    Canonical frame. Negative: the greatest depth at which something lies inside a box of the hand.
    """
    boxes = gripper.open_boxes
    nearest = signed_distance_to_boxes(scene.cloud.points, T_cloud_hand, boxes)
    if scene.support is not None:
        nearest = np.minimum(nearest, support_clearance(T_cloud_hand, scene.support, gripper))
    if scene.obstacles is not None:
        nearest = _nearest_obstacle(scene.obstacles, T_cloud_hand, boxes, nearest)
    return nearest.astype(np.float32)


def approach_sweep_length(request: Collision) -> float:
    """Metres behind the grasp that the straight approach or retreat sweeps."""
    out = request.retreat_length if request.retreat_direction == "back" else 0.0
    return max(request.approach_length, out)


def inflated_boxes(gripper: Gripper, request: Collision) -> Float64:
    """Boxes (B, 2, 3) of the open hand with the margin around them."""
    margin = request.margin * np.array([[-1.0], [1.0]])
    return np.asarray(gripper.open_boxes + margin)


def swept_boxes(boxes: Float64, request: Collision) -> Float64:
    """Boxes (B, 2, 3) extended over the straight approach and retreat along the hand's z."""
    swept = boxes.copy()
    swept[:, 0, 2] -= approach_sweep_length(request)
    return swept


def _nearest_obstacle(
    obstacles: SolidBoxes, T_cloud_hand: Float32, boxes: Float64, nearest: Floats
) -> Floats:
    """The distances `nearest` (E,), or those of obstacles that are nearer."""
    hands = SolidBoxes.of_hands(T_cloud_hand, boxes)
    for place in range(len(obstacles)):
        box = obstacles.take(np.full(len(hands), place))
        # A cheap lower bound leaves few boxes to measure exactly.
        gap = np.linalg.norm(box.center - hands.center, axis=1) - hands.radius - box.radius
        near = np.flatnonzero(gap < np.repeat(nearest, len(boxes)))
        distance = np.full(len(hands), np.inf)
        distance[near] = signed_distance(hands.take(near), box.take(near))
        nearest = np.minimum(nearest, distance.reshape(len(nearest), len(boxes)).min(axis=1))
    return nearest


def _hits_any(boxes: SolidBoxes, obstacles: SolidBoxes, sweep: Float64 | None) -> Bools:
    """Which boxes (M,), moved along `sweep` (3,), meet an obstacle."""
    hit = np.zeros(len(boxes), dtype=bool)
    way = np.zeros(3) if sweep is None else sweep
    for center, half in zip(obstacles.center, obstacles.half, strict=True):
        apart = np.linalg.norm(center - boxes.center - way / 2, axis=1)
        bound = boxes.radius + np.linalg.norm(half) + np.linalg.norm(way) / 2
        near = np.flatnonzero(~hit & (apart < bound))
        theirs = SolidBoxes(np.tile(center, (len(near), 1)), np.tile(half, (len(near), 1, 1)))
        moved = None if sweep is None else np.tile(sweep, (len(near), 1))
        hit[near] = separation(boxes.take(near), theirs, moved) < 0
    return hit


def required_openings(met: Float32, gripper: Gripper) -> Float32:
    """Opening (E,), metres, that leaves FINGER_CLEARANCE on both sides of `met_first`, (E, 2)."""
    widest = 2 * (np.abs(met).max(axis=1) + np.float32(FINGER_CLEARANCE))
    width: Float32 = np.minimum(widest, np.float32(gripper.max_opening))
    return width


def met_first(view: HandView, gripper: Gripper) -> Float32:
    """Greatest and least y (E, 2) of what lies between the open fingers; 0 where nothing does."""
    half = gripper.pad_half_width
    x, y, z = view.columns
    inner = gripper.max_opening / 2
    ahead = (z > gripper.palm_z) & (z < gripper.max_tip_z)
    between = (np.abs(x) < half) & (np.abs(y) < inner) & ahead
    hand, place = view.candidate[between], y[between]
    met = np.full((view.num_candidates, 2), (-np.inf, np.inf), dtype=np.float32)
    np.maximum.at(met[:, 0], hand, place)
    np.minimum.at(met[:, 1], hand, place)
    return np.where(np.isfinite(met), met, np.float32(0.0))
