"""The hand-frame description on a device; `edgegrasp_model.hand_description` in tensors.

Where that one goes over the seen points region by region, here every region is a mask over all
places of all hands, counts are one sum, and means one product of masks and values.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgegrasp_model.collision import UP
from edgegrasp_model.gripper import Boxes, Gripper
from edgegrasp_model.hand_description import AXIS, FACING, HEIGHTS, SLAB, UNKNOWN_HEIGHT
from edgegrasp_model.hand_view import APPROACH_LENGTH, NEAR
from edgegrasp_model.on_device.candidates import DeviceCandidates, support_clearance
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.on_device.hand_view import DeviceView, within
from edgegrasp_model.on_device.hidden_space import hidden_shares
from edgegrasp_model.on_device.scene import DeviceScene


def describe_hands(
    scene: DeviceScene,
    candidates: DeviceCandidates,
    gripper: Gripper,
    view: DeviceView,
    normal: Tensor,
    side: Tensor,
) -> Tensor:
    """The hand-frame description of each candidate: (E, HAND_DESCRIPTION_SIZE).

    Args:
        scene: The scene.
        candidates: E candidates.
        gripper: Fingers open to its maximum.
        view: What their hands see.
        normal: (3, E, Q) normals of the seen points in hand frames, mirrored.
        side: (E,) from `mirror_sides`.
    """
    position = mirrored(view.position, side)
    columns = [
        *_hits(view.there, position, gripper),
        *_between_fingers(view.there, position, normal, gripper),
        _cut_off(scene, view, position, gripper),
        *_directions(scene, candidates.T_cloud_hand, side),
        *hidden_shares(scene, candidates.T_cloud_hand, gripper),
        *_stance(scene, candidates, gripper),
    ]
    return torch.stack(columns, dim=1).float()


def mirror_sides(scene: DeviceScene, T_cloud_hand: Tensor) -> Tensor:
    """1 or -1 (E,): what a hand's x is multiplied by, so that the camera is on its positive side.

    1 for all where the viewpoint is not known.
    """
    if scene.viewpoint is None:
        return torch.ones(len(T_cloud_hand), device=T_cloud_hand.device)
    toward = _toward_camera(scene.viewpoint, T_cloud_hand)
    along_x = (toward * T_cloud_hand[:, :3, 0]).sum(dim=1)
    return torch.where(along_x < 0.0, -1.0, 1.0)


def mirrored(vectors: Tensor, side: Tensor) -> Tensor:
    """Vectors (3, E, Q) with their x multiplied by `side` (E,)."""
    x, y, z = vectors
    return torch.stack((x * side.unsqueeze(1), y, z))


def _toward_camera(viewpoint: NDArray[np.float32], T_cloud_hand: Tensor) -> Tensor:
    return constant(viewpoint.tolist(), T_cloud_hand.device) - T_cloud_hand[:, :3, 3]


def _log_counts(masks: Sequence[Tensor]) -> list[Tensor]:
    """ln(1 + n) of the places each mask (E, Q) holds: (E,) each."""
    return list(torch.stack(list(masks)).sum(dim=2).double().log1p())


def _hits(there: Tensor, position: Tensor, gripper: Gripper) -> list[Tensor]:
    """Points inside the open hand, near its fingers, on its way in and beyond its tips."""
    x, y, z = position
    hand, fingers = gripper.hand_boxes, gripper.finger_boxes
    inner = gripper.max_opening / 2
    in_line = (x.abs() < gripper.pad_half_width) & (y.abs() < inner)
    right, left = torch.stack((x, y - inner, z)), torch.stack((x, -y - inner, z))
    regions = [
        _in_any(fingers, right),
        _in_any(fingers, left),
        _in_any(hand, position),
        _in_any(fingers, right, around=NEAR),
        _in_any(fingers, left, around=NEAR),
        _in_any(hand, position, behind=math.inf)
        | _in_any(fingers, right, behind=APPROACH_LENGTH)
        | _in_any(fingers, left, behind=APPROACH_LENGTH),
        in_line & (z >= gripper.tip_z),
    ]
    return _log_counts([region & there for region in regions])


def _in_any(boxes: Boxes, position: Tensor, around: float = 0.0, behind: float = 0.0) -> Tensor:
    """Which points lie in one of some boxes, grown around (not behind) and lengthened behind."""
    inside = torch.zeros_like(position[0], dtype=torch.bool)
    for low, high in boxes:
        lower = (low[0] - around, low[1] - around, low[2] - behind)
        upper = tuple(corner + around for corner in high)
        inside |= within(position, constant((lower, upper), position.device))
    return inside


def _between_fingers(
    there: Tensor, position: Tensor, normal: Tensor, gripper: Gripper
) -> list[Tensor]:
    """Extent, middle and normals of what the closing fingers would meet."""
    (x, y, z), (nx, ny, nz) = position, normal
    half, inner = gripper.pad_half_width, gripper.max_opening / 2
    length = gripper.foremost_z - gripper.palm_z
    z = z - gripper.palm_z
    around = there & (y.abs() < inner) & (z > 0) & (z < length)
    inside, wide = around & (x.abs() < half), around & (x.abs() < 3 * half)
    y_high, y_low = _highest(y, inside), -_highest(-y, inside)
    slabs = [
        inside & (y > y_high.unsqueeze(1) - SLAB),
        inside & (y < y_low.unsqueeze(1) + SLAB),
    ]
    regions = [inside, wide, inside & (y > AXIS), inside & (y < -AXIS), *slabs]
    values = torch.stack((x, y, z, nx.abs(), ny.abs(), nz, ny), dim=2)  # (E, Q, V)
    masks = torch.stack(regions, dim=1)  # (E, R, Q)
    count = masks.sum(dim=2, keepdim=True)
    means = (masks.float() @ values) / count.clamp_min(1)  # (E, R, V), 0 where there is none
    z_mean = torch.where(count[:, :, 0] > 0, means[:, :, 2], length / 2)  # (E, R)
    facing, away = inside & (ny > FACING), inside & (ny < -FACING)
    logs = _log_counts([inside, wide, facing, away, *slabs])
    columns = [
        *(logs[0], _highest(x, inside), -_highest(-x, inside), means[:, 0, 0]),
        *(y_high, y_low, means[:, 0, 1]),
        *(_highest(z, inside), -_highest(-z, inside, -length), z_mean[:, 0]),
        *(logs[1], _highest(x, wide), -_highest(-x, wide), means[:, 1, 0]),
        *(means[:, 0, 3], means[:, 0, 4], means[:, 0, 5], logs[2], logs[3]),
        *(means[:, 2, 6], means[:, 3, 6]),
    ]
    for slab in (4, 5):
        columns += [logs[slab], means[:, slab, 6], z_mean[:, slab], means[:, slab, 0]]
    return columns


def _highest(values: Tensor, mask: Tensor, default: float = 0.0) -> Tensor:
    """Highest of values (E, Q) where a mask holds: (E,); the default where it holds nowhere."""
    highest = values.masked_fill(~mask, -torch.inf).amax(dim=1)
    return torch.where(highest.isinf(), default, highest)


def _cut_off(scene: DeviceScene, view: DeviceView, position: Tensor, gripper: Gripper) -> Tensor:
    """Points between the fingers where a side of the workspace cuts things off."""
    x, y, z = position
    if scene.at_side is None:
        return torch.zeros(len(x), device=x.device)
    inside = view.there & (x.abs() < gripper.pad_half_width + NEAR)
    inside &= (y.abs() < gripper.max_opening / 2) & (z > gripper.palm_z)
    inside &= z < gripper.tip_z + NEAR
    return _log_counts([inside & scene.at_side[view.row]])[0]


def _directions(scene: DeviceScene, T_cloud_hand: Tensor, side: Tensor) -> list[Tensor]:
    """Where the camera and up are, in hand frames; a camera that is not known is nowhere."""
    turn = T_cloud_hand[:, :3, :3].clone()
    turn[:, :, 0] *= side.unsqueeze(1)
    toward = torch.zeros_like(turn[:, :, 0])
    if scene.viewpoint is not None:
        toward = _toward_camera(scene.viewpoint, T_cloud_hand)
        toward = toward / toward.norm(dim=1, keepdim=True).clamp_min(1e-9)
    ups = constant(UP.tolist(), turn.device)
    return [*(toward.unsqueeze(1) @ turn).squeeze(1).T, *(ups @ turn).T]


def _stance(scene: DeviceScene, candidates: DeviceCandidates, gripper: Gripper) -> list[Tensor]:
    """The edge itself, and how the hand stands to gravity and to the support plane."""
    pose, points = candidates.T_cloud_hand, scene.cloud.points
    up = constant(UP.tolist(), pose.device)
    contact = points[candidates.contact_index]
    edge = contact - points[candidates.approach_index]
    columns = [
        candidates.depth,
        edge.norm(dim=1),
        (edge * pose[:, :3, 1]).sum(dim=1),
        candidates.approach @ up,
        (pose[:, :3, 1] @ up).abs(),
    ]
    support = scene.support
    if support is None:
        return columns + [torch.full_like(candidates.depth, UNKNOWN_HEIGHT)] * HEIGHTS
    normal = constant(support.normal, pose.device, torch.float64)
    tips = pose[:, :3, 3] + gripper.tip_z * pose[:, :3, 2]
    heights = [
        tips.double() @ normal - support.offset,
        contact.double() @ normal - support.offset,
        support_clearance(pose, support, gripper),
    ]
    return columns + [h.clamp(-UNKNOWN_HEIGHT, UNKNOWN_HEIGHT) for h in heights]
