"""Layers that both networks share."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from edgegrasp_model.products import Product, row_linear


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
        return self.on(shared)(own, shared_of_row)

    def on(self, shared: Tensor) -> "SharedProduct":
        """The layer on shared parts (B, ..., C2), for the rows of many pieces."""
        return SharedProduct(self.weight, self.bias, shared)


class SharedProduct:
    """What each row's own part gives, added to what its shared part gives."""

    def __init__(self, weight: Tensor, bias: Tensor | None, shared: Tensor) -> None:
        """Multiplies the shared parts (B, ..., C2).

        Args:
            weight: (outputs, C1 + C2).
            bias: (outputs,), or none.
            shared: The shared parts.
        """
        widths = [weight.shape[1] - shared.shape[-1], shared.shape[-1]]
        own_weight, shared_weight = torch.split(weight, widths, dim=1)
        self._own = Product(own_weight, bias)
        self._shared = row_linear(shared, shared_weight)  # (B, ..., outputs)

    def __call__(self, own: Tensor, shared_of_row: Tensor) -> Tensor:
        """Maps own (M, ..., C1) and the rows (M,) of their shared parts to (M, ..., outputs)."""
        rows = self._own(own)
        rows += self._shared.index_select(0, shared_of_row)
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
