"""Where the hand would hit something, how near it comes, how far it opens; on a device."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgegrasp_model.collision import (
    FINGER_CLEARANCE,
    TOUCH,
    UP,
    clearances,
    grown_boxes,
    lengthened,
    meets_obstacles,
    way_back,
)
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.on_device.candidates import support_clearance
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.on_device.hand_view import hands_together, positions, within
from edgegrasp_model.on_device.scene import DeviceScene
from edgegrasp_model.options import Collision
from edgegrasp_model.support import SupportPlane

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


def collides(
    scene: DeviceScene, T_cloud_hand: Tensor, gripper: Gripper, request: Collision
) -> Tensor:
    """Which open hands (E, 4, 4) meet the cloud, the support plane or an obstacle.  # (E,).

    Obstacles are boxes that few requests have: those are looked up on the processor.
    """
    hit = meets_cloud(scene, T_cloud_hand, gripper, request)
    if scene.support is not None:
        hit |= meets_support(T_cloud_hand, scene.support, gripper, request)
    if len(scene.obstacles):
        hands = T_cloud_hand.cpu().numpy()
        met = meets_obstacles(hands, scene.obstacles, gripper, request)
        hit |= torch.from_numpy(met).to(hit.device)
    return hit


def meets_cloud(
    scene: DeviceScene, T_cloud_hand: Tensor, gripper: Gripper, request: Collision
) -> Tensor:
    """Which open hands meet a point of the cloud.  # (E,)."""
    device = T_cloud_hand.device
    grown = grown_boxes(gripper, request)
    swept = _box_corners(lengthened(grown, request), device)
    boxes, up = _box_corners(grown, device), constant(UP.tolist(), device)
    upward = request.retreat_direction == "up" and request.retreat_length > 0
    met = [torch.zeros(0, dtype=torch.bool, device=device)]
    for hands in torch.split(T_cloud_hand, hands_together(scene.cloud)):
        position = positions(scene.cloud.points, hands)  # (3, e, N)
        hit = torch.zeros_like(position[0], dtype=torch.bool)
        for corners in swept:
            hit |= within(position, corners)
        if upward:
            lift = request.retreat_length * (up @ hands[:, :3, :3])  # (e, 3)
            for corners in boxes:
                hit |= _passed_over(position, lift.T.unsqueeze(2), corners)
        met.append(hit.any(dim=1))
    return torch.cat(met)


def meets_support(
    T_cloud_hand: Tensor, support: SupportPlane, gripper: Gripper, request: Collision
) -> Tensor:
    """Which hands come nearer to the support plane than the margin.  # (E,)."""
    normal = constant(support.normal, T_cloud_hand.device, torch.float64)
    height = support_clearance(T_cloud_hand, support, gripper)
    rise = -T_cloud_hand[:, :3, 2].double() @ normal  # per metre of way back
    lowest: Tensor = torch.minimum(height, height + way_back(request) * rise)
    if request.retreat_direction == "up":
        raised = height + request.retreat_length * float(UP @ np.asarray(support.normal))
        lowest = torch.minimum(lowest, raised)
    return lowest < request.margin - TOUCH


def nearest_things(scene: DeviceScene, T_cloud_hand: Tensor, gripper: Gripper) -> Float32:
    """As `edgegrasp_model.collision.clearances`: distance (E,) of open hands to what is nearest."""
    if len(scene.obstacles):
        return clearances(scene.on_processor, T_cloud_hand.cpu().numpy(), gripper)
    boxes = _box_corners(gripper.boxes(gripper.max_opening), T_cloud_hand.device)
    middle, extent = boxes.mean(dim=1), (boxes[:, 1] - boxes[:, 0]) / 2  # (B, 3)
    nearest = [torch.zeros(0, device=T_cloud_hand.device)]
    for hands in torch.split(T_cloud_hand, hands_together(scene.cloud)):
        position = positions(scene.cloud.points, hands)
        least = torch.full((len(hands),), torch.inf, device=hands.device)
        for center, half in zip(middle, extent, strict=True):
            beyond = (position - center[:, None, None]).abs() - half[:, None, None]  # (3, e, N)
            inside = beyond.amax(dim=0).clamp(max=0.0)
            outside = beyond.clamp(min=0.0).square().sum(dim=0).sqrt()
            least = torch.minimum(least, (inside + outside).amin(dim=1))
        nearest.append(least)
    clearance = torch.cat(nearest)
    if scene.support is not None:
        over = support_clearance(T_cloud_hand, scene.support, gripper)
        clearance = torch.minimum(clearance, over)
    result: Float32 = clearance.cpu().numpy()
    return result


def widths_needed(there: Tensor, position: Tensor, gripper: Gripper) -> Tensor:
    """Opening (E,) that lets the fingers pass what lies between them, metres.

    Args:
        there: (E, Q) which places hold a point.
        position: (3, E, Q) of what hands see.
        gripper: Fingers open to its maximum.
    """
    x, y, z = position
    aside = y.abs()
    between = there & (x.abs() < gripper.pad_half_width) & (aside < gripper.max_opening / 2)
    between &= (z > gripper.palm_z) & (z < gripper.foremost_z)
    reach = (aside * between).amax(dim=1)
    width: Tensor = (2 * (reach + FINGER_CLEARANCE)).clamp(max=gripper.max_opening)
    return width


def _box_corners(boxes: Float64, device: torch.device) -> Tensor:
    """Boxes (B, 2, 3) on a device."""
    return constant(boxes.reshape(-1, 3).tolist(), device).view(-1, 2, 3)


def _passed_over(position: Tensor, lift: Tensor, corners: Tensor) -> Tensor:
    """Which points (3, e, N) a box (2, 3) passes over while it moves by `lift` (3, e, 1)."""
    low, high = corners.view(2, 3, 1, 1)
    step = torch.where(lift.abs() < 1e-12, 1e-12, lift)
    one, other = (position - high) / step, (position - low) / step  # shares of the way
    enter = torch.minimum(one, other).amax(dim=0)
    leave = torch.maximum(one, other).amin(dim=0)
    return (enter < leave) & (enter < 1.0) & (leave > 0.0)
