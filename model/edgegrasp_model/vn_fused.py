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
from edgegrasp_model.layers import SharedProduct
from edgegrasp_model.pieces import EDGE_ROWS, BallPiece, ball_pieces, by_pieces, in_pieces
from edgegrasp_model.products import MlpProducts, Product

if TYPE_CHECKING:
    from edgegrasp_model.vn_layers import VNLinearReLU, VNSharedLinearReLU
    from edgegrasp_model.vn_network import (
        VNBallMaximum,
        VNEdgeGraspNet,
        VNGlobalFeature,
        VNPointNetConv,
    )

Float32 = NDArray[np.float32]

CONVOLVED = 32  # points at a time in a graph convolution, each with its neighbours
ROWS = 256  # points at a time in the global layers


# Sums may be reordered and divisions turned into products; NaN and infinity stay themselves.
_compiled = compiled("contract", "nsz", "arcp", "reassoc")


def convolution(layer: "VNPointNetConv", features: Tensor, batch: BallBatch) -> Tensor:
    """`VNPointNetConv.forward`: maps point features (P, 3, inputs) to (P, 3, width)."""
    # W [f_j, p_j - p_i] = W [f_j, p_j] - w p_i, w the last column: the product runs per point.
    weight = _beside(layer.hidden.weight, layer.hidden_relu.direction.weight)
    output = Product(_beside(layer.output.weight, layer.reach.weight))
    u = by_pieces(Product(weight), torch.cat((features, batch.points.unsqueeze(2)), dim=2), ROWS)
    (count, k), width = batch.neighbors.shape, len(layer.output.weight)
    offset = weight[:, -1].contiguous().numpy()
    points, neighbors = batch.points.numpy(), batch.neighbors.numpy()
    hidden = torch.zeros(CONVOLVED * k, 3, width)
    best = np.empty((CONVOLVED, width), np.float32)
    pooled = torch.zeros(count, 3, width)
    for first in range(0, count, CONVOLVED):
        part = slice(first, min(first + CONVOLVED, count))
        _gathered_relu(u.numpy(), points[part], offset, neighbors[part], hidden.numpy())
        messages = output(hidden)  # (CONVOLVED k, 3, 2 width)
        best.fill(-np.inf)
        bounds = np.arange(0, (part.stop - part.start) * k + 1, k)
        _furthest(messages.numpy(), bounds, best, pooled[part].numpy())
    return _own_relu(pooled, layer.output_relu.direction)


def ball_feature(layer: "VNGlobalFeature", local: Tensor, batch: BallBatch) -> Tensor:
    """`VNGlobalFeature.forward`: maps point features (P, 3, C) to ball features (B, 3, width)."""
    first, second = Product(_weights(layer.vn_1)), Product(_weights(layer.vn_2))
    third = Product(_beside(layer.vn_3.weight, layer.maximum_1.reach.weight))
    last = Product(_beside(layer.vn_5.weight, layer.maximum_2.reach.weight))
    pieces = ball_pieces(local, batch, ROWS)
    maximum = _BallMaximum(batch.num_balls, len(layer.vn_3.weight))
    for piece in pieces:
        maximum.add(third(_relu(second(_relu(first(piece.values))))), piece)
    ball = maximum.activated(layer.maximum_1)  # (B, 3, width)
    join = SharedProduct(_weights(layer.join), None, ball)
    maximum = _BallMaximum(batch.num_balls, len(layer.vn_5.weight))
    for piece in pieces:
        maximum.add(last(_relu(join(piece.values, piece.ball_of_point))), piece)
    return maximum.activated(layer.maximum_2)


def logits(network: "VNEdgeGraspNet", grasp: Tensor, ball: Tensor, ball_of_edge: Tensor) -> Tensor:
    """The end of `VNEdgeGraspNet.forward`: logits (E,) of grasps (E, 3, C) in balls (B, 3, D)."""
    join = SharedProduct(_weights(network.frame_1), None, ball)
    frame_2, frame_3 = Product(_weights(network.frame_2)), Product(network.frame_3.weight)
    classifier, result = MlpProducts(network.classifier), []
    for own, of_ball in in_pieces(EDGE_ROWS, grasp, ball_of_edge):
        frame = frame_3(_relu(frame_2(_relu(join(own, of_ball)))))  # (e, 3, 3)
        vectors = torch.cat((own, ball[of_ball]), dim=2)
        result.append(classifier((vectors.transpose(1, 2) @ frame).flatten(1)))  # (e, 1)
    return torch.cat(result).squeeze(1)[: len(grasp)]


def _beside(weight: Tensor, direction: Tensor) -> Tensor:
    """The weight (C, inputs) and its direction map composed with it, one above the other."""
    return torch.cat((weight, direction @ weight))


def _own_relu(vectors: Tensor, direction: nn.Linear) -> Tensor:
    directions = Product(direction.weight)
    return by_pieces(lambda v: _relu(torch.cat((v, directions(v)), dim=2)), vectors, ROWS)


def _weights(layer: "VNLinearReLU | VNSharedLinearReLU") -> Tensor:
    """The weights of a layer and of its directions, one above the other."""
    return torch.cat((layer.feature.weight, layer.direction.weight))


class _BallMaximum:
    """`VNBallMaximum` piece by piece."""

    def __init__(self, num_balls: int, width: int) -> None:
        self._best = torch.full((num_balls, width), -torch.inf)
        self._vectors = torch.zeros(num_balls, 3, width)

    def add(self, both: Tensor, piece: BallPiece) -> None:
        """Take in the vectors and directions (p, 3, 2 width) of a piece's points."""
        bounds = np.cumsum([0, *piece.sizes[: len(piece.balls)]])
        balls = slice(piece.balls[0], piece.balls[-1] + 1)
        _furthest(both.numpy(), bounds, self._best[balls].numpy(), self._vectors[balls].numpy())

    def activated(self, layer: "VNBallMaximum") -> Tensor:
        """The furthest vectors (B, 3, width) after the layer's ReLU."""
        return _own_relu(self._vectors, layer.relu.direction)


def _relu(both: Tensor) -> Tensor:
    """`vector_relu` of vectors and directions side by side: (M, 3, 2C) to (M, 3, C)."""
    result = torch.empty(len(both), 3, both.shape[2] // 2)
    _own_relu_rows(both.numpy(), result.numpy())
    return result


@_compiled
def _gathered_relu(
    u: Float32, points: Float32, offset: Float32, neighbors: NDArray[np.int64], result: Float32
) -> None:
    """`vector_relu` of u_j - offset p_i for the neighbours (p, k) of each of p points."""
    width, k = result.shape[2], neighbors.shape[1]
    zero, tiny = np.float32(0.0), np.float32(1e-7)
    for i in range(len(neighbors)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        for j in range(k):
            there, row = u[neighbors[i, j]], result[i * k + j]
            for c in range(width):
                d = width + c
                wc, wd = offset[c], offset[d]
                x, y, z = there[0, c] - wc * px, there[1, c] - wc * py, there[2, c] - wc * pz
                a, b, g = there[0, d] - wd * px, there[1, d] - wd * py, there[2, d] - wd * pz
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
def _furthest(both: Float32, bounds: NDArray[np.int64], best: Float32, result: Float32) -> None:
    """`vector_maximum` over the rows of `both` between each two of `bounds`; the first of a tie.

    Goes on from the vectors in `result` and how far they reach, `best`.
    """
    width = result.shape[2]
    furthest = np.empty(width, np.int32)
    for i in range(len(bounds) - 1):
        row, reached = result[i], best[i]
        furthest[:] = -1  # Choosing rows first, vectors after, is several times faster.
        for j in range(bounds[i], bounds[i + 1]):
            here, number = both[j], np.int32(j)
            for c in range(width):
                d = width + c
                reach = here[0, c] * here[0, d] + here[1, c] * here[1, d] + here[2, c] * here[2, d]
                further = reach > reached[c]
                reached[c] = reach if further else reached[c]
                furthest[c] = number if further else furthest[c]
        for c in range(width):
            if furthest[c] >= 0:
                there = both[furthest[c]]
                row[0, c], row[1, c], row[2, c] = there[0, c], there[1, c], there[2, c]
