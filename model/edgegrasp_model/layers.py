"""Layers that both networks share."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch

# Products of fewer rows add up in an order that depends on how many there are.
MIN_ROWS = 32


def row_linear(values: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """F.linear of values (M, ..., C); in inference, no bit of a row depends on the other rows.

    So a request's scores are the same alone and in a batch, on a processor.
    """
    if torch.is_grad_enabled() or values.device.type != "cpu":
        return F.linear(values, weight, bias)
    if len(weight) == 1:  # a product with a vector, which has an order of its own for each size
        product = (values * weight[0]).sum(dim=-1, keepdim=True)
        return product if bias is None else product + bias
    if 0 < values.shape[:-1].numel() < MIN_ROWS:
        padded = values.new_zeros((MIN_ROWS, *values.shape[1:]))
        padded[: len(values)] = values
        return F.linear(padded, weight, bias)[: len(values)]
    return F.linear(values, weight, bias)


class RowLinear(nn.Linear):
    """A linear layer as `row_linear` computes it."""

    def forward(self, values: Tensor) -> Tensor:
        """Maps (M, ..., inputs) to (M, ..., outputs)."""
        return row_linear(values, self.weight, self.bias)


class SharedLinear(nn.Linear):
    """A linear layer on rows [own, shared[row]] that multiplies each shared part only once.

    Many ball points (or edge grasps) share one ball feature: W [a, b] = W_a a + W_b b.
    """

    def forward(self, own: Tensor, shared: Tensor, shared_of_row: Tensor) -> Tensor:  # type: ignore[override]
        """Applies the layer to own (M, ..., C1) and shared (B, ..., C2)[shared_of_row (M,)]."""
        widths = [own.shape[-1], shared.shape[-1]]
        own_weight, shared_weight = torch.split(self.weight, widths, dim=1)
        once_per_ball = row_linear(shared, shared_weight)  # (B, ..., out)
        rows = row_linear(own, own_weight, self.bias)  # (M, ..., out)
        rows += once_per_ball.index_select(0, shared_of_row)
        return rows


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with a ReLU between each two."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [RowLinear(inputs, outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def gather_rows(values: Tensor, index: Tensor) -> Tensor:
    """values[index] for values (M, ...) and an index (P, k): (P, k, ...)."""
    # The backward of indexing itself is several times slower.
    return values.index_select(0, index.flatten()).view(*index.shape, *values.shape[1:])


def in_pieces(values: Tensor) -> tuple[Tensor, ...]:
    """Splits values (M, ...) so that the neighbours of a piece fit the cache: twice as fast."""
    return torch.split(values, 256)


class BallPiece(NamedTuple):
    """The values of a few whole balls: p points in b balls."""

    values: Tensor  # (p, ...)
    ball_sizes: list[int]  # b of them
    ball_of_point: Tensor  # (p,) int64, 0..b-1


def ball_pieces(values: Tensor, batch: BallBatch) -> list[BallPiece]:
    """Splits values (P, ...) of a batch's points into balls so few that an MLP stays in cache."""
    sizes = batch.ball_sizes
    together = len(sizes) if torch.is_grad_enabled() else 2  # training keeps all of it anyway
    groups = [sizes[first : first + together] for first in range(0, len(sizes), together)]
    ends = [sum(group) for group in groups]
    values_of, ball_of = torch.split(values, ends), torch.split(batch.ball_of_point, ends)
    return [
        BallPiece(piece, group, ball - together * number)
        for number, (piece, group, ball) in enumerate(zip(values_of, groups, ball_of, strict=True))
    ]


def maximum(values: Tensor, dim: int) -> Tensor:
    """Maximum along a dimension."""
    # On a processor amax is some ten times faster forward, but its backward several times slower.
    return values.max(dim).values if torch.is_grad_enabled() else values.amax(dim)


def ball_maximum(values: Tensor, ball_sizes: list[int]) -> Tensor:
    """Maximum of values (P, C) over the points of each ball, in order: (B, C)."""
    return torch.stack([maximum(ball, dim=0) for ball in torch.split(values, ball_sizes)])
