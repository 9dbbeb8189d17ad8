"""Cloud points in the frames of hands, limited to those within reach."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from edgegrasp_camera.arrays import Float32, Int64
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_kernels import points_in_hand_boxes
from edgegrasp_model.scene.cloud import Cloud

NEAR = 0.006  # metres around a finger that count as near it
APPROACH_LENGTH = 0.05  # metres of straight approach that the hand description looks at


@dataclass(frozen=True)
class HandView:
    """Cloud points in hand frames, without those out of reach."""

    candidate: Int64  # (P,) ascending
    row: Int64  # (P,) row of the cloud
    position: Float32  # (P, 3) in the hand frame
    num_candidates: int

    @cached_property
    def columns(self) -> Float32:
        """The positions as rows x, y, z (3, P), which is many times faster to process."""
        return np.ascontiguousarray(self.position.T)

    @cached_property
    def bounds(self) -> Int64:
        """Where the points of each hand begin, and the last's end: (E + 1,)."""
        return np.searchsorted(self.candidate, np.arange(self.num_candidates + 1))


def hand_views(cloud: Cloud, T_cloud_hand: Float32, gripper: Gripper) -> HandView:
    """The cloud in hands' frames (E, 4, 4): what open hands meet on a straight approach."""
    boxes = gripper.open_boxes
    low = boxes[:, 0].min(axis=0) - np.array([NEAR, NEAR, APPROACH_LENGTH])
    high = boxes[:, 1].max(axis=0) + np.array([NEAR, NEAR, 2 * NEAR])
    high[2] += gripper.max_tip_z - gripper.tip_z
    reach = low.astype(np.float32), high.astype(np.float32)
    hand, row, position = points_in_hand_boxes(cloud.points, T_cloud_hand, *reach)
    return HandView(hand, row, position, len(T_cloud_hand))
