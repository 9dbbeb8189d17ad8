"""Balls: the neighbourhoods of the approach points, cropped and packed for the networks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from edgegrasp_model.compiled import point_kernels


class BallCrop(NamedTuple):
    """Balls as rows of their cloud. P ball points in all, ball after ball."""

    ball_rows: NDArray[np.int64]  # (P,) rows of the cloud, ascending within each ball
    ball_of_point: NDArray[np.int64]  # (P,) ascending, 0..A-1
    radius: float  # metres


def crop_balls(
    points: NDArray[np.float32],  # (N, 3)
    approach_index: NDArray[np.integer],  # (A,)
    radius: float,
) -> BallCrop:
    """Crops a ball around each approach point.

    A cloud point within two balls counts twice, once for each.

    Args:
        points: The cloud (N, 3), metres, any frame.
        approach_index: Rows (A,) of `points`; one ball each, in this order.
        radius: Ball radius, metres.

    Source: paper section (the ball of radius G_w / 2).
    """
    approach_index = np.asarray(approach_index, dtype=np.int64)
    members = cKDTree(points).query_ball_point(points[approach_index], radius, return_sorted=True)
    ball_of_point = np.repeat(np.arange(len(members)), [len(rows) for rows in members])
    ball_rows = np.concatenate([np.empty(0), *members]).astype(np.int64)
    return BallCrop(ball_rows, ball_of_point, radius)


def nearest_in_ball(
    points: NDArray[np.float32],  # (N, 3)
    approach_index: NDArray[np.integer],  # (A,)
    crop: BallCrop,
    k: int = 16,
) -> NDArray[np.int64]:
    """Joins the points of balls to their k nearest in the same ball.

    The point itself is one of its k neighbours; where a ball holds fewer than k points, the own
    row fills the rest, which changes no maximum over neighbours.

    Args:
        points: The cloud (N, 3), metres.
        approach_index: Rows (A,) of `points`, as given to `crop_balls`.
        crop: P ball points.
        k: Neighbours per point, itself included.

    Returns:
        (P, k) rows of `crop.ball_rows`, nearest (the point itself) first.

    Source: paper section IV (its PointNet++ graph of 16 nearest).
    """
    centre = points[np.asarray(approach_index, dtype=np.int64)[crop.ball_of_point]]
    centred = points[crop.ball_rows] - centre
    kernels = point_kernels()
    if kernels is not None and centred.dtype == np.float32:
        bounds = np.searchsorted(crop.ball_of_point, np.arange(len(approach_index) + 1))
        nearest: NDArray[np.int64] = kernels.nearest_in_groups(centred, bounds, k)
        return nearest
    # One search for all balls: a fourth coordinate keeps them further apart than any is wide.
    lifted = np.column_stack((centred, crop.ball_of_point * (8.0 * crop.radius)))
    if len(lifted) == 0:
        return np.empty((0, k), dtype=np.int64)
    _, neighbors = cKDTree(lifted).query(
        lifted, k=range(1, k + 1), distance_upper_bound=4 * crop.radius
    )
    own_row = np.arange(len(lifted))[:, None]
    return np.where(neighbors == len(lifted), own_row, neighbors).astype(np.int64)


@dataclass(frozen=True)
class BallBatch:
    """Everything a network needs to score the edge grasps of one cloud, or of several.

    P ball points in `num_balls` balls, E edge grasps. Metres; every ball in the axes of its cloud.
    """

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
        points: NDArray[np.float32],  # (N, 3)
        normals: NDArray[np.float32],  # (N, 3)
        approach_index: NDArray[np.integer],  # (A,)
        crop: BallCrop,
        contact: NDArray[np.integer],  # (E,)
        approach: NDArray[np.float32],  # (E, 3)
        depth: NDArray[np.float32],  # (E,)
        k: int = 16,
    ) -> Self:
        """Packs a cloud and its balls.

        Args:
            points: The cloud (N, 3), metres.
            normals: Its normals (N, 3).
            approach_index: Rows (A,) of `points`, as given to `crop_balls`.
            crop: The balls.
            contact: Rows (E,) of `crop.ball_rows`, not of the cloud: a contact has a ball.
            approach: Outward approach directions (E, 3), unit length.
            depth: Depths (E,), metres.
            k: Neighbours per point, itself included.
        """
        centre = points[approach_index][crop.ball_of_point]
        return cls(
            points=_float_tensor(points[crop.ball_rows] - centre),
            normals=_float_tensor(normals[crop.ball_rows]),
            neighbors=torch.from_numpy(nearest_in_ball(points, approach_index, crop, k)),
            ball_of_point=torch.from_numpy(crop.ball_of_point),
            num_balls=len(approach_index),
            contact=torch.from_numpy(np.asarray(contact, dtype=np.int64)),
            approach=_float_tensor(approach),
            depth=_float_tensor(depth),
        )

    @staticmethod
    def concatenate(batches: Sequence["BallBatch"]) -> "BallBatch":
        """Joins batches into one; scores come out in the same order.

        Raises:
            ValueError: No batch.
        """
        if not batches:
            raise ValueError("batches: got none. Give at least one BallBatch.")
        first_point = np.cumsum([0] + [len(batch.points) for batch in batches]).tolist()
        first_ball = np.cumsum([0] + [batch.num_balls for batch in batches]).tolist()
        return BallBatch(
            points=torch.cat([batch.points for batch in batches]),
            normals=torch.cat([batch.normals for batch in batches]),
            neighbors=torch.cat(
                [b.neighbors + first for b, first in zip(batches, first_point, strict=False)]
            ),
            ball_of_point=torch.cat(
                [b.ball_of_point + first for b, first in zip(batches, first_ball, strict=False)]
            ),
            num_balls=first_ball[-1],
            contact=torch.cat(
                [b.contact + first for b, first in zip(batches, first_point, strict=False)]
            ),
            approach=torch.cat([batch.approach for batch in batches]),
            depth=torch.cat([batch.depth for batch in batches]),
        )

    @property
    def ball_of_edge(self) -> Tensor:
        """Ball (E,) int64 of each edge grasp."""
        return self.ball_of_point[self.contact]

    @property
    def ball_sizes(self) -> list[int]:
        """Number of points of each ball, in order."""
        sizes: list[int] = torch.bincount(self.ball_of_point, minlength=self.num_balls).tolist()
        return sizes

    def to(self, device: torch.device | str) -> "BallBatch":
        """Moves every tensor to a device."""
        return BallBatch(
            points=self.points.to(device),
            normals=self.normals.to(device),
            neighbors=self.neighbors.to(device),
            ball_of_point=self.ball_of_point.to(device),
            num_balls=self.num_balls,
            contact=self.contact.to(device),
            approach=self.approach.to(device),
            depth=self.depth.to(device),
        )


def _float_tensor(array: NDArray[np.floating]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
