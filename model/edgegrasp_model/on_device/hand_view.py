"""The cloud as it is seen from some hands, on a device: as many places for each hand."""

from dataclasses import dataclass

import torch
from torch import Tensor

from edgegrasp_model.hand_view import Reach
from edgegrasp_model.on_device.cloud import DeviceCloud
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.on_device.padded_balls import bucket

SEEN = 2**24  # points times hands looked at at a time
PLACE_STEPS = 4  # sizes of Q from one power of two to the next


@dataclass(frozen=True)
class DeviceView:
    """Cloud points in the hand frames of E hands, Q places for each, in the cloud's order."""

    there: Tensor  # (E, Q) which places hold a point; False behind the last
    row: Tensor  # (E, Q) row of the cloud
    position: Tensor  # (3, E, Q) in the hand frame


def positions(points: Tensor, T_cloud_hand: Tensor) -> Tensor:
    """Points (N, 3) in the frames of hands (E, 4, 4): (3, E, N)."""
    turn = T_cloud_hand[:, :3, :3].transpose(1, 2)  # (E, 3, 3) cloud to hand
    T_hand_cloud = torch.cat((turn, -turn @ T_cloud_hand[:, :3, 3:]), dim=2)  # (E, 3, 4)
    homogeneous = torch.cat((points, torch.ones_like(points[:, :1])), dim=1)
    # One large product for all hands, which a GPU likes better than one for each.
    rows = T_hand_cloud.transpose(0, 1).reshape(-1, 4)  # (3E, 4)
    return (rows @ homogeneous.T).view(3, len(turn), len(points))


def hand_view(cloud: DeviceCloud, T_cloud_hand: Tensor, reach: Reach) -> DeviceView:
    """See the cloud from hands (E, 4, 4), as far as `reach`.

    Args:
        cloud: N points.
        T_cloud_hand: At least one, and so many that E times N fits the memory; see
            `hands_together`.
        reach: What is kept.
    """
    seen = positions(cloud.points, T_cloud_hand)
    inside = within(seen, constant(reach, seen.device))
    count = inside.sum(dim=1)
    most = bucket(int(count.max()), PLACE_STEPS)
    place = torch.where(inside, inside.cumsum(dim=1) - 1, most)  # the last one is for the others
    rows = torch.arange(len(cloud.points), device=seen.device).expand_as(place)
    row = torch.zeros((len(seen[0]), most + 1), dtype=torch.int64, device=seen.device)
    row = row.scatter_(1, place, rows)[:, :most]
    there = torch.arange(most, device=seen.device) < count.unsqueeze(1)
    row = row * there
    return DeviceView(there, row, seen.gather(2, row.expand(3, -1, -1)))


def hands_together(cloud: DeviceCloud) -> int:
    """How many hands to look from at a time."""
    return max(1, SEEN // len(cloud.points))


def within(position: Tensor, corners: Tensor) -> Tensor:
    """Which points (3, ...) lie between two corners (2, 3)."""
    low, high = corners.view(2, 3, *(1,) * (position.dim() - 1))
    inside: Tensor = ((position > low) & (position < high)).all(dim=0)
    return inside
