"""Order scored grasps and thin out near duplicates."""

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.options import Suppression

Float32 = NDArray[np.float32]


def ranked(score: NDArray[np.floating], collision_free: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows best first: collision-free ones before the others, then by score.  # (E,)."""
    return np.lexsort((-score, ~collision_free)).astype(np.int64)


def suppress(
    T_cloud_tcp: Float32, order: NDArray[np.int64], suppression: Suppression, top_k: int
) -> NDArray[np.int64]:
    """Keep the best of each group of near duplicates.

    A hand and the same hand turned by 180 degrees about its approach count as one.

    Args:
        T_cloud_tcp: (E, 4, 4).
        order: (M,) rows, best first.
        suppression: Two grasps nearer than both of its distances are duplicates.
        top_k: How many to keep at most.

    Returns:
        (at most top_k,) rows, best first.
    """
    kept: list[int] = []
    left = order
    while len(left) and len(kept) < top_k:
        best, left = int(left[0]), left[1:]
        kept.append(best)
        apart = np.linalg.norm(T_cloud_tcp[left, :3, 3] - T_cloud_tcp[best, :3, 3], axis=1)
        turned = rotation_distance(T_cloud_tcp[left, :3, :3], T_cloud_tcp[best, :3, :3])
        near = (apart < suppression.translation) & (turned < suppression.rotation)
        left = left[~near]
    return np.asarray(kept, dtype=np.int64)


def rotation_distance(rotations: Float32, rotation: Float32) -> Float32:
    """Smallest angle between hands, the flip about the approach allowed.

    Args:
        rotations: (E, 3, 3).
        rotation: (3, 3).

    Returns:
        (E,) radians.
    """
    along = np.einsum("edk,dk->ek", rotations, rotation)  # (E, 3) cosines of matching axes
    trace = along[:, 2] + np.abs(along[:, 0] + along[:, 1])
    angle: Float32 = np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0))
    return angle
