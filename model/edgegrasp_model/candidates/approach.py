"""Approach points, and the balls of points around them."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float32 = NDArray[np.float32]


def sample_approach_points(
    points: Float32,
    count: int,
    method: Literal["farthest", "uniform"],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Rows of `count` different points, or of all where there are fewer.

    Args:
        points: (N, 3).
        count: How many to choose.
        method: `farthest` spreads them over the cloud from a random start; `uniform` takes any.
        rng: Source of the random choice.

    Returns:
        (min(count, N),) rows of `points`.
    """
    count = min(count, len(points))
    if method == "uniform":
        return rng.choice(len(points), count, replace=False).astype(np.int64)
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = rng.integers(len(points))
    nearest = np.full(len(points), np.inf, dtype=np.float32)
    for i in range(1, count):
        nearest = np.minimum(nearest, ((points - points[chosen[i - 1]]) ** 2).sum(axis=1))
        chosen[i] = int(nearest.argmax())
    return chosen


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
