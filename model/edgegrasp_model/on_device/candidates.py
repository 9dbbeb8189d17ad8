"""Edge grasps on a device; `edgegrasp_model.candidates` in tensors."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from edgegrasp_model.candidates import (
    EDGE_MARGIN,
    LOW,
    MAX_SIDEWAYS,
    MIN_DEPTH,
    MIN_DROP,
    MIN_EDGE,
    MIN_LEVEL,
    MIN_OUTWARD,
    OUTLINE_RADIUS,
    TIP_MARGIN,
    Candidates,
)
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.on_device.cloud import PAIRS, DeviceCloud, squared_distances
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.support import SupportPlane


@dataclass(frozen=True)
class DeviceCandidates:
    """Edge grasps of one cloud."""

    pair: Tensor  # (E,) which of the given pairs of points
    approach_index: Tensor  # (E,) p_a, rows of the cloud
    contact_index: Tensor  # (E,) p_c, rows of the cloud
    approach: Tensor  # (E, 3) unit, outward: from the object back to the hand
    depth: Tensor  # (E,) d, metres the contact lies ahead of the approach point
    T_cloud_hand: Tensor  # (E, 4, 4)

    def __len__(self) -> int:
        return len(self.pair)

    @staticmethod
    def concatenate(parts: Sequence["DeviceCandidates"]) -> "DeviceCandidates":
        """All candidates of several sets, in order."""
        names = [field.name for field in fields(parts[0])]
        return DeviceCandidates(*(torch.cat([getattr(p, name) for p in parts]) for name in names))

    def take(self, rows: Tensor) -> "DeviceCandidates":
        """The candidates of the given rows, in their order."""
        return DeviceCandidates(*(getattr(self, field.name)[rows] for field in fields(self)))

    @property
    def on_processor(self) -> Candidates:
        """The same in arrays."""
        return Candidates(*(getattr(self, field.name).cpu().numpy() for field in fields(self)))


def edge_grasps(
    cloud: DeviceCloud, approach_index: Tensor, contact_index: Tensor, gripper: Gripper
) -> DeviceCandidates:
    """The candidates among pairs (M,), (M,) of approach and contact points, rows of the cloud."""
    approach, contact = cloud.points[approach_index], cloud.points[contact_index]
    normal = cloud.normals[contact_index]
    normal = normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-9)
    edge = contact - approach  # (M, 3) r
    along = (edge * normal).sum(dim=1)
    ahead = edge - along.unsqueeze(1) * normal
    length, depth = edge.norm(dim=1), ahead.norm(dim=1)
    fits = (length > MIN_EDGE) & (length < gripper.max_opening / 2 - EDGE_MARGIN)
    fits &= (depth > MIN_DEPTH) & (depth < gripper.finger_depth)
    pair = fits.nonzero().squeeze(1)
    depth = depth[pair]
    z = ahead[pair] / depth.unsqueeze(1)
    y = normal[pair]
    y = y - (y * z).sum(dim=1, keepdim=True) * z
    y = y / y.norm(dim=1, keepdim=True)
    contact_z = contact_z_at(gripper, 2 * along[pair].abs())
    origin = approach[pair] + (depth - contact_z).unsqueeze(1) * z
    return _candidates(pair, approach_index, contact_index, depth, y, z, origin)


def level_grasps(
    cloud: DeviceCloud,
    approach_index: Tensor,
    contact_index: Tensor,
    support: SupportPlane,
    gripper: Gripper,
) -> DeviceCandidates:
    """Candidates straight down onto low contacts, the closing direction level."""
    up = constant(support.normal, cloud.points.device)
    contact = cloud.points[contact_index]
    edge = contact - cloud.points[approach_index]  # (M, 3)
    headings, certain = closing_headings(cloud, support)
    y = headings[contact_index]
    down = (-up).expand_as(y)
    along, rise = (edge * y).sum(dim=1), edge @ up
    sideways = (edge * torch.linalg.cross(y, down)).sum(dim=1)
    fits = certain[contact_index] & (along > MIN_EDGE)
    fits &= along < gripper.max_opening / 2 - EDGE_MARGIN
    fits &= (sideways.abs() < MAX_SIDEWAYS) & (-rise > MIN_DROP)
    pair = fits.nonzero().squeeze(1)
    y, along = y[pair], along[pair].unsqueeze(1)
    origin = contact[pair] - along * y + contact_z_at(gripper, 2 * along) * up
    depth = (-rise[pair]).clamp_min(0.0)
    return _candidates(pair, approach_index, contact_index, depth, y, down[pair], origin)


def _candidates(
    pair: Tensor,
    approach_index: Tensor,
    contact_index: Tensor,
    depth: Tensor,
    y: Tensor,
    z: Tensor,
    origin: Tensor,
) -> DeviceCandidates:
    """Hands with axes x = y x z, y and z (E, 3) at origins (E, 3); `pair` are rows of the pairs."""
    pose = torch.zeros((len(pair), 4, 4), device=origin.device)
    pose[:, :3, 0] = torch.linalg.cross(y, z)
    pose[:, :3, 1], pose[:, :3, 2], pose[:, :3, 3] = y, z, origin
    pose[:, 3, 3] = 1.0
    return DeviceCandidates(pair, approach_index[pair], contact_index[pair], -z, depth, pose)


def contact_z_at(gripper: Gripper, opening: Tensor) -> Tensor:
    """Where a contact lies along z once the fingers have closed to an opening (...), metres."""
    swing = gripper.swing
    if swing is None:
        return torch.full_like(opening, gripper.contact_z)
    open_by = opening.double().clamp(0.0, gripper.max_opening)
    outward = swing.reach - (gripper.max_opening - open_by) / 2
    advance = (swing.radius**2 - outward**2).sqrt() - (swing.radius**2 - swing.reach**2) ** 0.5
    contact_z: Tensor = (gripper.contact_z + advance).float()
    return contact_z


def closing_headings(cloud: DeviceCloud, support: SupportPlane) -> tuple[Tensor, Tensor]:
    """Which way, seen from above, the surface faces at each point low over the support.

    Returns:
        (N, 3) unit directions along the plane, and which of them (N,) can be trusted.
    """
    points = cloud.points
    up = constant(support.normal, points.device)
    low = points @ up - support.offset < LOW
    level = cloud.normals - (cloud.normals @ up).unsqueeze(1) * up
    certain = low & (level.norm(dim=1) > MIN_LEVEL)
    flat = (low & ~certain).nonzero().squeeze(1)
    for rows in torch.split(flat, max(1, PAIRS // len(points))):
        near = squared_distances(points[rows], points) <= OUTLINE_RADIUS * OUTLINE_RADIUS
        middle = (near.double() @ points.double()) / near.sum(dim=1, keepdim=True)
        outward = (points[rows] - middle).float()
        outward = outward - (outward @ up).unsqueeze(1) * up
        level[rows] = outward
        certain[rows] = outward.norm(dim=1) > MIN_OUTWARD
    return level / level.norm(dim=1, keepdim=True).clamp_min(1e-9), certain


def drawn_back(
    candidates: DeviceCandidates, support: SupportPlane, gripper: Gripper, margin: float = 0.0
) -> tuple[DeviceCandidates, Tensor]:
    """Draw hands that would cut into the support plane back along their approach, if that helps.

    Returns:
        The candidates, and which of their hands (E,) stay above the plane.
    """
    pose = candidates.T_cloud_hand
    clearance = support_clearance(pose, support, gripper) - margin
    normal = constant(support.normal, pose.device)
    rise = candidates.approach @ normal
    back = torch.where(clearance >= 0, 0.0, -clearance / rise)
    clear = (back >= 0) & (back <= gripper.tip_z - gripper.contact_z - TIP_MARGIN)
    pose = pose.clone()
    pose[:, :3, 3] += torch.where(clear, back, 0.0).unsqueeze(1) * candidates.approach
    return replace(candidates, T_cloud_hand=pose), clear


def support_clearance(T_cloud_hand: Tensor, support: SupportPlane, gripper: Gripper) -> Tensor:
    """Height (E,) of the lowest corner of each hand, fingers open, over the support plane."""
    normal = constant(support.normal, T_cloud_hand.device, torch.float64)
    return (clearance_over(T_cloud_hand, normal, gripper) - support.offset).float()


def clearance_over(T_cloud_hand: Tensor, normal: Tensor, gripper: Gripper) -> Tensor:
    """Least way (E,) float64 of the corners of hands along a unit normal (3,) float64."""
    boxes = gripper.boxes(gripper.max_opening, gripper.foremost_z - gripper.tip_z)
    picks = np.indices((2, 2, 2)).reshape(3, 8).T  # (8, 3)
    corners = np.where(picks[None] == 0, boxes[:, None, 0], boxes[:, None, 1]).reshape(-1, 3)
    pose = T_cloud_hand.double()
    height = normal @ pose[:, :3, 3:]  # (E, 1)
    offsets = constant(corners.tolist(), pose.device, torch.float64)  # (8B, 3)
    corner_heights = (normal @ pose[:, :3, :3]) @ offsets.T
    least: Tensor = height.squeeze(1) + corner_heights.amin(dim=1)
    return least
