"""Inference of EdgeGraspNet's graph convolution in one compiled loop between two products.

PyTorch needs three passes over the edge features there. The results are those of `network` up to
rounding. Needs the extra `fast` (Numba); nothing imports this module where Numba is absent.
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.compiled import compiled
from edgegrasp_model.pieces import CONVOLVED, by_pieces
from edgegrasp_model.products import Product

if TYPE_CHECKING:
    from edgegrasp_model.network import PointNetConv

Float32 = NDArray[np.float32]


def convolution(layer: "PointNetConv", features: Tensor, batch: BallBatch) -> Tensor:
    """`PointNetConv.forward`: maps point features (P, inputs) to (P, width)."""
    # W [f_j, p_j - p_i] + b = W [f_j, p_j] + b - V p_i: the product runs per point.
    weight, output = layer.hidden.weight, Product(layer.output.weight)
    u = by_pieces(Product(weight, layer.hidden.bias), torch.cat((features, batch.points), dim=1))
    offset = weight[:, -3:].t().contiguous().numpy()  # V, (3, width)
    points, neighbors = batch.points.numpy(), batch.neighbors.numpy()
    (count, k), width = neighbors.shape, len(weight)
    hidden = torch.zeros(CONVOLVED * k, width)
    pooled = torch.empty(count, width)
    for first in range(0, count, CONVOLVED):
        part = slice(first, min(first + CONVOLVED, count))
        _gathered_relu(u.numpy(), points[part], offset, neighbors[part], hidden.numpy())
        messages = output(hidden).view(CONVOLVED, k, width)[: part.stop - part.start]
        torch.amax(messages, dim=1, out=pooled[part])
    # The bias is the same for all neighbours: added once, after the maximum.
    return pooled.add_(layer.output.bias)


@compiled("contract", "nsz")
def _gathered_relu(
    u: Float32, points: Float32, offset: Float32, neighbors: NDArray[np.int64], result: Float32
) -> None:
    """ReLU of u_j - V p_i for the neighbours (p, k) of each of p points."""
    width, k = result.shape[1], neighbors.shape[1]
    zero = np.float32(0.0)
    here = np.empty(width, np.float32)
    for i in range(len(neighbors)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for c in range(width):
            here[c] = x * offset[0, c] + y * offset[1, c] + z * offset[2, c]
        for j in range(k):
            there, row = u[neighbors[i, j]], result[i * k + j]
            for c in range(width):
                row[c] = max(there[c] - here[c], zero)
