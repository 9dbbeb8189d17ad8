"""What a camera could not see: space behind the surfaces that it saw.

A hand that goes where nobody looked may hit what is there. A cloud does not show that; the cloud
and the camera's position do.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.options import Corner

Float32 = NDArray[np.float32]

CELL = 0.0022  # metres across a cell of the depth map, at the middle of the cloud
SPLAT = 2  # cells around its own that a point covers: as far as the next point of the cloud
BEHIND = 0.004  # metres behind a surface that may still be the surface
DEEP = 0.02  # metres further behind at which space counts as wholly unknown
NOTHING = np.float32(np.inf)
STEEP = 1e-3  # sine of the angle to up below which up says nothing about the map
HALF = 256  # most cells from the middle of the map to its edge: some 0.5 m
FARTHEST = 10 * HALF  # stands for everything farther away


def occlusion_fractions(
    points: Float32,
    T_cloud_hand: Float32,
    viewpoint: Float32 | None,
    up: Float32,
    gripper: Gripper,
) -> list[Float32]:
    """The fraction of each part of a hand, and of the space around it, that the camera did not see.

    Args:
        points: (N, 3) of the cloud.
        T_cloud_hand: (E, 4, 4).
        viewpoint: (3,) the only camera; None where it is unknown: then all counts as seen.
        up: (3,) away from gravity.
        gripper: Fingers open to its maximum.

    Returns:
        For each of the parts of `probes` the mean (E,) of what `DepthMap.hidden` says of it.
    """
    parts = probes(gripper)
    if viewpoint is None or len(points) == 0:
        return [np.zeros(len(T_cloud_hand), dtype=np.float32)] * len(parts)
    depth = DepthMap.of_cloud(points, viewpoint, up)
    turn, shift = T_cloud_hand[:, :3, :3], T_cloud_hand[:, None, :3, 3]
    hidden = depth.hidden(np.concatenate(parts) @ turn.transpose(0, 2, 1) + shift)  # (E, S)
    ends = np.cumsum([len(part) for part in parts])[:-1]
    return [part.mean(axis=1) for part in np.split(hidden, ends, axis=1)]


def probes(gripper: Gripper) -> list[Float32]:
    """Points of each part of the open hand, and of the space around it; hand frame, metres.

    Tips and roots of both fingers, what is beyond each of them, the space between the fingers in
    three layers, and the hand itself: each (S, 3).
    """
    half, inner = gripper.pad_half_width, gripper.max_opening / 2
    tip, palm = gripper.tip_z, gripper.palm_z
    thick = max(high[1] for _, high in gripper.finger_boxes) / 2
    middle, x = (tip + palm) / 2, [-0.7 * half, 0.7 * half]
    fingers = [
        _grid(x, side * (inner + np.array([0.3, 1.4]) * thick), np.linspace(low, high, 4)[1:])
        for low, high in ((middle, tip), (palm, middle))
        for side in (1.0, -1.0)
    ]
    beyond = [
        _grid([0.0], [side * (inner + thick)], [tip + 0.006, tip + 0.012]) for side in (1.0, -1.0)
    ]
    between = [
        _grid(x, inner * np.array(layer), np.linspace(palm, tip, 5)[1:])
        for layer in ([0.5, 0.85], [-0.25, 0.25], [-0.85, -0.5])
    ]
    inside = [
        _grid(*(np.linspace(*ends)[1:-1] for ends in _spans(box))) for box in gripper.hand_boxes
    ]
    return [*fingers, *beyond, *between, np.concatenate(inside)]


def _spans(box: tuple[Corner, Corner]) -> list[tuple[float, float, int]]:
    """Along each axis the ends of a box, and how many points to take from one to the other."""
    return list(zip(*box, (4, 7, 4), strict=True))


def _grid(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Float32:
    """All points with these coordinates.  # (X * Y * Z, 3)."""
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid.astype(np.float32)


class CameraFrame(NamedTuple):
    """How a camera looks at a cloud: what directions the cells of its depth map stand for."""

    viewpoint: Float32  # (3,)
    axes: Float32  # (3, 3) rows: across, down, toward the middle of the cloud
    cell: float  # tangent of the angle of a cell

    @classmethod
    def toward(cls, middle: ArrayLike, viewpoint: ArrayLike, up: ArrayLike) -> Self:
        """A camera that looks at the middle (3,) of a cloud; `up` (3,) turns with the scene."""
        way = np.asarray(middle, dtype=np.float64) - np.asarray(viewpoint, dtype=np.float64)
        distance = max(float(np.linalg.norm(way)), 1e-6)
        ahead = way / distance
        across = np.cross(ahead, np.asarray(up, dtype=np.float64))
        if np.linalg.norm(across) < STEEP * np.linalg.norm(up):  # seen from straight above
            across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(ahead, across), ahead]).astype(np.float32)
        return cls(np.asarray(viewpoint, dtype=np.float32), axes, CELL / distance)

    def seen(self, positions: Float32) -> tuple[NDArray[np.int64], Float32]:
        """The cells (N, 2) that positions (N, 3) lie in, the middle one 0, and how far they are."""
        along = (positions - self.viewpoint) @ self.axes.T  # (N, 3)
        tangents = along[:, :2] / np.maximum(along[:, 2:], np.float32(1e-6))
        cell = np.clip(np.floor(tangents / np.float32(self.cell)), -FARTHEST, FARTHEST)
        return cell.astype(np.int64), np.linalg.norm(along, axis=1).astype(np.float32)


@dataclass(frozen=True)
class DepthMap:
    """Distance of the first surface in each direction from a camera."""

    frame: CameraFrame
    distance: Float32  # (2 H + 1, 2 H + 1) metres from the camera; inf where nothing was seen

    @classmethod
    def of_cloud(cls, points: Float32, viewpoint: Float32, up: Float32) -> Self:
        """What a camera there saw of a cloud.

        Args:
            points: (N, 3), at least one, metres.
            viewpoint: (3,) in the same frame.
            up: (3,) turns the map, so that it turns with the scene.
        """
        frame = CameraFrame.toward(points.mean(axis=0, dtype=np.float64), viewpoint, up)
        cell, distance = frame.seen(points)
        half = min(int(np.abs(cell).max()) + SPLAT, HALF)
        depth = np.full((2 * half + 1, 2 * half + 1), NOTHING)
        order = np.argsort(-distance, kind="stable")  # the nearest is written last
        cell, distance = cell[order] + half, distance[order]
        for shift in np.ndindex(2 * SPLAT + 1, 2 * SPLAT + 1):
            place = cell + np.asarray(shift) - SPLAT
            inside = ((place >= 0) & (place <= 2 * half)).all(axis=1)
            nearest = np.full_like(depth, NOTHING)
            nearest[tuple(place[inside].T)] = distance[inside]
            np.minimum(depth, nearest, out=depth)
        return cls(frame, depth)

    def hidden(self, positions: Float32) -> Float32:
        """How far positions (..., 3) lie in space that the camera did not see: 0 seen, 1 deep."""
        half = len(self.distance) // 2
        cell, distance = self.frame.seen(positions.reshape(-1, 3))
        inside: NDArray[np.bool_] = np.abs(cell).max(axis=1) <= half
        i, j = np.where(inside, cell.T + half, 0)
        surface = np.where(inside, self.distance[i, j], NOTHING)
        deep: Float32 = np.clip((distance - surface - BEHIND) / DEEP, 0.0, 1.0)
        return deep.astype(np.float32).reshape(positions.shape[:-1])
