"""Surfaces of a depth image, resampled: as dense where they are seen aslant as face to face.

The pixels of an image lie the further apart on a surface the more aslant it is seen. Volumes of
signed distances, from which the reference system takes its clouds, have no such thinning: wherever
the distance changes its sign between two neighbours of a grid, there is one point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edgegrasp_sim.camera import Intrinsics
    from edgegrasp_sim.poses import Matrix

    Float32 = NDArray[np.float32]
    Float64 = NDArray[np.float64]

TRUNCATION = 4  # voxels; distances beyond are those of no surface
_NEAR = 0.98  # of the truncation, within which a distance counts as one to a surface


def resample_surfaces(
    depth: Float64, T_world_camera: Matrix, intrinsics: Intrinsics, box: Matrix, voxel: float
) -> Float64:
    """Points where the signed distance along the line of sight changes its sign.

    Args:
        depth: (height, width) metres along the line of sight.
        T_world_camera: (4, 4) pose of the camera.
        intrinsics: of the camera.
        box: (2, 3) lowest and highest corner of the grid, world frame, metres.
        voxel: edge of the grid's cells, metres.

    Returns:
        (N, 3) metres, world frame, ordered by axis and cell.
    """
    first = np.floor(box[0] / voxel).astype(int)
    shape = np.ceil(box[1] / voxel).astype(int) - first + 1
    axes = [((first[k] + np.arange(shape[k]) + 0.5) * voxel).astype(np.float32) for k in range(3)]
    distance = _distances(depth, T_world_camera, intrinsics, axes, TRUNCATION * voxel)
    points = []
    for axis in range(3):
        here = np.moveaxis(distance, axis, 0)[:-1]
        there = np.moveaxis(distance, axis, 0)[1:]
        # NaN, the distance of what no surface is near to, compares as false.
        crossed = np.moveaxis(here * there < 0, 0, axis)
        cell = np.nonzero(crossed)
        start = distance[cell]
        end = distance[tuple(index + (k == axis) for k, index in enumerate(cell))]
        place = np.stack([axes[k][index] for k, index in enumerate(cell)], axis=1)
        place[:, axis] += voxel * start / (start - end)
        points.append(place)
    return np.concatenate(points)


def _distances(
    depth: Float64,
    T_world_camera: Matrix,
    intrinsics: Intrinsics,
    axes: list[Float32],
    truncation: float,
) -> Float32:
    """Signed distance at each point of a grid, positive before a surface, NaN far from any.

    It is that along the line of sight through the point, to what the nearest pixel shows.
    """
    k, T_camera_world = intrinsics, np.linalg.inv(T_world_camera).astype(np.float32)
    x, y, z = (_along(T_camera_world[row], axes) for row in range(3))
    x /= z
    y /= z
    # The renderer samples a pixel at its lower left corner.
    column = np.rint(x * k.focal_length + k.centre_x).astype(np.int32)
    row = np.rint(y * k.focal_length + k.centre_y - 1.0).astype(np.int32)
    height, width = depth.shape
    outside = (column < 0) | (column >= width) | (row < 0) | (row >= height)
    column[outside] = row[outside] = 0
    distance: Float32 = depth.astype(np.float32)[row, column] - z
    distance *= np.sqrt(1.0 + x * x + y * y)
    distance[outside | (np.abs(distance) > _NEAR * truncation)] = np.nan
    return distance


def _along(row: Float32, axes: list[Float32]) -> Float32:
    """One coordinate, in another frame, of every point of a grid.

    Args:
        row: (4,) of the transform into that frame.
        axes: the grid's coordinates along each of its axes.
    """
    first, second, third = (row[axis] * values for axis, values in enumerate(axes))
    whole: Float32 = first[:, None, None] + second[:, None] + third + row[3]
    return whole
