"""Choose approach points."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
