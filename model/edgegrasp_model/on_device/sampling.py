"""Choose approach points on a device."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from edgegrasp_model.on_device.captured import Captured
from edgegrasp_model.on_device.padded_balls import bucket, filled


def sample_approach_points(
    points: Tensor,
    count: int,
    method: Literal["farthest", "uniform"],
    rng: np.random.Generator,
) -> Tensor:
    """Rows (min(count, N),) of points (N, 3), as `edgegrasp_model.sampling` chooses them."""
    count = min(count, len(points))
    if method == "uniform":
        chosen = rng.choice(len(points), count, replace=False).astype(np.int64)
        return torch.from_numpy(chosen).to(points.device)
    first = torch.full((count,), int(rng.integers(len(points))), device=points.device)
    size = bucket(len(points))
    apart = torch.full((size,), -torch.inf, device=points.device)  # what fills up is never far
    apart[: len(points)] = torch.inf
    return _farthest(filled(points, size), apart, first)


def _spread(points: Tensor, nearest: Tensor, chosen: Tensor) -> Tensor:
    """Rows that each lie farthest from those before; `chosen` (A,) holds the first of them."""
    chosen = chosen.clone()
    for place in range(1, len(chosen)):
        squared = (points - points[chosen[place - 1 : place]]).square()  # (N, 3)
        nearest = torch.minimum(nearest, squared[:, 0] + squared[:, 1] + squared[:, 2])
        chosen[place] = nearest.argmax()
    return chosen


_farthest = Captured(_spread)
