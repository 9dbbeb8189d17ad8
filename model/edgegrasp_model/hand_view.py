"""The cloud as it is seen from some hands."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgegrasp_model.cloud import Cloud
from edgegrasp_model.compiled import point_kernels
from edgegrasp_model.gripper import Gripper

Float32 = NDArray[np.float32]

NEAR = 0.006  # metres around a finger that count as near it
APPROACH_LENGTH = 0.05  # metres of straight approach that the hand description looks at
CHUNK = 128  # hands at a time, so that the work stays in cache


class Reach(NamedTuple):
    """The part of the hand frame that is looked at."""

    low: tuple[float, ...]  # x, y, z, metres
    high: tuple[float, ...]


def reach_of(
    gripper: Gripper, around: float = NEAR, back: float = APPROACH_LENGTH, lift: float = 0.0
) -> Reach:
    """What is within reach of a gripper's boxes and of their straight ways.

    Args:
        gripper: Open to its maximum.
        around: Metres on every side of a box; never less than NEAR.
        back: Metres of way along -z; never less than APPROACH_LENGTH.
        lift: Metres of way in a direction that is not known.
    """
    boxes = gripper.boxes(gripper.max_opening)
    around, back = max(around, NEAR) + lift, max(back, APPROACH_LENGTH)
    low = boxes[:, 0].min(axis=0) - np.array([around, around, back + around - NEAR])
    high = boxes[:, 1].max(axis=0) + np.array([around, around, around + NEAR])
    high[2] += gripper.foremost_z - gripper.tip_z
    return Reach(tuple(low.tolist()), tuple(high.tolist()))


@dataclass(frozen=True)
class HandView:
    """Cloud points in the hand frames of some hands, those out of reach left out."""

    candidate: NDArray[np.int64]  # (P,) ascending
    row: NDArray[np.int64]  # (P,) row of the cloud
    position: Float32  # (P, 3) in the hand frame
    num_candidates: int
    reach: Reach

    @cached_property
    def columns(self) -> Float32:
        """The positions with x, y, z in rows (3, P): a row at a time is many times faster."""
        return np.ascontiguousarray(self.position.T)

    def take(self, rows: NDArray[np.int64]) -> "HandView":
        """The views of the given hands, which must ascend."""
        renumbered = np.full(self.num_candidates, -1, dtype=np.int64)
        renumbered[rows] = np.arange(len(rows))
        kept = renumbered[self.candidate] >= 0
        candidate = renumbered[self.candidate[kept]]
        return HandView(candidate, self.row[kept], self.position[kept], len(rows), self.reach)

    def within(self, reach: Reach) -> "HandView":
        """The same views, cut down to a smaller reach."""
        if reach == self.reach:
            return self
        low, high = np.asarray(reach, dtype=np.float32)
        kept = within_box(self.columns, low, high)
        return HandView(
            self.candidate[kept],
            self.row[kept],
            self.position[kept],
            self.num_candidates,
            reach,
        )


def within_box(
    columns: Float32, low: NDArray[np.floating], high: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Which points, given as rows x, y, z (3, P), lie between two corners (3,)."""
    inside: NDArray[np.bool_] = columns[0] > low[0]
    inside &= columns[0] < high[0]
    for axis in (1, 2):
        inside &= columns[axis] > low[axis]
        inside &= columns[axis] < high[axis]
    return inside


def hand_views(cloud: Cloud, T_cloud_hand: Float32, reach: Reach) -> HandView:
    """See the cloud from each hand.

    Args:
        cloud: N points.
        T_cloud_hand: (E, 4, 4).
        reach: What is kept.
    """
    if (kernels := point_kernels()) is not None:
        low, high = np.asarray(reach, dtype=np.float32)
        hand, seen, at = kernels.seen_from(cloud.points, T_cloud_hand, low, high)
        return HandView(hand, seen, at, len(T_cloud_hand), reach)
    points = torch.from_numpy(np.ascontiguousarray(cloud.points.T))  # (3, N)
    pose = torch.from_numpy(T_cloud_hand)
    turn = pose[:, :3, :3].transpose(1, 2)  # (E, 3, 3) cloud to hand
    shift = -turn @ pose[:, :3, 3:]  # (E, 3, 1)
    found = [(torch.empty(0, dtype=torch.int64),) * 2 + (torch.empty(0, 3),)]
    for start in range(0, len(pose), CHUNK):
        part = slice(start, start + CHUNK)
        position = torch.baddbmm(shift[part], turn[part], points.expand(len(turn[part]), -1, -1))
        inside = torch.ones_like(position[:, 0], dtype=torch.bool)  # (chunk, N)
        for axis in range(3):
            along = position[:, axis]
            inside &= (along > reach.low[axis]) & (along < reach.high[axis])
        candidate, row = inside.nonzero(as_tuple=True)
        found.append((candidate + start, row, position.transpose(1, 2)[candidate, row]))
    candidates, rows, positions = (torch.cat(parts).numpy() for parts in zip(*found, strict=True))
    return HandView(candidates, rows, positions, len(T_cloud_hand), reach)
