"""Layers, matrix products and chunks of rows that the networks share.

In inference a row's result does not depend on the other rows, to the last bit: a candidate's score
is the same whatever else is scored with it.
"""

from collections import defaultdict
from collections.abc import Callable, MutableMapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torch.utils.weak import WeakTensorKeyDictionary

from edgegrasp_model.networks.balls import BallBatch

# Products of fewer rows are summed in an order that depends on their number.
MIN_ROWS = 32
ROWS = 512  # points at a time: 1,024 channels of them stay in cache
CONVOLVED = 128  # points at a time in a graph convolution, each with its neighbours
EDGE_ROWS = 256  # edge grasps at a time
# Weights packed for oneDNN, for one version of each.
_PACKED: MutableMapping[Tensor, tuple[int, Tensor]] = WeakTensorKeyDictionary()


class SharedProduct:
    """W [a, b] = W_a a + W_b b on rows [own, shared[row]], each shared part multiplied once."""

    def __init__(self, weight: Tensor, bias: Tensor | None, shared: Tensor) -> None:
        """Multiply the shared parts (B, ..., C2) by their part of the weight (outputs, C1 + C2)."""
        widths = [weight.shape[1] - shared.shape[-1], shared.shape[-1]]
        own_weight, shared_weight = torch.split(weight, widths, dim=1)
        self._own = PackedLinear(own_weight, bias)
        self._shared = row_linear(shared, shared_weight)  # (B, ..., outputs)

    def __call__(self, own: Tensor, shared_of_row: Tensor) -> Tensor:
        """Maps `own` (M, ..., C1) and the rows (M,) of the shared parts to (M, ..., outputs)."""
        rows = self._own(own)
        rows += self._shared.index_select(0, shared_of_row)
        return rows


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with ReLUs in between, for `PackedMlp`."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def gather_rows(values: Tensor, index: Tensor) -> Tensor:
    """values[index] for values (M, ...) and an index (P, k): (P, k, ...)."""
    # The backward pass of plain indexing is several times slower.
    return values.index_select(0, index.flatten()).view(*index.shape, *values.shape[1:])


def row_linear(values: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """F.linear of values (M, ..., C)."""
    if torch.is_grad_enabled() or values.device.type != "cpu":
        return F.linear(values, weight, bias)
    if len(weight) == 1:  # a matrix-vector product, whose order of summation depends on its size
        product = (values * weight[0]).sum(dim=-1, keepdim=True)
        return product if bias is None else product + bias
    if 0 < values.shape[:-1].numel() < MIN_ROWS:
        padded = values.new_zeros((MIN_ROWS, *values.shape[1:]))
        padded[: len(values)] = values
        return F.linear(padded, weight, bias)[: len(values)]
    return F.linear(values, weight, bias)


class PackedLinear:
    """A linear layer for many chunks of rows in one forward pass, by oneDNN on x86."""

    def __init__(
        self, weight: Tensor, bias: Tensor | None = None, *, rectified: bool = False
    ) -> None:
        """Prepare a weight (outputs, C), any part of a matrix; `rectified`: a ReLU follows."""
        self._weight, self._bias, self._rectified = weight, bias, rectified
        self._packed: Tensor | None = None  # for oneDNN; None: the plain product is used
        # On processors without AVX it is unmeasured.
        avx = torch.backends.cpu.get_cpu_capability().startswith("AVX")
        there = avx and torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
        if len(weight) > 1 and there and float32_inference(weight):
            # Changes of an inference tensor are not counted.
            version = -1 if weight.is_inference() else weight._version
            if version < 0 or _PACKED.get(weight, (-1, weight))[0] != version:
                packed = torch.ops.mkldnn._reorder_linear_weight(weight.detach().contiguous())
                _PACKED[weight] = version, packed
            self._packed = _PACKED[weight][1]

    def __call__(self, values: Tensor) -> Tensor:
        """Map (M, ..., C) to (M, ..., outputs); oneDNN sets up again for each number of rows M."""
        if self._packed is None:
            rows = row_linear(values, self._weight, self._bias)
            return rows.relu_() if self._rectified else rows
        then = "relu" if self._rectified else "none"
        result: Tensor = torch.ops.mkldnn._linear_pointwise(
            values, self._packed, self._bias, then, [], ""
        )
        return result


class PackedMlp:
    """The linear layers of an MLP as `PackedLinear`s, with their ReLUs."""

    def __init__(self, mlp: nn.Sequential) -> None:
        layers = [layer for layer in mlp if isinstance(layer, nn.Linear)]
        self._products = [
            PackedLinear(layer.weight, layer.bias, rectified=layer is not layers[-1])
            for layer in layers
        ]

    def __call__(self, values: Tensor) -> Tensor:
        """Maps (M, ..., C) to (M, ..., outputs)."""
        for product in self._products:
            values = product(values)
        return values


def float32_inference(values: Tensor) -> bool:
    """Whether this is float32 inference on a processor."""
    return (
        values.device.type == "cpu"
        and values.dtype == torch.float32
        and not torch.is_grad_enabled()
        and not torch.is_autocast_enabled("cpu")
    )


class BallChunk(NamedTuple):
    """p points of a few balls, the last of which may continue in the next chunk."""

    values: Tensor  # (p, ...)
    ball_of_point: Tensor  # (p,) int64
    balls: list[int]
    sizes: list[int]  # rows of each of these balls, in order, then of the padding


def ball_chunks(values: Tensor, batch: BallBatch, rows: int = ROWS) -> list[BallChunk]:
    """Split values (P, ...) of a batch's points into chunks, one alone except in inference."""
    rows = rows if float32_inference(values) else len(values)
    chunks = []
    for number, (part, ball_of_row) in enumerate(in_chunks(rows, values, batch.ball_of_point)):
        there = batch.ball_of_point[number * rows : (number + 1) * rows]
        balls, sizes = torch.unique_consecutive(there, return_counts=True)
        padding = len(part) - len(there)
        chunks.append(BallChunk(part, ball_of_row, balls.tolist(), [*sizes.tolist(), padding]))
    return chunks


def in_chunks(rows: int, *values: Tensor) -> list[tuple[Tensor, ...]]:
    """Split values (M, ...) into chunks of `rows`, padded with zeros in inference; one on a GPU."""
    if values[0].device.type != "cpu":
        return [values]
    chunks = list(zip(*(torch.split(each, rows) for each in values), strict=True))
    missing = rows - len(chunks[-1][0])
    if missing and not torch.is_grad_enabled():
        chunks[-1] = tuple(
            F.pad(part, (0, 0) * (part.dim() - 1) + (0, missing)) for part in chunks[-1]
        )
    return chunks


def by_chunks(layer: Callable[[Tensor], Tensor], values: Tensor, rows: int = ROWS) -> Tensor:
    """A layer that maps the rows of values (M, ...) one by one."""
    parts = [layer(part) for (part,) in in_chunks(rows, values)]
    return torch.cat(parts)[: len(values)]


class BallMaximum:
    """Maximum over the points of each ball, chunk by chunk."""

    def __init__(self) -> None:
        self._parts: defaultdict[int, list[Tensor]] = defaultdict(list)  # by ball, ascending

    def add(self, values: Tensor, chunk: BallChunk) -> None:
        """Take in the values (p, C) of a chunk's points."""
        for ball, part in zip(chunk.balls, torch.split(values, chunk.sizes), strict=False):
            self._parts[ball].append(maximum(part, dim=0))

    def result(self) -> Tensor:
        """The maximum (B, C) of each ball."""
        return torch.stack([maximum(torch.stack(parts), dim=0) for parts in self._parts.values()])


def maximum(values: Tensor, dim: int) -> Tensor:
    """Maximum along a dimension."""
    # On a processor amax is some ten times faster forward, but its backward several times slower.
    return values.max(dim).values if torch.is_grad_enabled() else values.amax(dim)
