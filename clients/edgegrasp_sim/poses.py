"""Rigid transforms as 4 x 4 matrices; a name `T_a_b` maps coordinates of frame b to frame a."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64


def quaternion_xyzw(T: Float64) -> list[float]:
    """The rotation part of a 4 x 4 rigid transform as a unit quaternion `xyzw`."""
    return list(Rotation.from_matrix(T[:3, :3], assume_valid=True).as_quat().tolist())


def about_z(angle: float) -> tuple[float, float, float, float]:
    """The quaternion `xyzw` of a rotation about z, radians."""
    return 0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2))


def translation(x: float, y: float, z: float) -> Float64:
    """A 4 x 4 transform that moves by (x, y, z) metres without rotation."""
    T = np.eye(4)
    T[:3, 3] = (x, y, z)
    return T


def require_pose(T_world_hand: ArrayLike) -> Float64:
    """Check that the pose of a hand is a finite rigid transform (4, 4); raises ValueError."""
    T = np.asarray(T_world_hand, dtype=np.float64)
    rigid = T.shape == (4, 4) and np.isfinite(T).all() and T[3].tolist() == [0, 0, 0, 1]
    R = T[:3, :3] if rigid else np.zeros((3, 3))
    if not np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-3) or np.linalg.det(R) < 0:
        wanted = "pass a finite 4 x 4 matrix with a right-handed rotation without scale"
        raise ValueError(f"T_world_hand is not a rigid transform: {T.tolist()}; {wanted}")
    return T
