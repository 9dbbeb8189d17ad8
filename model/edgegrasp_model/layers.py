"""Layers that both networks share."""

from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch


class SharedLinear(nn.Linear):
    """A linear layer on rows [own, shared[row]] that multiplies each shared part only once.

    Many ball points (or edge grasps) share one ball feature: W [a, b] = W_a a + W_b b.
    """

    def forward(self, own: Tensor, shared: Tensor, shared_of_row: Tensor) -> Tensor:  # type: ignore[override]
        """Applies the layer to own (M, ..., C1) and shared (B, ..., C2)[shared_of_row (M,)]."""
        widths = [own.shape[-1], shared.shape[-1]]
        own_weight, shared_weight = torch.split(self.weight, widths, dim=1)
        once_per_ball = F.linear(shared, shared_weight)  # (B, ..., out)
        rows = F.linear(own, own_weight, self.bias)  # (M, ..., out)
        rows += once_per_ball.index_select(0, shared_of_row)
        return rows


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with a ReLU between each two."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def gather_rows(values: Tensor, index: Tensor) -> Tensor:
    """values[index] for values (M, ...) and an index (P, k): (P, k, ...)."""
    # The backward of indexing itself is several times slower.
    return values.index_select(0, index.flatten()).view(*index.shape, *values.shape[1:])


def in_pieces(values: Tensor) -> tuple[Tensor, ...]:
    """Splits values (M, ...) so that the neighbours of a piece fit the cache: twice as fast."""
    return torch.split(values, 512)


def maximum(values: Tensor, dim: int) -> Tensor:
    """Maximum along a dimension."""
    # On a processor amax is some ten times faster forward, but its backward several times slower.
    return values.max(dim).values if torch.is_grad_enabled() else values.amax(dim)


def ball_maximum(values: Tensor, batch: BallBatch) -> Tensor:
    """Maximum of values (P, C) over the points of each ball: (num_balls, C)."""
    return torch.stack([maximum(ball, dim=0) for ball in torch.split(values, batch.ball_sizes)])
