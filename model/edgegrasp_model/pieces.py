"""Rows in pieces that fit the processor's cache, and the maximum over each ball of points."""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from edgegrasp_model.ball_batch import BallBatch

ROWS = 512  # points at a time: 1,024 channels of them stay in cache
CONVOLVED = 128  # points at a time in a graph convolution, each with its neighbours
EDGE_ROWS = 256  # edge grasps at a time


class BallPiece(NamedTuple):
    """p points of a few balls, one of which may go on in the next piece."""

    values: Tensor  # (p, ...)
    ball_of_point: Tensor  # (p,) int64
    balls: list[int]
    sizes: list[int]  # rows of each of these balls, in order, then of what fills the piece up


def ball_pieces(values: Tensor, batch: BallBatch, rows: int = ROWS) -> list[BallPiece]:
    """Splits values (P, ...) of a batch's points into pieces of `rows`, the last one filled up.

    To record gradients, which keeps all of them anyway, and off the processor: one piece.
    """
    ball_of_point, sizes = batch.ball_of_point, batch.ball_sizes
    if torch.is_grad_enabled() or values.device.type != "cpu":
        return [BallPiece(values, ball_of_point, list(range(len(sizes))), sizes)]
    ends = torch.tensor(sizes).cumsum(0).tolist()
    pieces = []
    ball, start = 0, 0
    for number, (part, ball_of_row) in enumerate(in_pieces(rows, values, ball_of_point)):
        end = (number + 1) * rows
        balls, sizes = [], []
        while ball < len(ends) and start < end:
            stop = min(ends[ball], end)
            balls.append(ball)
            sizes.append(stop - start)
            start = stop
            ball += stop == ends[ball]
        pieces.append(BallPiece(part, ball_of_row, balls, [*sizes, end - start]))
    return pieces


def in_pieces(rows: int, *values: Tensor) -> list[tuple[Tensor, ...]]:
    """Splits values (M, ...) of equal length into pieces of `rows`.

    In inference the last one is filled up with zeros. Off the processor it is one piece.
    """
    if values[0].device.type != "cpu":
        return [values]
    pieces = list(zip(*(torch.split(each, rows) for each in values), strict=True))
    missing = rows - len(pieces[-1][0])
    if missing and not torch.is_grad_enabled():
        pieces[-1] = tuple(
            F.pad(part, (0, 0) * (part.dim() - 1) + (0, missing)) for part in pieces[-1]
        )
    return pieces


def by_pieces(layer: Callable[[Tensor], Tensor], values: Tensor, rows: int = ROWS) -> Tensor:
    """A layer that maps the rows of values (M, ...) one by one."""
    parts = [layer(part) for (part,) in in_pieces(rows, values)]
    return torch.cat(parts)[: len(values)]


class BallMaximum:
    """Maximum over the points of each ball, piece by piece."""

    def __init__(self, num_balls: int) -> None:
        self._parts: list[list[Tensor]] = [[] for _ in range(num_balls)]

    def add(self, values: Tensor, piece: BallPiece) -> None:
        """Take in the values (p, C) of a piece's points."""
        for ball, part in zip(piece.balls, torch.split(values, piece.sizes), strict=False):
            self._parts[ball].append(maximum(part, dim=0))

    def result(self) -> Tensor:
        """The maximum (B, C) of each ball."""
        return torch.stack([maximum(torch.stack(parts), dim=0) for parts in self._parts])


def maximum(values: Tensor, dim: int) -> Tensor:
    """Maximum along a dimension."""
    # On a processor amax is some ten times faster forward, but its backward several times slower.
    return values.max(dim).values if torch.is_grad_enabled() else values.amax(dim)
