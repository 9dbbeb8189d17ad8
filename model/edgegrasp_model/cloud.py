"""Turn a raw point cloud into the small, clean cloud with normals that the network sees."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edgegrasp_model.errors import InvalidRequest

Float32 = NDArray[np.float32]

MAX_EXTENT = 20.0  # metres; a wider cloud is millimetres taken for metres
OUTLIER_NEIGHBORS = 8
OUTLIER_DEVIATIONS = 2.5
NORMAL_NEIGHBORS = 20


@dataclass(frozen=True)
class Cloud:
    """Points and their unit normals, metres."""

    points: Float32  # (N, 3)
    normals: Float32  # (N, 3)


def validate_cloud(cloud: object, num_approach_points: int = 1) -> Float32:
    """Check a caller's array and give it back as float32.

    Args:
        cloud: (N, 3) float32 or float64, metres.
        num_approach_points: How many of its points the caller wants as approach points.

    Returns:
        (N, 3) float32.

    Raises:
        InvalidRequest: Wrong type, dtype or shape, no points, NaN or infinity, an extent that
            suggests millimetres, or fewer points than approach points.
    """
    if not isinstance(cloud, np.ndarray):
        kind = type(cloud).__name__
        raise InvalidRequest("cloud", f"a {kind}", "Send an array of shape (N, 3) in metres.")
    if cloud.dtype not in (np.float32, np.float64):
        raise InvalidRequest("cloud", f"dtype {cloud.dtype}", "Send float32 or float64 metres.")
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise InvalidRequest("cloud", f"shape {cloud.shape}", "Send shape (N, 3): x, y, z a row.")
    if len(cloud) == 0:
        raise InvalidRequest("cloud", "no points", "Send at least num_approach_points points.")
    finite = np.isfinite(cloud).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise InvalidRequest(
            "cloud",
            f"{int((~finite).sum())} points with NaN or infinity, the first in row {bad}",
            "Remove points without a finite x, y, z.",
        )
    extent = float(np.ptp(cloud.astype(np.float64), axis=0).max())
    if extent > MAX_EXTENT:
        raise InvalidRequest(
            "cloud",
            f"an extent of {extent:.4g} m, which suggests millimetres",
            "Send metres: divide by 1000.",
        )
    if len(cloud) < num_approach_points:
        raise InvalidRequest(
            "cloud",
            f"{len(cloud)} points for num_approach_points = {num_approach_points}",
            "Send more points or lower options.num_approach_points.",
        )
    return np.ascontiguousarray(cloud, dtype=np.float32)


@dataclass(frozen=True)
class Voxels:
    """The occupied voxels of a cloud, ordered by place: the order of the points does not matter."""

    voxel: NDArray[np.int64]  # (N,) voxel of each point
    size: NDArray[np.int64]  # (V,) points in each

    def mean(self, values: NDArray[np.floating]) -> Float32:
        """Mean (V, 3) of a vector of each point (N, 3)."""
        sums = [np.bincount(self.voxel, values[:, axis], len(self.size)) for axis in range(3)]
        return (np.stack(sums, axis=1) / self.size[:, None]).astype(np.float32)

    def share(self, holds: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Share (V,) of each voxel's points for which something holds (N,)."""
        return np.bincount(self.voxel, holds, len(self.size)) / self.size

    def commonest(self, labels: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Commonest label (V,) in each voxel, of labels (N,) from 0 to count - 1."""
        tally = np.bincount(self.voxel * count + labels, minlength=count * len(self.size))
        best: NDArray[np.int64] = tally.reshape(-1, count).argmax(axis=1)
        return best


def voxelise(points: NDArray[np.floating], voxel_size: float) -> Voxels:
    """Sort points (N, 3) into voxels with edges of `voxel_size` metres."""
    low = points.min(axis=0).astype(np.float64)
    cells = np.floor((points - low) / voxel_size).astype(np.int64)  # (N, 3)
    sizes = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    _, voxel, count = np.unique(keys, return_inverse=True, return_counts=True)
    return Voxels(voxel, count)


def inliers(points: Float32) -> NDArray[np.bool_]:
    """Which points (N,) are not far from their neighbours by the measure of the whole cloud."""
    if len(points) <= OUTLIER_NEIGHBORS:
        return np.ones(len(points), dtype=bool)
    distances, _ = cKDTree(points).query(points, k=range(2, OUTLIER_NEIGHBORS + 2))
    mean = np.mean(distances, axis=1)
    kept: NDArray[np.bool_] = mean <= mean.mean() + OUTLIER_DEVIATIONS * mean.std()
    return kept


def estimate_normals(points: Float32) -> Float32:
    """Unit normals by principal components of each neighbourhood, of either sign.

    Args:
        points: (N, 3).

    Returns:
        (N, 3): the direction of least variance among the NORMAL_NEIGHBORS nearest points.
    """
    k = min(NORMAL_NEIGHBORS, len(points))
    _, rows = cKDTree(points).query(points, k=range(1, k + 1))
    columns = [column[rows].astype(np.float64) for column in points.T]  # x, y, z, (N, k) each
    columns = [column - column.mean(axis=1, keepdims=True) for column in columns]
    products = [[np.einsum("nk,nk->n", one, other) for other in columns] for one in columns]
    _, vectors = np.linalg.eigh(np.array(products).transpose(2, 0, 1))  # ascending variance
    return vectors[:, :, 0].astype(np.float32)


def orient_normals(points: Float32, normals: Float32, viewpoint: Float32) -> Float32:
    """Turn each normal to the side of its surface that the viewpoint, (3,) or (N, 3), sees."""
    away = np.einsum("nd,nd->n", normals, viewpoint - points) < 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)


def assumed_viewpoint(points: Float32, up: Float32) -> Float32:
    """A stand-in for an unknown camera: one metre above the cloud's middle."""
    middle: Float32 = (points.min(axis=0) + points.max(axis=0)) / 2
    return middle + up / np.linalg.norm(up)
