"""The seen points that lie between and around the fingers of each hand, on a device."""

import torch
from torch import Tensor

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_points import BEHIND, BESIDE, BEYOND, OUTSIDE
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.on_device.hand_description import SeenHands, hand_normals, mirrored


def points_around_fingers(
    seen: SeenHands, side: Tensor, gripper: Gripper, limit: int
) -> tuple[Tensor, Tensor]:
    """What each hand sees of the cloud around its fingers.

    Args:
        seen: E hands.
        side: (E,) from `mirror_sides`.
        gripper: Fingers open to its maximum.
        limit: Points kept of each hand, spread evenly over the cloud's order.

    Returns:
        (E, limit, 6) positions from between the fingertips in metres and normals, in hand frames,
        zeros behind the last; and their number (E,).
    """
    x, y, z = seen.position
    near = seen.there & (x.abs() < gripper.pad_half_width + BESIDE)
    near &= y.abs() < gripper.max_opening / 2 + OUTSIDE
    near &= (z > gripper.palm_z - BEHIND) & (z < gripper.tip_z + BEYOND)
    found = near.sum(dim=1, keepdim=True)  # (E, 1)
    rank = near.cumsum(dim=1)  # of each point, from 1
    before = _kept(rank - 1, found, limit)
    kept = near & (_kept(rank, found, limit) > before)
    place = torch.where(kept, before, limit)  # the last place is for all others
    tips = constant((0.0, 0.0, gripper.tip_z), x.device)
    from_tips = mirrored(seen.position - tips[:, None, None], side)
    values = torch.cat((from_tips, hand_normals(seen, side))).permute(1, 2, 0)  # (E, Q, 6)
    points = torch.zeros((len(x), limit + 1, 6), device=x.device)
    points.scatter_(1, place.unsqueeze(2).expand(-1, -1, 6), values)
    return points[:, :limit].contiguous(), found.squeeze(1).clamp(max=limit)


def _kept(rank: Tensor, found: Tensor, limit: int) -> Tensor:
    """How many of the first `rank` of `found` points are kept."""
    return torch.where(found > limit, rank * limit // found.clamp_min(1), rank)
