"""Candidates for wide objects: hands centred on what they see between their fingers."""

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.candidates.approach import BallCrop
from edgegrasp_model.candidates.edge import Candidates
from edgegrasp_model.gripper import Gripper

Float32 = NDArray[np.float32]

WIDE = 0.75  # share of the opening from which an object counts as wide
BESIDE_PADS = 0.004  # metres beside the finger pads in which points count


MIN_SHIFT, MAX_SHIFT = 0.001, 0.008  # metres; beyond, another approach point does better


def centred_grasps(
    points: Float32, crop: BallCrop, candidates: Candidates, gripper: Gripper
) -> Candidates:
    """Candidates for wide objects: hands moved along their closing direction.

    The hand of an edge grasp is centred on its approach point, and few sampled points lie in the
    middle of an object almost as wide as the hand opens. Its extent is taken from the points of
    the ball between the fingers; whether the hand fits is left to the collision check.

    Args:
        points: (N, 3) the cloud.
        crop: Balls around the approach points.
        candidates: E of them; `pair` is their contact's row in `crop`.
        gripper: Gives the opening and the pads.

    Returns:
        One for each candidate with a wide object off centre between its fingers.
    """
    axes, origin = candidates.T_cloud_hand[:, :3, :3], candidates.T_cloud_hand[:, :3, 3]
    outward = np.einsum("ed,ed->e", points[candidates.contact_index] - origin, axes[:, :, 1])
    wide = np.flatnonzero(np.abs(outward) > min_contact_offset(gripper))
    ball = crop.ball_of_point[candidates.pair[wide]]
    first = np.searchsorted(crop.ball_of_point, np.arange(ball.max(initial=-1) + 2))
    low, high = np.full((2, len(wide)), np.nan, dtype=np.float32)
    for number in np.unique(ball):
        here = np.flatnonzero(ball == number)
        near = points[crop.ball_rows[first[number] : first[number + 1]]]  # (P, 3)
        turn, shift = axes[wide[here]], origin[wide[here]]
        x, y, z = (
            near @ turn[:, :, axis].T - np.einsum("kd,kd->k", shift, turn[:, :, axis])
            for axis in range(3)
        )  # (P, K) each, hand frame
        between = np.abs(x) < gripper.pad_half_width + BESIDE_PADS
        between &= (z > gripper.palm_z) & (z < gripper.max_tip_z)
        low[here] = np.where(between, y, np.inf).min(axis=0)
        high[here] = np.where(between, y, -np.inf).max(axis=0)
    middle, width = (low + high) / 2, high - low
    moved = (width > WIDE * gripper.max_opening) & (width < gripper.max_opening)
    moved &= (np.abs(middle) > MIN_SHIFT) & (np.abs(middle) < MAX_SHIFT)
    further = candidates.take(wide[moved])
    further.T_cloud_hand[:, :3, 3] += middle[moved, None] * further.T_cloud_hand[:, :3, 1]
    return further


def min_contact_offset(gripper: Gripper) -> float:
    """Least distance between the hand's axis and a contact on a wide object, metres."""
    return WIDE * gripper.max_opening / 2 - MAX_SHIFT
