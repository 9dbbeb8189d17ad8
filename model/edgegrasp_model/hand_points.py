"""The seen points that lie between and around the fingers of each hand, for a point encoder."""

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import mirror_sides
from edgegrasp_model.hand_view import HandView

Float32 = NDArray[np.float32]

# Metres beyond the pads' sides, the open fingers' inner faces, the palm and the tips.
BESIDE, OUTSIDE, BEHIND, BEYOND = 0.027, 0.06, 0.026, 0.012


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
    x, y, z = view.columns
    near = (
        (np.abs(x) < gripper.pad_half_width + BESIDE)
        & (np.abs(y) < gripper.max_opening / 2 + OUTSIDE)
        & (z > gripper.palm_z - BEHIND)
        & (z < gripper.tip_z + BEYOND)
    )
    candidate, row, position = view.candidate[near], view.row[near], view.position[near]
    found = np.bincount(candidate, minlength=view.num_candidates)
    rank = np.arange(len(candidate)) - (np.cumsum(found) - found)[candidate]
    kept_before = _kept(rank, found[candidate], limit)
    kept = _kept(rank + 1, found[candidate], limit) > kept_before
    candidate, slot = candidate[kept], kept_before[kept]
    side = mirror_sides(T_cloud_hand, viewpoint)[candidate, None]  # (Q, 1)
    turn = T_cloud_hand[candidate, :3, :3]
    points = np.zeros((view.num_candidates, limit, 6), dtype=np.float32)
    points[candidate, slot, :3] = position[kept] - np.array(
        [0.0, 0.0, gripper.tip_z], dtype=np.float32
    )
    points[candidate, slot, 3:] = np.einsum("pd,pdk->pk", normals[row[kept]], turn)
    points[candidate, slot, 0::3] *= side
    return points, np.minimum(found, limit)


def _kept(rank: NDArray[np.int64], found: NDArray[np.int64], limit: int) -> NDArray[np.int64]:
    """How many of the first `rank` of `found` points are kept."""
    return np.where(found > limit, rank * limit // np.maximum(found, 1), rank)
