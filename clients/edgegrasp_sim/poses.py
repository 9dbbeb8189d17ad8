"""Rigid transforms as 4 x 4 matrices; a name `T_a_b` maps coordinates of frame b to frame a."""

import numpy as np
from numpy.typing import ArrayLike

from edgegrasp_camera.arrays import Float64


def quaternion_xyzw(T: Float64) -> list[float]:
    """The rotation part of a 4 x 4 rigid transform as a unit quaternion `xyzw`."""
    (a, b, c), (d, e, f), (g, h, i) = T[:3, :3].tolist()
    # Four times the products of the quaternion with itself; its largest column is the sharpest.
    products = (
        (1.0 + a - e - i, b + d, c + g, h - f),
        (b + d, 1.0 - a + e - i, f + h, c - g),
        (c + g, f + h, 1.0 - a - e + i, d - b),
        (h - f, c - g, d - b, 1.0 + a + e + i),
    )
    column = products[max(range(4), key=lambda k: products[k][k])]
    length = sum(value * value for value in column) ** 0.5
    return [value / length for value in column]


def about_z(angle: float) -> tuple[float, float, float, float]:
    """The quaternion `xyzw` of a rotation about z, radians."""
    return 0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2))


def translation(x: float, y: float, z: float) -> Float64:
    """A 4 x 4 transform that moves by (x, y, z) metres and does not turn."""
    T = np.eye(4)
    T[:3, 3] = (x, y, z)
    return T


def require_pose(T_world_hand: ArrayLike) -> Float64:
    """Check that the pose of a hand is a finite rigid transform (4, 4); raises ValueError."""
    T = np.asarray(T_world_hand, dtype=np.float64)
    R = T[:3, :3] if T.shape == (4, 4) and np.isfinite(T).all() else np.zeros((3, 3))
    if not np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-3) or np.linalg.det(R) < 0:
        wanted = "pass a finite 4 x 4 matrix with a right-handed rotation without scale"
        raise ValueError(f"T_world_hand is not a rigid transform: {T.tolist()}; {wanted}")
    return T
