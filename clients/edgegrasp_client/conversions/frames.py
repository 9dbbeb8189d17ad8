"""Hand frames that differ from ours by their axes and their origin; quaternions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]

_AXES = {
    sign + axis: direction * np.eye(3)[row]
    for sign, direction in (("", 1.0), ("-", -1.0))
    for row, axis in enumerate("xyz")
}


@dataclass(frozen=True)
class HandFrame:
    """A frame fixed to the hand: which of its axes point where, and where its origin lies.

    Turning a parallel-jaw hand by 180 degrees about the approach gives the same grasp, so that
    `closing="x"` and `closing="-x"` are equally right.
    """

    approach: str  # its axis along which the hand moves to the object: x, -x, y, -y, z or -z
    closing: str  # its axis along our y, the closing direction
    origin_z: float = 0.0  # metres from the origin of our hand frame to its own, along our z

    def __post_init__(self) -> None:
        for axis in (self.approach, self.closing):
            if axis not in _AXES:
                raise ValueError(f"got {axis!r}. Use one of: {', '.join(_AXES)}.")
        if self.approach[-1] == self.closing[-1]:
            raise ValueError(f"approach and closing are both along {self.approach[-1]}.")

    @property
    def T_hand_frame(self) -> Float64:  # noqa: N802
        """Maps its coordinates to those of our hand frame.  # (4, 4)."""
        approach, closing = _AXES[self.approach], _AXES[self.closing]
        transform = np.eye(4)
        # Rows: our x, y and z axes in its coordinates.
        transform[:3, :3] = [np.cross(closing, approach), closing, approach]
        transform[2, 3] = self.origin_z
        return transform


CONTACT_GRASPNET = HandFrame(approach="z", closing="x")
"""Contact-GraspNet, 6-DOF GraspNet, ACRONYM: origin of `panda_hand`, x the closing direction."""

VGN = HandFrame(approach="z", closing="y", origin_z=0.062)
"""VGN's TCP with the Panda hand: 0.022 m ahead of the centre of mass, which lies at z = 0.04."""


def graspnet_frame(tip_z: float, depth: float = 0.02) -> HandFrame:
    """GraspNet-1Billion (graspnetAPI): x the approach, y the closing direction.

    Args:
        tip_z: Fingertips of the gripper, metres along our z (0.1122 for the Panda hand).
        depth: The grasp's `depth` there: metres from its origin to the fingertips.
    """
    return HandFrame(approach="x", closing="y", origin_z=tip_z - depth)


def to_frame(T_cloud_hand: ArrayLike, frame: HandFrame) -> Float64:
    """Poses of another frame on the hand.

    Args:
        T_cloud_hand: (..., 4, 4) poses of our hand frame.
        frame: The other frame.

    Returns:
        (..., 4, 4) T_cloud_frame.
    """
    return np.asarray(T_cloud_hand, dtype=np.float64) @ frame.T_hand_frame


def from_frame(T_cloud_frame: ArrayLike, frame: HandFrame) -> Float64:
    """Poses of our hand frame, from those of another frame on the hand.

    Args:
        T_cloud_frame: (..., 4, 4) poses of the other frame.
        frame: The other frame.

    Returns:
        (..., 4, 4) T_cloud_hand.
    """
    T_frame_hand = np.linalg.inv(frame.T_hand_frame)
    return np.asarray(T_cloud_frame, dtype=np.float64) @ T_frame_hand


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


def transform(rotation: Float64, position: ArrayLike) -> Float64:
    """The (4, 4) transform of a rotation and a position."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, position
    return result
