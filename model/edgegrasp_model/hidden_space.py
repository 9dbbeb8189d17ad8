"""What a camera could not see: space behind the surfaces that it saw.

A hand that goes where nobody looked may hit what is there. A cloud does not show that; the cloud
and the camera's position do.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

CELL = 0.0022  # metres across a cell of the depth map, at the middle of the cloud
SPLAT = 2  # cells around its own that a point covers: as far as the next point of the cloud
BEHIND = 0.004  # metres behind a surface that may still be the surface
DEEP = 0.02  # metres further on from which space is wholly unknown
NOTHING = np.float32(np.inf)
WIDEST = 1.2  # tangent of the angle from the middle of the cloud that the map reaches to


@dataclass(frozen=True)
class DepthMap:
    """Distance of the first surface in each direction from a camera."""

    viewpoint: Float32  # (3,)
    axes: Float32  # (3, 3) rows: across, down, toward the middle of the cloud
    cell: float  # tangent of a cell's angle
    distance: Float32  # (H, W) metres from the camera; inf where nothing was seen

    @classmethod
    def of_cloud(cls, points: Float32, viewpoint: Float32) -> Self:
        """What a camera there saw of a cloud.

        Args:
            points: (N, 3), at least one, metres.
            viewpoint: (3,) in the same frame.
        """
        toward = points.mean(axis=0) - viewpoint
        middle = max(float(np.linalg.norm(toward)), 1e-6)
        ahead = toward / middle
        across = np.cross(ahead, np.eye(3, dtype=np.float32)[np.argmin(np.abs(ahead))])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(ahead, across), ahead]).astype(np.float32)
        cell = CELL / middle
        place, distance = _seen_at(points, viewpoint, axes)
        reach = min(float(np.abs(place).max(initial=0.0)), WIDEST)
        half = int(reach / cell) + SPLAT + 1
        depth = np.full((2 * half + 1, 2 * half + 1), NOTHING)
        order = np.argsort(-distance, kind="stable")  # the nearest is written last
        row = np.floor(place[order] / cell).astype(np.int64) + half  # (N, 2)
        for shift in np.ndindex(2 * SPLAT + 1, 2 * SPLAT + 1):
            i, j = (row + np.asarray(shift) - SPLAT).T
            inside = (i >= 0) & (j >= 0) & (i < len(depth)) & (j < len(depth))
            i, j, far = i[inside], j[inside], distance[order][inside]
            nearest = np.full_like(depth, NOTHING)
            nearest[i, j] = far
            np.minimum(depth, nearest, out=depth)
        return cls(np.asarray(viewpoint, dtype=np.float32), axes, cell, depth)

    def hidden(self, positions: Float32) -> Float32:
        """How far positions (..., 3) lie in space that the camera did not see: 0 seen, 1 deep."""
        flat = positions.reshape(-1, 3)
        place, distance = _seen_at(flat, self.viewpoint, self.axes)
        half = len(self.distance) // 2
        i, j = (np.clip(np.floor(place / self.cell), -half - 1, half + 1).astype(np.int64) + half).T
        outside = (i < 0) | (j < 0) | (i > 2 * half) | (j > 2 * half)
        surface = self.distance[np.where(outside, 0, i), np.where(outside, 0, j)]
        surface = np.where(outside, NOTHING, surface)
        deep = np.clip((distance - surface - BEHIND) / DEEP, 0.0, 1.0).astype(np.float32)
        return deep.reshape(positions.shape[:-1])


def _seen_at(positions: Float32, viewpoint: Float32, axes: Float32) -> tuple[Float32, Float32]:
    """Tangents (N, 2) of the angles at which a camera sees positions, and their distance (N,)."""
    seen = (positions - viewpoint) @ axes.T  # (N, 3)
    ahead = np.maximum(seen[:, 2:], 1e-6)
    return seen[:, :2] / ahead, np.linalg.norm(seen, axis=1)
