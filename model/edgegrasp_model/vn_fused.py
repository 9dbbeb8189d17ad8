"""Inference of VNEdgeGraspNet with edge features that never leave the processor's cache.

Between two matrix products PyTorch needs a dozen passes over the edge features; here Numba
compiles each such stretch into one loop. Each ReLU's and each maximum's direction map is composed
with the linear layer before it, so that one product yields vectors and directions side by side:
(M, 3, 2C). The results are those of `vn_network` up to rounding, which can tip a near tie in the
choice of the furthest vector.

Needs the extra `fast` (Numba); nothing imports this module where Numba is absent.
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.compiled import compiled
from edgegrasp_model.layers import MIN_ROWS, row_linear

if TYPE_CHECKING:
    from edgegrasp_model.vn_network import VNBallMaximum, VNGlobalFeature, VNPointNetConv

Float32 = NDArray[np.float32]

PIECE = 64  # points at a time, so that their neighbours' features fit the cache


# Sums may be reordered and divisions turned into products; NaN and infinity stay themselves.
_compiled = compiled("contract", "nsz", "arcp", "reassoc")


def convolution(layer: "VNPointNetConv", features: Tensor, batch: BallBatch) -> Tensor:
    """`VNPointNetConv.forward`: maps point features (P, 3, inputs) to (P, 3, width)."""
    feature_weight, point_weight = torch.split(layer.hidden.weight, [features.shape[2], 1], dim=1)
    direction = layer.hidden_relu.direction.weight
    v = row_linear(batch.points.unsqueeze(2), _beside(point_weight, direction))  # (P, 3, 2 width)
    u = row_linear(features, _beside(feature_weight, direction)) + v
    output = _beside(layer.output.weight, layer.reach.weight).t()  # (width, 2 width)
    count, k = batch.neighbors.shape
    width = len(output)
    hidden = torch.empty(PIECE * k, 3, width)
    messages = torch.empty(PIECE * k, 3, 2 * width)
    pooled = torch.empty(count, 3, width)
    neighbors = batch.neighbors.numpy()
    for first in range(0, count, PIECE):
        part = slice(first, min(first + PIECE, count))
        edges = (part.stop - part.start) * k
        _gathered_relu(u.numpy(), v[part].numpy(), neighbors[part], hidden.numpy())
        rows = min(max(edges, MIN_ROWS), len(hidden))
        torch.mm(hidden[:rows].view(-1, width), output, out=messages[:rows].view(-1, 2 * width))
        _furthest(messages.numpy(), np.arange(0, edges + 1, k), pooled[part].numpy())
    return _own_relu(pooled, layer.output_relu.direction)


def ball_feature(layer: "VNGlobalFeature", local: Tensor, batch: BallBatch) -> Tensor:
    """`VNGlobalFeature.forward`: maps point features (P, 3, C) to ball features (B, 3, width)."""
    first_weight = torch.cat((layer.vn_1.feature.weight, layer.vn_1.direction.weight))
    second_weight = torch.cat((layer.vn_2.feature.weight, layer.vn_2.direction.weight))
    third_weight = _beside(layer.vn_3.weight, layer.maximum_1.reach.weight)
    join_weight = torch.cat((layer.join.feature.weight, layer.join.direction.weight))
    own_weight, ball_weight = torch.split(
        join_weight, [local.shape[2], join_weight.shape[1] - local.shape[2]], dim=1
    )
    last_weight = _beside(layer.vn_5.weight, layer.maximum_2.reach.weight)
    balls = torch.split(local, batch.ball_sizes)
    first = [
        _pooled(
            row_linear(
                _relu(row_linear(_relu(row_linear(b, first_weight)), second_weight)), third_weight
            )
        )
        for b in balls
    ]
    shared = row_linear(_activated(layer.maximum_1, first), ball_weight)  # (B, 3, 2 width)
    second = [
        _pooled(row_linear(_relu(row_linear(ball, own_weight).add_(here)), last_weight))
        for ball, here in zip(balls, shared, strict=True)
    ]
    return _activated(layer.maximum_2, second)


def _beside(weight: Tensor, direction: Tensor) -> Tensor:
    """The weight (C, inputs) and its direction map composed with it, one above the other."""
    return torch.cat((weight, direction @ weight))


def _own_relu(vectors: Tensor, direction: nn.Linear) -> Tensor:
    return _relu(torch.cat((vectors, direction(vectors)), dim=2))


def _activated(layer: "VNBallMaximum", furthest: list[Tensor]) -> Tensor:
    return _own_relu(torch.stack(furthest), layer.relu.direction)


def _relu(both: Tensor) -> Tensor:
    """`vector_relu` of vectors and directions side by side: (M, 3, 2C) to (M, 3, C)."""
    result = torch.empty(len(both), 3, both.shape[2] // 2)
    _own_relu_rows(both.numpy(), result.numpy())
    return result


def _pooled(both: Tensor) -> Tensor:
    """The furthest of all vectors (M, 3, 2C) along their directions: (3, C)."""
    result = torch.empty(1, 3, both.shape[2] // 2)
    _furthest(both.numpy(), np.array([0, len(both)]), result.numpy())
    return result[0]


@_compiled
def _gathered_relu(u: Float32, v: Float32, neighbors: NDArray[np.int64], result: Float32) -> None:
    """`vector_relu` of u_j - v_i for the neighbours (p, k) of each of p points."""
    width, k = result.shape[2], neighbors.shape[1]
    zero, tiny = np.float32(0.0), np.float32(1e-7)
    for i in range(len(neighbors)):
        here = v[i]
        for j in range(k):
            there, row = u[neighbors[i, j]], result[i * k + j]
            for c in range(width):
                x, y, z = (
                    there[0, c] - here[0, c],
                    there[1, c] - here[1, c],
                    there[2, c] - here[2, c],
                )
                d = width + c
                a, b, g = (
                    there[0, d] - here[0, d],
                    there[1, d] - here[1, d],
                    there[2, d] - here[2, d],
                )
                along = min(x * a + y * b + z * g, zero) / (a * a + b * b + g * g + tiny)
                row[0, c], row[1, c], row[2, c] = x - along * a, y - along * b, z - along * g


@_compiled
def _own_relu_rows(both: Float32, result: Float32) -> None:
    """`vector_relu` of each row of `both` (M, 3, 2C) into `result` (M, 3, C)."""
    width = result.shape[2]
    zero, tiny = np.float32(0.0), np.float32(1e-7)
    for i in range(len(result)):
        here, row = both[i], result[i]
        for c in range(width):
            d = width + c
            x, y, z = here[0, c], here[1, c], here[2, c]
            a, b, g = here[0, d], here[1, d], here[2, d]
            along = min(x * a + y * b + z * g, zero) / (a * a + b * b + g * g + tiny)
            row[0, c], row[1, c], row[2, c] = x - along * a, y - along * b, z - along * g


@_compiled
def _furthest(both: Float32, bounds: NDArray[np.int64], result: Float32) -> None:
    """`vector_maximum` over the rows of `both` between each two of `bounds`; the first of a tie."""
    width = result.shape[2]
    best = np.empty(width, np.float32)
    for i in range(len(bounds) - 1):
        row = result[i]
        best[:] = -np.inf
        for j in range(bounds[i], bounds[i + 1]):
            here = both[j]
            for c in range(width):
                d = width + c
                reach = here[0, c] * here[0, d] + here[1, c] * here[1, d] + here[2, c] * here[2, d]
                further = reach > best[c]
                best[c] = reach if further else best[c]
                row[0, c] = here[0, c] if further else row[0, c]
                row[1, c] = here[1, c] if further else row[1, c]
                row[2, c] = here[2, c] if further else row[2, c]
