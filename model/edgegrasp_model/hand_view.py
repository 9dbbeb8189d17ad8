"""The cloud as it is seen from some hands."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_kernels import points_in_hand_boxes
from edgegrasp_model.kernels import compiled
from edgegrasp_model.scene.cloud import UP, Cloud

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

NEAR = 0.006  # metres around a finger that count as near it
APPROACH_LENGTH = 0.05  # metres of straight approach that the hand description looks at


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
    high[2] += gripper.max_tip_z - gripper.tip_z
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

    @cached_property
    def bounds(self) -> Int64:
        """Where the points of each hand begin, and the last's end: (E + 1,)."""
        return np.searchsorted(self.candidate, np.arange(self.num_candidates + 1))

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
    low, high = np.asarray(reach, dtype=np.float32)
    hand, row, position = points_in_hand_boxes(cloud.points, T_cloud_hand, low, high)
    return HandView(hand, row, position, len(T_cloud_hand), reach)


SEEN_LENGTH = 0.0465  # metres of the fingers, from their tips: the Panda's are no longer


def seen_part(gripper: Gripper) -> Gripper:
    """The same hand with its palm at most so far behind its fingertips.

    The ends of the fingers hold an object: relative to them, hands of any length look alike.
    """
    return replace(gripper, palm_z=max(gripper.palm_z, gripper.tip_z - SEEN_LENGTH))


ABOVE = 0.001  # metres over the camera
# Metres beyond the pads' sides, the open fingers' inner faces, the palm and the tips.
BESIDE, OUTSIDE, BEHIND, BEYOND = 0.027, 0.06, 0.026, 0.012


def only_viewpoint(viewpoints: Float32 | None) -> Float32 | None:
    """The camera (3,) among (W, 3), where there is exactly one."""
    return viewpoints[0] if viewpoints is not None and len(viewpoints) == 1 else None


def mirror_sides(T_cloud_hand: Float32, viewpoint: Float32 | None) -> Float32:
    """1 or -1 (E,): what a hand's x is multiplied by, so that the camera is on its positive side.

    1 for all where the viewpoint is not known. Canonical frame.
    """
    if viewpoint is None:
        return np.ones(len(T_cloud_hand), dtype=np.float32)
    # Straight ahead of a hand that comes from the camera, up decides, not rounding.
    toward = viewpoint + ABOVE * UP - T_cloud_hand[:, :3, 3]
    along_x = np.einsum("ed,ed->e", toward, T_cloud_hand[:, :3, 0])
    return np.where(along_x < 0.0, -1.0, 1.0).astype(np.float32)


def points_around_fingers(
    normals: Float32,
    T_cloud_hand: Float32,
    gripper: Gripper,
    viewpoint: Float32 | None,
    view: HandView,
    limit: int,
) -> tuple[Float32, NDArray[np.int64]]:
    """What each hand sees of the cloud around its fingers.

    Args:
        normals: (N, 3) of the cloud.
        T_cloud_hand: (E, 4, 4).
        gripper: Fingers open to its maximum.
        viewpoint: (3,) the only camera; where it is known, x points to its side.
        view: `hand_views` of the same hands, reaching at least `hand_view.reach_of` the gripper.
        limit: Points kept of each hand, spread evenly over the cloud's order.

    Returns:
        (E, limit, 6) positions from between the fingertips in metres and normals, in hand frames,
        zeros behind the last; and their number (E,).
    """
    x, y = gripper.pad_half_width + BESIDE, gripper.max_opening / 2 + OUTSIDE
    palm_z = seen_part(gripper).palm_z
    low, high = (-x, -y, palm_z - BEHIND), (x, y, gripper.tip_z + BEYOND)
    points = np.zeros((view.num_candidates, limit, 6), dtype=np.float32)
    count = np.zeros(view.num_candidates, dtype=np.int64)
    _around_fingers(
        view.bounds,
        view.row,
        view.columns,
        normals,
        T_cloud_hand,
        mirror_sides(T_cloud_hand, viewpoint),
        np.array([low, high, (0.0, 0.0, gripper.tip_z)], dtype=np.float32),
        points,
        count,
    )
    return points, count


@compiled("contract")
def _around_fingers(
    bounds: Int64,
    row: Int64,
    columns: Float32,
    normals: Float32,
    T_cloud_hand: Float32,
    side: Float32,
    box: Float32,
    points: Float32,
    count: Int64,
) -> None:
    limit = points.shape[1]
    low, high, origin = box
    for e in range(len(side)):
        x, y, z = columns[:, bounds[e] : bounds[e + 1]]
        inside = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        near = bounds[e] + np.flatnonzero(inside & (z > low[2]) & (z < high[2]))
        count[e] = min(len(near), limit)
        for slot in range(count[e]):
            # Where there are too many, those at even distances in the cloud's order.
            p = near[((slot + 1) * len(near) - 1) // limit if len(near) > limit else slot]
            for d in range(3):
                points[e, slot, d] = columns[d, p] - origin[d]
                for k in range(3):
                    points[e, slot, 3 + d] += normals[row[p], k] * T_cloud_hand[e, k, d]
            points[e, slot, 0] *= side[e]
            points[e, slot, 3] *= side[e]
