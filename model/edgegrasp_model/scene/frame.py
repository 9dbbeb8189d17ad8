"""The canonical frame: a request's computations run in it, whatever frame the cloud came in."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MIN_HORIZONTAL = 1e-3  # metres; a shorter horizontal offset points nowhere


@dataclass(frozen=True)
class CanonicalFrame:
    """z along up, x horizontally toward the camera, the origin at the points' mean."""

    T_canonical_cloud: Float64  # (4, 4)

    @classmethod
    def of_scene(cls, points: Float32, up: ArrayLike, viewpoint: ArrayLike | None) -> Self:
        """Fix the frame to the scene: it turns and moves with the scene.

        Args:
            points: (N, 3) metres.
            up: (3,) of any length but zero.
            viewpoint: (3,) the camera. Where there is none, or it is straight above, x points to
                the furthest point instead.
        """
        origin = points.mean(axis=0, dtype=np.float64)
        z = np.asarray(up, dtype=np.float64)
        z = z / np.linalg.norm(z)
        x = None if viewpoint is None else _furthest_out(np.asarray([viewpoint]) - origin, z)
        x = _furthest_out(points - origin, z) if x is None else x
        x = _furthest_out(np.eye(3), z) if x is None else x
        assert x is not None
        T_canonical_cloud = np.eye(4)
        T_canonical_cloud[:3, :3] = np.stack([x, np.cross(z, x), z])
        T_canonical_cloud[:3, 3] = -T_canonical_cloud[:3, :3] @ origin
        return cls(T_canonical_cloud)

    def points(self, points: ArrayLike) -> Float64:
        """Points (..., 3) of the cloud's frame in this one."""
        turned: Float64 = np.asarray(points, dtype=np.float64) @ self._turn.T
        return turned + self.T_canonical_cloud[:3, 3]

    def directions(self, directions: ArrayLike) -> Float64:
        """Directions (..., 3) of the cloud's frame in this one."""
        turned: Float64 = np.asarray(directions, dtype=np.float64) @ self._turn.T
        return turned

    def poses(self, T_cloud_hand: ArrayLike) -> Float32:
        """Poses (..., 4, 4) in the cloud's frame, in this one."""
        return (self.T_canonical_cloud @ np.asarray(T_cloud_hand, np.float64)).astype(np.float32)

    def points_in_cloud(self, points: ArrayLike) -> Float32:
        """Points (..., 3) of this frame in the cloud's."""
        shifted = np.asarray(points, dtype=np.float64) - self.T_canonical_cloud[:3, 3]
        return (shifted @ self._turn).astype(np.float32)

    def directions_in_cloud(self, directions: ArrayLike) -> Float32:
        """Directions (..., 3) of this frame in the cloud's."""
        return (np.asarray(directions, dtype=np.float64) @ self._turn).astype(np.float32)

    def poses_in_cloud(self, T_canonical_hand: ArrayLike) -> Float32:
        """Poses (..., 4, 4) in this frame, in the cloud's."""
        T_cloud_canonical = np.linalg.inv(self.T_canonical_cloud)
        return (T_cloud_canonical @ np.asarray(T_canonical_hand, np.float64)).astype(np.float32)

    @property
    def _turn(self) -> Float64:
        return self.T_canonical_cloud[:3, :3]


def _furthest_out(offsets: Float64, z: Float64) -> Float64 | None:
    """Horizontal direction (3,) of the offset that is the longest seen from above, if any is."""
    horizontal = offsets - (offsets @ z)[:, None] * z
    length = np.linalg.norm(horizontal, axis=1)
    longest = int(length.argmax())
    if length[longest] < MIN_HORIZONTAL:
        return None
    direction: Float64 = horizontal[longest] / length[longest]
    return direction
