"""The small, clean cloud with normals, on a device; `edgegrasp_model.cloud` in tensors."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from edgegrasp_model.cloud import NORMAL_NEIGHBORS, OUTLIER_DEVIATIONS, OUTLIER_NEIGHBORS

PAIRS = 2**24  # distances held at a time


@dataclass(frozen=True)
class DeviceCloud:
    """Points and their unit normals, metres."""

    points: Tensor  # (N, 3) float32
    normals: Tensor  # (N, 3) float32


class DeviceVoxels(NamedTuple):
    """The occupied voxels of a cloud, ordered by place."""

    voxel: Tensor  # (N,) int64, voxel of each point
    size: Tensor  # (V,) int64, points in each

    def mean(self, values: Tensor) -> Tensor:
        """Mean (V, 3) float32 of a vector of each point (N, 3)."""
        sums = torch.zeros((len(self.size), 3), dtype=torch.float64, device=values.device)
        sums.index_add_(0, self.voxel, values.double())
        return (sums / self.size.unsqueeze(1)).float()

    def commonest(self, labels: Tensor, count: int) -> Tensor:
        """Commonest label (V,) in each voxel, of labels (N,) from 0 to count - 1."""
        tally = torch.zeros(len(self.size) * count, dtype=torch.int64, device=labels.device)
        tally.index_add_(0, self.voxel * count + labels, torch.ones_like(labels))
        return tally.view(-1, count).argmax(dim=1)


def voxelise(points: Tensor, voxel_size: float) -> DeviceVoxels:
    """Sort points (N, 3) float64 into voxels with edges of `voxel_size` metres."""
    cells = ((points - points.amin(dim=0)) / voxel_size).floor().long()  # (N, 3)
    sizes = cells.amax(dim=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    _, voxel, count = torch.unique(keys, return_inverse=True, return_counts=True)
    return DeviceVoxels(voxel, count)


def squared_distances(ones: Tensor, others: Tensor) -> Tensor:
    """Squared distances (..., A, B) float64 of points (..., A, 3) and (..., B, 3)."""
    total = ones.new_zeros((), dtype=torch.float64)
    for axis in range(3):
        one, other = ones[..., axis].double(), others[..., axis].double()
        total = total + (one.unsqueeze(-1) - other.unsqueeze(-2)).square()
    return total


def nearest(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k nearest of each point among all, itself first, by trying every pair.

    Args:
        points: (N, 3) metres.
        k: At most N.

    Returns:
        (N, k) float64 distances and (N, k) rows.
    """
    distances, rows = [], []
    for part in torch.split(points, max(1, PAIRS // len(points))):
        found = squared_distances(part, points).topk(k, largest=False)
        distances.append(found.values.sqrt())
        rows.append(found.indices)
    return torch.cat(distances), torch.cat(rows)


def inliers(points: Tensor) -> Tensor:
    """Which points (N,) are not far from their neighbours by the measure of the whole cloud."""
    if len(points) <= OUTLIER_NEIGHBORS:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    distances, _ = nearest(points, OUTLIER_NEIGHBORS + 1)
    mean = distances[:, 1:].mean(dim=1)
    return mean <= mean.mean() + OUTLIER_DEVIATIONS * mean.std(correction=0)


def estimate_normals(points: Tensor) -> Tensor:
    """Unit normals (N, 3) by principal components of each neighbourhood, of either sign."""
    _, rows = nearest(points, min(NORMAL_NEIGHBORS, len(points)))
    near = points[rows].double()  # (N, k, 3)
    near = near - near.mean(dim=1, keepdim=True)
    return least_directions(near.transpose(1, 2) @ near).float()


def least_directions(matrices: Tensor) -> Tensor:
    """Unit eigenvectors (N, 3) of the least eigenvalues of symmetric matrices (N, 3, 3), float64.

    In closed form: solvers for many small matrices are slow on a GPU.
    """
    scale = matrices.abs().amax(dim=(1, 2), keepdim=True).clamp_min(1e-300)
    scaled = matrices / scale
    middle = scaled.diagonal(dim1=1, dim2=2).mean(dim=1)  # (N,)
    unit = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    rest = scaled - middle[:, None, None] * unit
    spread = (rest.square().sum(dim=(1, 2)) / 6).sqrt().clamp_min(1e-150)
    a, b, c = rest.unbind(dim=1)
    determinant = (a * torch.linalg.cross(b, c)).sum(dim=1)
    angle = (determinant / (2 * spread**3)).clamp(-1.0, 1.0).acos() / 3
    least = 2 * spread * (angle + 2 * math.pi / 3).cos()  # of `rest`
    # What is left of rank two has rows that span the plane of the other two directions.
    a, b, c = (rest - least[:, None, None] * unit).unbind(dim=1)
    crossed = torch.stack(
        (torch.linalg.cross(a, b), torch.linalg.cross(b, c), torch.linalg.cross(c, a)), dim=1
    )  # (N, 3, 3)
    length = crossed.norm(dim=2)
    longest = length.argmax(dim=1)
    each = torch.arange(len(crossed), device=matrices.device)
    found, length = crossed[each, longest], length[each, longest].unsqueeze(1)
    return torch.where(length > 1e-30, found / length.clamp_min(1e-30), unit[0])


def orient_normals(points: Tensor, normals: Tensor, viewpoint: Tensor) -> Tensor:
    """Turn each normal to the side of its surface that the viewpoint, (3,) or (N, 3), sees."""
    away = (normals * (viewpoint - points)).sum(dim=1, keepdim=True) < 0
    return torch.where(away, -normals, normals)
