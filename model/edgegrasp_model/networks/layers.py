"""Layers, matrix products and chunks of rows that the networks share.

In inference a row's result does not depend on the other rows, to the last bit: a candidate's score
is the same whatever else is scored with it.
"""

from collections import defaultdict
from collections.abc import Callable, MutableMapping, Sequence
from functools import reduce
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torch.utils.weak import WeakTensorKeyDictionary

from edgegrasp_model.networks.balls import BallBatch

Layer = Callable[[Tensor], Tensor]

# Products of fewer rows are summed in an order that depends on their number.
MIN_ROWS = 32
ROWS = 512  # points at a time: 1,024 channels of them stay in cache
CONVOLVED = 128  # points at a time in a graph convolution, each with its neighbours
EDGE_ROWS = 256  # edge grasps at a time
# A copy of each weight, and the weight packed for oneDNN.
_PACKED: MutableMapping[Tensor, tuple[Tensor, Tensor]] = WeakTensorKeyDictionary()


def shared_product(
    weight: Tensor, bias: Tensor | None, shared: Tensor
) -> Callable[[Tensor, Tensor], Tensor]:
    """W [a, b] = W_a a + W_b b, where the shared parts b (B, ..., C2) are multiplied once.

    It maps parts a (M, ..., C1), and the rows (M,) of their shared parts, to (M, ..., outputs). The
    weight is (outputs, C1 + C2).
    """
    widths = [weight.shape[1] - shared.shape[-1], shared.shape[-1]]
    own_weight, shared_weight = torch.split(weight, widths, dim=1)
    own, products = packed_linear(own_weight, bias), row_linear(shared, shared_weight)
    return lambda values, row: own(values).add_(products.index_select(0, row))


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with ReLUs in between, for `packed`."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def gather_rows(values: Tensor, index: Tensor) -> Tensor:
    """values[index] for values (M, ...) and an index (P, k): (P, k, ...)."""
    # The backward pass of plain indexing is several times slower.
    return values.index_select(0, index.flatten()).view(*index.shape, *values.shape[1:])


def row_linear(values: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """F.linear of values (M, ..., C); in inference, no row's result depends on other rows."""
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


def packed_linear(
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    rectified: bool = False,
    dtype: torch.dtype = torch.float32,
) -> Layer:
    """A linear layer for many chunks of rows in one forward pass, by oneDNN on x86.

    It maps (M, ..., C) to (M, ..., outputs); oneDNN sets up again for each number of rows M. The
    weight (outputs, C) may be a part of a matrix; `rectified`: a ReLU follows. oneDNN multiplies
    and returns numbers of the type `dtype`.
    """
    # The speed of oneDNN on processors without AVX is unmeasured.
    avx = torch.backends.cpu.get_cpu_capability().startswith("AVX")
    there = avx and torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
    if len(weight) == 1 or not there or not float32_inference(weight):
        then: Layer = torch.relu_ if rectified else nn.Identity()
        return lambda values: then(row_linear(values, weight, bias))
    kept = _PACKED.get(weight)
    # The counter of a tensor's changes misses some.
    if kept is None or kept[1].dtype != dtype or not torch.equal(kept[0], weight):
        copy = weight.detach().clone(memory_format=torch.contiguous_format)
        kept = _PACKED[weight] = copy, torch.ops.mkldnn._reorder_linear_weight(copy.to(dtype))
    for_onednn, after = kept[1], "relu" if rectified else "none"
    added = None if bias is None else bias.to(dtype)
    return lambda values: torch.ops.mkldnn._linear_pointwise(
        values.to(dtype), for_onednn, added, after, [], ""
    )


def packed(mlp: nn.Sequential, dtype: torch.dtype = torch.float32) -> Layer:
    """The linear layers of an MLP, each made by `packed_linear`, with their ReLUs."""
    layers = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    products = [
        packed_linear(layer.weight, layer.bias, rectified=layer is not layers[-1], dtype=dtype)
        for layer in layers
    ]
    return lambda values: reduce(lambda rows, product: product(rows), products, values)


def float32_inference(values: Tensor) -> bool:
    """Whether this is float32 inference on a processor."""
    plain = values.device.type == "cpu" and values.dtype == torch.float32
    return plain and not (torch.is_grad_enabled() or torch.is_autocast_enabled("cpu"))


class BallChunk(NamedTuple):
    """p points of a few balls, the last of which may continue in the next chunk."""

    values: Tensor  # (p, ...)
    ball_of_point: Tensor  # (p,) int64
    balls: list[int]
    sizes: list[int]  # rows of each of these balls, in order, then of the padding


def ball_chunks(values: Tensor, batch: BallBatch, rows: int = ROWS) -> list[BallChunk]:
    """Split values (P, ...) of a batch's points into chunks, but into one if not in inference."""
    rows = rows if float32_inference(values) else len(values)
    chunks = []
    for number, (part, ball_of_row) in enumerate(split_chunks(rows, values, batch.ball_of_point)):
        there = batch.ball_of_point[number * rows : (number + 1) * rows]
        balls, sizes = torch.unique_consecutive(there, return_counts=True)
        padding = len(part) - len(there)
        chunks.append(BallChunk(part, ball_of_row, balls.tolist(), [*sizes.tolist(), padding]))
    return chunks


def split_chunks(rows: int, *values: Tensor) -> list[tuple[Tensor, ...]]:
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


def map_chunks(layer: Layer, values: Tensor, rows: int = ROWS) -> Tensor:
    """Apply a layer that maps rows independently to values (M, ...), chunk by chunk."""
    return torch.cat([layer(part) for (part,) in split_chunks(rows, values)])[: len(values)]


def ball_maximum(chunks: list[BallChunk], layer: Callable[[BallChunk], Tensor]) -> Tensor:
    """Maximum (B, C), over the points of each ball, of a layer's values (p, C) of each chunk."""
    found: defaultdict[int, list[Tensor]] = defaultdict(list)  # by ball, ascending
    for chunk in chunks:
        for ball, part in zip(chunk.balls, torch.split(layer(chunk), chunk.sizes), strict=False):
            found[ball].append(maximum(part, dim=0))
    return torch.stack([maximum(torch.stack(parts), dim=0) for parts in found.values()])


def maximum(values: Tensor, dim: int) -> Tensor:
    """Maximum along a dimension."""
    # On a processor amax is some ten times faster forward, but its backward several times slower.
    return values.max(dim).values if torch.is_grad_enabled() else values.amax(dim)
