"""A ball batch filled up to one of few shapes, so that work prepared for a shape serves many."""

from typing import NamedTuple

import torch
from torch import Tensor

from edgegrasp_model.ball_batch import BallBatch

# Sizes from one power of two to the next. Points are nine tenths of the work: at most an eighth of
# them is filling. Of the rest there are few sizes, so that few graphs serve all requests.
POINT_STEPS, STEPS = 8, 1
PIECE = 2**15  # points whose edge features are in memory at once, several gigabytes of them


class PaddedBalls(NamedTuple):
    """P points in B balls of at most M, E edge grasps; what fills them up counts for nothing."""

    points: Tensor  # (P, 3) float32, centred on their own ball's approach point
    normals: Tensor  # (P, 3) float32
    neighbors: Tensor  # (P, k) int64, rows of `points` in the same ball
    ball_of_point: Tensor  # (P,) int64
    members: Tensor  # (B, M) int64, rows of `points`; a ball's last one again after its last
    contact: Tensor  # (E,) int64, rows of `points`
    ball_of_edge: Tensor  # (E,) int64
    approach: Tensor  # (E, 3) float32
    depth: Tensor  # (E,) float32


def bucket(size: int, steps: int = STEPS) -> int:
    """The next size, at least 8: a power of two, or one of `steps` even steps to the next."""
    power = max(3, (max(size, 1) - 1).bit_length())  # 2 ** power >= size
    step = max(1, (1 << power - 1) // steps)
    return max(8, -(-size // step) * step)


def padded_balls(batch: BallBatch) -> PaddedBalls:
    """Fill a batch up, on its device.

    Args:
        batch: At least one point and one edge grasp.
    """
    device = batch.points.device
    sizes = torch.zeros(batch.num_balls, dtype=torch.int64, device=device)
    sizes.index_add_(0, batch.ball_of_point, torch.ones_like(batch.ball_of_point))
    largest = bucket(int(sizes.max()))
    points, balls = bucket(len(batch.points), POINT_STEPS), bucket(batch.num_balls)
    place = torch.arange(largest, device=device)
    last = sizes.cumsum(0) - 1
    members = torch.minimum((last + 1 - sizes).unsqueeze(1) + place, last.unsqueeze(1))
    neighbors = torch.arange(points, device=device).unsqueeze(1).repeat(1, batch.neighbors.shape[1])
    neighbors[: len(batch.neighbors)] = batch.neighbors
    edges = bucket(len(batch.contact))
    return PaddedBalls(
        points=filled(batch.points, points),
        normals=filled(batch.normals, points),
        neighbors=neighbors,
        ball_of_point=filled(batch.ball_of_point, points),
        members=filled(members, balls),
        contact=filled(batch.contact, edges),
        ball_of_edge=filled(batch.ball_of_edge, edges),
        approach=filled(batch.approach, edges),
        depth=filled(batch.depth, edges),
    )


def in_pieces(values: Tensor) -> tuple[Tensor, ...]:
    """Rows (n, ...) in pieces so large that they fill a GPU and so small that they fit one."""
    return torch.split(values, PIECE)


def filled(values: Tensor, size: int) -> Tensor:
    """Rows (n, ...) and zeros after them: (size, ...)."""
    result = values.new_zeros((size, *values.shape[1:]))
    result[: len(values)] = values
    return result
