"""How far hands must open and what the hand network is told of them, on a device."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE
from edgegrasp_model.hand_view import reach_of
from edgegrasp_model.on_device.candidates import DeviceCandidates
from edgegrasp_model.on_device.captured import Captured
from edgegrasp_model.on_device.collision import widths_needed
from edgegrasp_model.on_device.hand_description import (
    Known,
    SeenHands,
    describe_hands,
    mirror_sides,
)
from edgegrasp_model.on_device.hand_points import points_around_fingers
from edgegrasp_model.on_device.hand_view import DeviceView, hand_view, hands_together
from edgegrasp_model.on_device.hidden_space import hidden_shares
from edgegrasp_model.on_device.padded_balls import POINT_STEPS, bucket
from edgegrasp_model.on_device.scene import DeviceScene

TOGETHER = 4096  # hands at a time: their masks take some hundred megabytes
KINDS = 16  # of gripper and scene whose graphs are kept


def hand_widths(scene: DeviceScene, candidates: DeviceCandidates, gripper: Gripper) -> Tensor:
    """Opening (E,) that each hand needs, metres."""
    parts = [
        widths_needed(view.there, view.position, gripper)[:size]
        for size, _, view in _views(scene, candidates, gripper)
    ]
    return torch.cat(parts)


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
    known = Known(scene.viewpoint is not None, scene.support is not None)
    look = _look(gripper, known, num_points)
    parts = [
        look(*_seen(scene, part, view, gripper))[:size]
        for size, part, view in _views(scene, candidates, gripper)
    ]
    sizes = [1, 1, HAND_DESCRIPTION_SIZE, 6 * num_points]
    width, count, description, points = torch.split(torch.cat(parts), sizes, dim=1)
    points = points.reshape(-1, num_points, 6)
    batch = HandBatch(description.contiguous(), points, count.squeeze(1).long(), balls)
    return width.squeeze(1), batch


@lru_cache(maxsize=KINDS)
def _look(gripper: Gripper, known: Known, num_points: int) -> Captured:
    """Looks from hands: tells opening, number of points, description and points of each."""

    def look(*parts: Tensor) -> Tensor:
        seen = SeenHands(*parts)
        side = mirror_sides(seen, known)
        points, count = points_around_fingers(seen, side, gripper, num_points)
        columns = (
            widths_needed(seen.there, seen.position, gripper).unsqueeze(1),
            count.unsqueeze(1).float(),
            describe_hands(seen, known, gripper, side),
            points.flatten(1),
        )
        return torch.cat(columns, dim=1)

    return Captured(look)


def _views(
    scene: DeviceScene, candidates: DeviceCandidates, gripper: Gripper
) -> Iterator[tuple[int, DeviceCandidates, DeviceView]]:
    """Some candidates at a time, and what their hands see.

    There are as many as one of few sizes has, the last one over and over; their true number is
    beside them.
    """
    together = min(TOGETHER, hands_together(scene.cloud))
    device = candidates.pair.device
    for start in range(0, len(candidates), together):
        size = min(together, len(candidates) - start)
        rows = torch.arange(bucket(size, POINT_STEPS), device=device).clamp(max=size - 1) + start
        part = candidates.take(rows)
        yield size, part, hand_view(scene.cloud, part.T_cloud_hand, reach_of(gripper))


def _seen(
    scene: DeviceScene, part: DeviceCandidates, view: DeviceView, gripper: Gripper
) -> SeenHands:
    points, row = scene.cloud.points, view.row
    nowhere = torch.zeros_like(view.there) if scene.at_side is None else scene.at_side[row]
    camera, plane = np.zeros(3, np.float32), np.zeros(4)
    if scene.viewpoint is not None:
        camera = scene.viewpoint
    if scene.support is not None:
        plane = np.array([*scene.support.normal, scene.support.offset])
    return SeenHands(
        T_cloud_hand=part.T_cloud_hand,
        approach=part.approach,
        depth=part.depth,
        approach_point=points[part.approach_index],
        contact_point=points[part.contact_index],
        there=view.there,
        position=view.position,
        normal=scene.cloud.normals[row],
        hidden=torch.stack(hidden_shares(scene, part.T_cloud_hand, gripper), dim=1),
        at_side=nowhere,
        camera=torch.from_numpy(camera).to(points.device),
        support=torch.from_numpy(plane).to(points.device),
    )
