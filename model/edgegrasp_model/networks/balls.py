"""The batch that the ball networks score: the neighbourhoods of the approach points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgegrasp_camera.arrays import Float32, Floats, Int64
from edgegrasp_model.candidates.edge_grasps import BallCrop, crop_balls
from edgegrasp_model.kernels import compiled
from edgegrasp_model.networks.config import NetworkConfig

ROUNDING = 1e-4  # share of a squared distance; a generous bound of float32 errors


@dataclass(frozen=True)
class BallBatch:
    """P points in `num_balls` balls of one cloud or several, E edge grasps; metres."""

    points: Tensor  # (P, 3) float32, centred on their own ball's approach point
    normals: Tensor  # (P, 3) float32
    neighbors: Tensor  # (P, k) int64, rows of `points` in the same ball, the own row included
    ball_of_point: Tensor  # (P,) int64, ascending, 0..num_balls-1, none of them empty
    num_balls: int
    contact: Tensor  # (E,) int64, rows of `points`: the contact point of each edge grasp
    approach: Tensor  # (E, 3) float32, outward approach direction u, unit length
    depth: Tensor  # (E,) float32, |r_perp|: contact below approach point along u

    @classmethod
    def from_cloud(
        cls,
        points: Float32,  # (N, 3)
        normals: Float32,  # (N, 3)
        approach_index: NDArray[np.integer],  # (A,)
        crop: BallCrop,
        contact: NDArray[np.integer],  # (E,)
        approach: Float32,  # (E, 3)
        depth: Float32,  # (E,)
        k: int = 16,  # neighbours of each point (paper, section IV)
    ) -> Self:
        """Pack a cloud and its balls; contacts are rows of the crop, as each belongs to a ball."""
        centred = points[crop.ball_rows] - points[approach_index][crop.ball_of_point]
        bounds = np.searchsorted(crop.ball_of_point, np.arange(len(approach_index) + 1))
        return cls(
            points=_float_tensor(centred),
            normals=_float_tensor(normals[crop.ball_rows]),
            neighbors=torch.from_numpy(nearest_in_groups(centred, bounds, k)),
            ball_of_point=torch.from_numpy(crop.ball_of_point),
            num_balls=len(approach_index),
            contact=torch.from_numpy(np.asarray(contact, dtype=np.int64)),
            approach=_float_tensor(approach),
            depth=_float_tensor(depth),
        )

    @staticmethod
    def concatenate(batches: Sequence["BallBatch"]) -> "BallBatch":
        """Join batches into one, as training does; scores come out in the same order."""
        first_point = np.cumsum([0, *(len(batch.points) for batch in batches)]).tolist()
        first_ball = np.cumsum([0, *(batch.num_balls for batch in batches)]).tolist()
        points = list(zip(batches, first_point, strict=False))  # with the row at which each begins
        balls = list(zip(batches, first_ball, strict=False))
        return BallBatch(
            points=torch.cat([batch.points for batch in batches]),
            normals=torch.cat([batch.normals for batch in batches]),
            neighbors=torch.cat([batch.neighbors + first for batch, first in points]),
            ball_of_point=torch.cat([batch.ball_of_point + first for batch, first in balls]),
            num_balls=first_ball[-1],
            contact=torch.cat([batch.contact + first for batch, first in points]),
            approach=torch.cat([batch.approach for batch in batches]),
            depth=torch.cat([batch.depth for batch in batches]),
        )

    @classmethod
    def made_up(cls, config: NetworkConfig) -> Self:
        """A fixed batch of 32 edge grasps, to check that a network still gives the same logits."""
        rng = np.random.default_rng(0)
        points = rng.uniform(-0.06, 0.06, (200, 3)).astype(np.float32)
        normals = rng.normal(size=(200, 3))
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        balls = np.array([0, 1])
        crop = crop_balls(points, balls, config.crop_radius)
        contact = rng.choice(len(crop.ball_rows), 32)
        return cls.from_cloud(
            points,
            normals.astype(np.float32),
            balls,
            crop,
            contact,
            approach=normals[:32].astype(np.float32),
            depth=rng.uniform(0.0, 0.04, 32).astype(np.float32),
            k=config.k,
        )

    @property
    def ball_of_edge(self) -> Tensor:
        """Ball (E,) int64 of each edge grasp."""
        return self.ball_of_point[self.contact]

    def to(self, device: torch.device | str) -> "BallBatch":
        """Moves every tensor to a device."""
        parts = vars(self).items()
        tensors: dict[str, Any] = {name: part for name, part in parts if isinstance(part, Tensor)}
        return replace(self, **{name: part.to(device) for name, part in tensors.items()})


def _float_tensor(array: Floats) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def nearest_in_groups(points: Float32, bounds: Int64, k: int) -> Int64:
    """Rows (P, k) of the k nearest points of the same group, the point itself first.

    Points are (P, 3), group after group, from bounds[g] to bounds[g + 1]; the own row fills up
    small groups.
    """
    nearest = np.empty((len(points), k), dtype=np.int64)
    if len(points):
        _nearest(np.ascontiguousarray(points.T, dtype=np.float32), bounds, nearest)
    return nearest


@compiled("contract")
def _nearest(columns: Float32, bounds: Int64, nearest: Int64) -> None:
    k = nearest.shape[1]
    largest = np.max(bounds[1:] - bounds[:-1])
    squared = np.empty(largest, np.float32)
    near = np.empty(largest, np.int64)
    best = np.empty(k, np.float64)
    for group in range(len(bounds) - 1):
        start, stop = bounds[group], bounds[group + 1]
        xs, ys, zs = columns[0, start:stop], columns[1, start:stop], columns[2, start:stop]
        best[:] = np.inf
        for i in range(len(xs)):
            px, py, pz = xs[i], ys[i], zs[i]
            # The k nearest of the previous row bound the distance to this row's k nearest.
            step = 0.0
            if i > 0:
                step = np.float64(px - xs[i - 1]) ** 2
                step += np.float64(py - ys[i - 1]) ** 2 + np.float64(pz - zs[i - 1]) ** 2
            limit = np.float32((np.sqrt(best[k - 1]) + np.sqrt(step)) ** 2 * (1.0 + ROUNDING))
            for j in range(len(xs)):
                x, y, z = xs[j] - px, ys[j] - py, zs[j] - pz
                squared[j] = x * x + y * y + z * z
            found = 0
            for j in range(len(xs)):
                near[found] = j
                found += squared[j] <= limit
            mine = nearest[start + i]
            mine[:] = start + i
            best[:] = np.inf
            for c in range(found):
                j = near[c]
                x = np.float64(xs[j]) - np.float64(px)
                y = np.float64(ys[j]) - np.float64(py)
                z = np.float64(zs[j]) - np.float64(pz)
                here = x * x + y * y + z * z
                if here < best[k - 1]:
                    place = k - 1
                    while place > 0 and best[place - 1] > here:
                        best[place], mine[place] = best[place - 1], mine[place - 1]
                        place -= 1
                    best[place], mine[place] = here, start + j
