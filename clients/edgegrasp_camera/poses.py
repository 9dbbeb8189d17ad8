"""Rotations as quaternions xyzw and as matrices."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]


def quaternion_from_matrix(rotation: ArrayLike) -> Float64:
    """The unit quaternion of a rotation, its w not negative.

    Args:
        rotation: (3, 3) orthonormal up to rounding.

    Returns:
        (4,) x, y, z, w.
    """
    r = np.asarray(rotation, dtype=np.float64)
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    multiples = np.empty((4, 4))  # of the quaternion, by 4x, 4y, 4z and 4w
    multiples[:3, :3] = r + r.T + (1.0 - np.trace(r)) * np.eye(3)
    multiples[:3, 3] = multiples[3, :3] = x, y, z
    multiples[3, 3] = 1.0 + np.trace(r)
    longest = multiples[np.argmax(np.diag(multiples))]  # the most precise
    quaternion: Float64 = longest / np.linalg.norm(longest)
    return -quaternion if quaternion[3] < 0 else quaternion


def matrix_from_quaternion(quaternion: ArrayLike) -> Float64:
    """The rotation of a quaternion.

    Args:
        quaternion: (4,) x, y, z, w; of any length but zero.

    Returns:
        (3, 3).

    Raises:
        ValueError: Its length is zero or not finite.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    length = np.linalg.norm(q)
    if not np.isfinite(length) or length < 1e-12:
        raise ValueError(f"quaternion: got {q.tolist()}. Give x, y, z, w that are not all zero.")
    x, y, z, w = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
