"""Collisions and clearance of hands, and the points near them."""

from typing import NamedTuple

import numpy as np

from edgegrasp_camera.arrays import Bools, Float32, Int64
from edgegrasp_model.candidates.edge_grasps import CLOSING_ALLOWANCE, support_clearance
from edgegrasp_model.gripper import APPROACH_LENGTH, Gripper
from edgegrasp_model.kernels import (
    SLACK,
    any_point_in_boxes,
    any_point_swept,
    in_hands,
    points_in_hand_boxes,
    signed_distance_to_boxes,
)
from edgegrasp_model.options import Collision
from edgegrasp_model.scene.cloud import UP, Cloud
from edgegrasp_model.scene.obstacles import SolidBoxes, near_pairs, separation, signed_distance
from edgegrasp_model.scene.scene import Scene
from edgegrasp_model.scene.segment import BACKGROUND
from edgegrasp_model.unseen import enters_unseen

FINGER_SURROUNDINGS = 0.006  # metres around a finger that count as near it
MIN_BOX_WIDTH = 0.005  # metres across the motion; narrower boxes may pass between voxels
MIN_BACKGROUND_VOXELS = 8  # voxels of background between the fingers that count as a collision


def collides(
    scene: Scene,
    T_cloud_hand: Float32,  # (E, 4, 4), canonical frame
    opening: Float32,  # (E,) metres between the fingers when they touch the object
    gripper: Gripper,  # fingers open to the maximum
    request: Collision,
) -> Bools:
    """Which open hands (E,) collide at the grasp, on the approach or the retreat.

    A hand collides if it hits the cloud, the support plane, an obstacle or unseen space, or closes
    on background. The margin is added on every side of the hand's boxes. A negative margin means
    that the hands were fully checked earlier: unseen space and background are not checked again.
    """
    boxes = gripper.open_boxes + request.margin * np.array([[-1.0], [1.0]])  # (B, 2, 3)
    thin = np.maximum(MIN_BOX_WIDTH - (boxes[:, 1] - boxes[:, 0]), 0.0) / 2 * (1.0, 1.0, 0.0)
    boxes += np.stack([-thin, thin], axis=1)
    lift = request.retreat_length if request.retreat_direction == "up" else 0.0  # metres
    swept = boxes.copy()
    swept[:, 0, 2] -= request.behind
    hit = any_point_in_boxes(in_hands(scene.cloud.points, T_cloud_hand), swept)
    if lift > 0:
        free = np.flatnonzero(~hit)
        hands = in_hands(scene.cloud.points, T_cloud_hand[free])
        hit[free] = any_point_swept(hands, boxes, hands.R_hand_cloud @ (lift * UP))
    if scene.support is not None:
        normal = np.asarray(scene.support.normal)
        height = support_clearance(T_cloud_hand, opening, scene.support, gripper)
        rise = -T_cloud_hand[:, :3, 2] @ normal  # per metre backward
        lowest = np.minimum(height, height + request.behind * rise)
        lowest = np.minimum(lowest, height + lift * (UP @ normal))
        hit |= np.asarray(lowest < request.margin - SLACK)
    side, inner = gripper.pad_half_width, gripper.max_opening / 2
    low, high = (-side, -inner, gripper.palm_z), (side, inner, gripper.tip_z)
    ahead = gripper.furthest_advance(opening - CLOSING_ALLOWANCE)  # of fingers that swing
    closing = T_cloud_hand.copy()
    closing[:, :3, 3] += ahead[:, None] * T_cloud_hand[:, :3, 2]
    if scene.obstacles is not None:
        between = np.array([[low, high]])  # the fingers
        whole = np.concatenate([swept, between])
        ways = [(T_cloud_hand, whole, 0.0), (closing, between, 0.0), (T_cloud_hand, boxes, lift)]
        for hands_at, shapes, way in ways[: 2 + (lift > 0.0)]:
            solid = SolidBoxes.from_hands(hands_at, shapes)
            for near, theirs in near_pairs(solid, scene.obstacles, way):
                overlap = separation(solid.take(near), theirs, way * UP.astype(np.float64)) < 0
                hit[near[overlap] // len(shapes)] = True
    if request.margin >= 0.0:
        free = np.flatnonzero(~hit)
        background = scene.cloud.points[scene.object_of_point == BACKGROUND]
        hands = in_hands(background, closing[free])
        held, *_ = points_in_hand_boxes(hands, *np.array([low, high], np.float32))
        hit[free] = np.bincount(held, minlength=len(free)) >= MIN_BACKGROUND_VOXELS
        hit[free] |= enters_unseen(scene.depths, T_cloud_hand[free], gripper, request.behind)
    return hit


def clearances(scene: Scene, T_cloud_hand: Float32, opening: Float32, gripper: Gripper) -> Float32:
    """Metres (E,) from open hands (E, 4, 4) at the grasp to the nearest point, support or obstacle.

    Canonical frame. Negative: the greatest depth at which something lies inside a box of the hand.
    """
    boxes = gripper.open_boxes
    nearest = signed_distance_to_boxes(in_hands(scene.cloud.points, T_cloud_hand), boxes)
    if scene.support is not None:
        above = support_clearance(T_cloud_hand, opening, scene.support, gripper)
        nearest = np.minimum(nearest, above)
    if scene.obstacles is not None:
        nearest, solid = nearest.astype(np.float64), SolidBoxes.from_hands(T_cloud_hand, boxes)
        for near, theirs in near_pairs(solid, scene.obstacles, np.repeat(nearest, len(boxes))):
            np.minimum.at(nearest, near // len(boxes), signed_distance(solid.take(near), theirs))
    nearest[np.abs(nearest) < SLACK] = 0.0  # touching is not penetration
    return nearest.astype(np.float32)


class HandView(NamedTuple):
    """Cloud points in hand frames, without those that are out of reach."""

    candidate: Int64  # (P,) ascending
    row: Int64  # (P,) row of the cloud
    position: Float32  # (3, P) x, y and z in the hand frame
    bounds: Int64  # (E + 1,) where each hand's points begin, and where the last hand's end


def hand_views(cloud: Cloud, T_cloud_hand: Float32, gripper: Gripper) -> HandView:
    """The cloud's points in or near the space that open hands (E, 4, 4) sweep on the approach."""
    boxes = gripper.open_boxes
    near = FINGER_SURROUNDINGS
    low = boxes[:, 0].min(axis=0) - np.array([near, near, APPROACH_LENGTH])
    high = boxes[:, 1].max(axis=0) + np.array([near, near, 2 * near])
    high[2] += gripper.max_tip_z - gripper.tip_z
    hands = in_hands(cloud.points, T_cloud_hand)
    hand, row, position = points_in_hand_boxes(hands, *np.array([low, high], np.float32))
    bounds = np.searchsorted(hand, np.arange(len(T_cloud_hand) + 1))
    return HandView(hand, row, position, bounds)
