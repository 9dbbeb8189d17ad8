"""Order scored grasps and thin out near duplicates."""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.options import Suppression

Float32 = NDArray[np.float32]

COLLIDING = 0.5  # a score is worth this share where the hand meets something, as far as one sees
SURE_SCORE = 0.9  # from which the order `highest` goes by height (the paper's robot policy)


def ranked(
    score: NDArray[np.floating],
    collision_free: NDArray[np.bool_],
    order: Literal["score", "highest", "clearance"] = "score",
    height: NDArray[np.floating] | None = None,
    clearance: NDArray[np.floating] | None = None,
) -> NDArray[np.int64]:
    """Rows best first.

    Args:
        score: (E,) probabilities.
        collision_free: (E,) the others' scores are worth COLLIDING as much.
        order: By score; by height where the score is SURE_SCORE or more, then the others by
            score; or those free of collision first, by clearance, then by score.
        height: (E,) of the TCP along up, for `highest`.
        clearance: (E,) for `clearance`.
    """
    worth = np.where(collision_free, score, COLLIDING * score)
    keys: tuple[NDArray[Any], ...] = (-worth,)
    if order == "highest" and height is not None:
        sure = worth >= SURE_SCORE
        keys = (-worth, np.where(sure, -height, -worth), ~sure)
    if order == "clearance" and clearance is not None:
        keys = (-score, -clearance, ~collision_free)
    return np.lexsort(keys).astype(np.int64)


def suppress(
    T_cloud_tcp: Float32, order: NDArray[np.int64], suppression: Suppression, top_k: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keep the best of each group of near duplicates.

    A hand and the same hand turned by 180 degrees about its approach count as one.

    Args:
        T_cloud_tcp: (E, 4, 4).
        order: (M,) rows, best first.
        suppression: Two grasps nearer than both of its distances are duplicates.
        top_k: How many to keep at most.

    Returns:
        (at most top_k,) rows kept, best first, and the rows that are near one of them.
    """
    kept: list[int] = []
    dropped = [order[:0]]
    left = order
    while len(left) and len(kept) < top_k:
        best, left = int(left[0]), left[1:]
        kept.append(best)
        apart = np.linalg.norm(T_cloud_tcp[left, :3, 3] - T_cloud_tcp[best, :3, 3], axis=1)
        near = apart < suppression.translation
        turned = rotation_distance(T_cloud_tcp[left[near], :3, :3], T_cloud_tcp[best, :3, :3])
        near[near] = turned < suppression.rotation
        dropped.append(left[near])
        left = left[~near]
    return np.asarray(kept, dtype=np.int64), np.concatenate(dropped)


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
