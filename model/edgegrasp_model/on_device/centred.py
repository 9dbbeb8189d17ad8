"""`edgegrasp_model.centred` on a device: all hands at once."""

import torch
from torch import Tensor

from edgegrasp_model.centred import BESIDE_PADS, LEAST_SHIFT, MOST_SHIFT, WIDE, least_outward
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.on_device.balls import DeviceCrop
from edgegrasp_model.on_device.candidates import DeviceCandidates
from edgegrasp_model.on_device.cloud import PAIRS, squared_distances


def centred_grasps(
    points: Tensor, crop: DeviceCrop, candidates: DeviceCandidates, gripper: Gripper
) -> DeviceCandidates:
    """Candidates for wide objects: hands moved along their closing direction."""
    axes, origin = candidates.T_cloud_hand[:, :3, :3], candidates.T_cloud_hand[:, :3, 3]
    outward = ((points[candidates.contact_index] - origin) * axes[:, :, 1]).sum(dim=1)
    wide = (outward.abs() > least_outward(gripper)).nonzero().squeeze(1)
    low, high = outward.new_empty(len(wide)), outward.new_empty(len(wide))
    together = max(1, PAIRS // max(1, len(points)))
    for start in range(0, len(wide), together):
        part = slice(start, start + together)
        here = wide[part]
        approach = points[candidates.approach_index[here]]
        near = points - origin[here].unsqueeze(1)  # (K, N, 3)
        x, y, z = (near @ axes[here]).unbind(dim=2)
        between = squared_distances(approach, points) <= crop.radius**2
        between &= x.abs() < gripper.pad_half_width + BESIDE_PADS
        between &= (z > gripper.palm_z) & (z < gripper.foremost_z)
        low[part] = y.masked_fill(~between, torch.inf).amin(dim=1)
        high[part] = y.masked_fill(~between, -torch.inf).amax(dim=1)
    middle, width = (low + high) / 2, high - low
    moved = (width > WIDE * gripper.max_opening) & (width < gripper.max_opening)
    moved &= (middle.abs() > LEAST_SHIFT) & (middle.abs() < MOST_SHIFT)
    further = candidates.take(wide[moved])
    further.T_cloud_hand[:, :3, 3] += middle[moved, None] * further.T_cloud_hand[:, :3, 1]
    return further
