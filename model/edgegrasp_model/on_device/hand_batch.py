"""How far hands must open and what the hand network is told of them, on a device."""

from collections.abc import Iterator

import torch
from torch import Tensor

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.hand_view import reach_of
from edgegrasp_model.on_device.candidates import DeviceCandidates
from edgegrasp_model.on_device.collision import widths_needed
from edgegrasp_model.on_device.hand_description import describe_hands, mirror_sides, mirrored
from edgegrasp_model.on_device.hand_points import points_around_fingers
from edgegrasp_model.on_device.hand_view import DeviceView, hand_view, hands_together
from edgegrasp_model.on_device.scene import DeviceScene

TOGETHER = 4096  # hands at a time: their masks take some hundred megabytes


def hand_widths(scene: DeviceScene, candidates: DeviceCandidates, gripper: Gripper) -> Tensor:
    """Opening (E,) that each hand needs, metres."""
    views = _views(scene, candidates, gripper)
    return torch.cat([widths_needed(view, gripper) for _, view in views])


def hand_batch(
    scene: DeviceScene,
    candidates: DeviceCandidates,
    balls: int,
    gripper: Gripper,
    num_points: int,
) -> tuple[Tensor, HandBatch]:
    """Opening (E,) that each hand needs, and what the network is told of it.

    Args:
        scene: The scene.
        candidates: E of them, at least one.
        balls: Approach points that they are around.
        gripper: The hand, open to its maximum.
        num_points: Points around the fingers.
    """
    widths, descriptions, points, counts = [], [], [], []
    for part, view in _views(scene, candidates, gripper):
        side = mirror_sides(scene, part.T_cloud_hand)
        normal = mirrored(_normals(scene, part.T_cloud_hand, view), side)
        widths.append(widths_needed(view, gripper))
        descriptions.append(describe_hands(scene, part, gripper, view, normal, side))
        around, count = points_around_fingers(view, normal, side, gripper, num_points)
        points.append(around)
        counts.append(count)
    batch = HandBatch(torch.cat(descriptions), torch.cat(points), torch.cat(counts), balls)
    return torch.cat(widths), batch


def _views(
    scene: DeviceScene, candidates: DeviceCandidates, gripper: Gripper
) -> Iterator[tuple[DeviceCandidates, DeviceView]]:
    """The candidates some at a time, and what their hands see."""
    together = min(TOGETHER, hands_together(scene.cloud))
    for rows in torch.split(torch.arange(len(candidates), device=candidates.pair.device), together):
        part = candidates.take(rows)
        yield part, hand_view(scene.cloud, part.T_cloud_hand, reach_of(gripper))


def _normals(scene: DeviceScene, T_cloud_hand: Tensor, view: DeviceView) -> Tensor:
    """Normals of the seen points in hand frames: (3, E, Q)."""
    seen = scene.cloud.normals[view.row]  # (E, Q, 3)
    return (seen @ T_cloud_hand[:, :3, :3]).permute(2, 0, 1)
