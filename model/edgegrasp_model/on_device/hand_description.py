"""The hand-frame description on a device; `edgegrasp_model.hand_description` in tensors.

Where that one goes over the seen points region by region, here every region is a mask over all
places of all hands, counts are one sum, and means one product of masks and values.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from edgegrasp_model.collision import UP
from edgegrasp_model.gripper import Boxes, Gripper
from edgegrasp_model.hand_description import AXIS, FACING, HEIGHTS, SLAB, UNKNOWN_HEIGHT
from edgegrasp_model.hand_view import APPROACH_LENGTH, NEAR
from edgegrasp_model.on_device.candidates import clearance_over
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.on_device.hand_view import within


class SeenHands(NamedTuple):
    """E hands and what they see, at most Q points each. Metres, canonical frame."""

    T_cloud_hand: Tensor  # (E, 4, 4)
    approach: Tensor  # (E, 3) unit, outward
    depth: Tensor  # (E,)
    approach_point: Tensor  # (E, 3) p_a
    contact_point: Tensor  # (E, 3) p_c
    there: Tensor  # (E, Q) which places hold a point
    position: Tensor  # (3, E, Q) in the hand frame
    normal: Tensor  # (E, Q, 3) in the canonical frame
    hidden: Tensor  # (E, H) what `hidden_shares` says of the hands
    at_side: Tensor  # (E, Q) where a side of the workspace cuts the cloud off
    camera: Tensor  # (3,) the viewpoint
    support: Tensor  # (4,) float64, the support plane's normal and offset


class Known(NamedTuple):
    """What is known of a scene; the rest of `SeenHands` holds any numbers in its place."""

    camera: bool
    support: bool


def describe_hands(seen: SeenHands, known: Known, gripper: Gripper, side: Tensor) -> Tensor:
    """The hand-frame description of each hand: (E, HAND_DESCRIPTION_SIZE).

    Args:
        seen: The hands.
        known: What is known of their scene.
        gripper: Fingers open to its maximum.
        side: (E,) from `mirror_sides`.
    """
    position = mirrored(seen.position, side)
    columns = [
        *_hits(seen.there, position, gripper),
        *_between_fingers(seen.there, position, hand_normals(seen, side), gripper),
        _cut_off(seen, gripper),
        *_directions(seen, known, side),
        *seen.hidden.unbind(dim=1),
        *_stance(seen, known, gripper),
    ]
    return torch.stack(columns, dim=1).float()


def hand_normals(seen: SeenHands, side: Tensor) -> Tensor:
    """Normals of the seen points in hand frames, mirrored: (3, E, Q)."""
    return mirrored((seen.normal @ seen.T_cloud_hand[:, :3, :3]).permute(2, 0, 1), side)


def mirror_sides(seen: SeenHands, known: Known) -> Tensor:
    """1 or -1 (E,): what a hand's x is multiplied by, so that the camera is on its positive side.

    1 for all where the viewpoint is not known.
    """
    if not known.camera:
        return torch.ones_like(seen.depth)
    toward = seen.camera - seen.T_cloud_hand[:, :3, 3]
    along_x = (toward * seen.T_cloud_hand[:, :3, 0]).sum(dim=1)
    return torch.where(along_x < 0.0, -1.0, 1.0)


def mirrored(vectors: Tensor, side: Tensor) -> Tensor:
    """Vectors (3, E, Q) with their x multiplied by `side` (E,)."""
    x, y, z = vectors
    return torch.stack((x * side.unsqueeze(1), y, z))


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


def _cut_off(seen: SeenHands, gripper: Gripper) -> Tensor:
    """Points between the fingers where a side of the workspace cuts things off."""
    x, y, z = seen.position
    inside = seen.at_side & seen.there & (x.abs() < gripper.pad_half_width + NEAR)
    inside &= (y.abs() < gripper.max_opening / 2) & (z > gripper.palm_z)
    inside &= z < gripper.tip_z + NEAR
    return _log_counts([inside])[0]


def _directions(seen: SeenHands, known: Known, side: Tensor) -> list[Tensor]:
    """Where the camera and up are, in hand frames; a camera that is not known is nowhere."""
    turn = seen.T_cloud_hand[:, :3, :3].clone()
    turn[:, :, 0] *= side.unsqueeze(1)
    toward = torch.zeros_like(seen.approach)
    if known.camera:
        toward = seen.camera - seen.T_cloud_hand[:, :3, 3]
        toward = toward / toward.norm(dim=1, keepdim=True).clamp_min(1e-9)
    ups = constant(UP.tolist(), turn.device)
    return [*(toward.unsqueeze(1) @ turn).squeeze(1).T, *(ups @ turn).T]


def _stance(seen: SeenHands, known: Known, gripper: Gripper) -> list[Tensor]:
    """The edge itself, and how the hand stands to gravity and to the support plane."""
    pose, contact = seen.T_cloud_hand, seen.contact_point
    up = constant(UP.tolist(), pose.device)
    edge = contact - seen.approach_point
    columns = [
        seen.depth,
        edge.norm(dim=1),
        (edge * pose[:, :3, 1]).sum(dim=1),
        seen.approach @ up,
        (pose[:, :3, 1] @ up).abs(),
    ]
    if not known.support:
        return columns + [torch.full_like(seen.depth, UNKNOWN_HEIGHT)] * HEIGHTS
    normal, offset = seen.support[:3], seen.support[3]
    tips = pose[:, :3, 3] + gripper.tip_z * pose[:, :3, 2]
    heights = [tips.double() @ normal, contact.double() @ normal]
    heights.append(clearance_over(pose, normal, gripper))
    return columns + [(h - offset).clamp(-UNKNOWN_HEIGHT, UNKNOWN_HEIGHT) for h in heights]
