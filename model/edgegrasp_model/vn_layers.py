"""Vector Neurons: layers on channels that are 3-vectors and turn with the cloud.

Deng, Litany, Duan, Poulenard, Tagliasacchi, Guibas: "Vector Neurons: A General Framework for
SO(3)-Equivariant Networks", ICCV 2021. Features are (M, 3, C): C vectors for each of M rows, the
channel last, so that a plain linear layer without a bias is equivariant.
"""

import torch
from torch import Tensor, nn

from edgegrasp_model.layers import RowLinear, SharedLinear

_TINY = 1e-7  # keeps the division finite where a direction vanishes; the reference's value


def vector_relu(vectors: Tensor, directions: Tensor) -> Tensor:
    """Removes from each vector (M, 3, C) its part against its direction (M, 3, C), if any."""
    along = (vectors * directions).sum(dim=-2, keepdim=True).clamp(max=0.0)  # (M, 1, C)
    length_squared = directions.square().sum(dim=-2, keepdim=True)  # (M, 1, C)
    return torch.addcmul(vectors, along / (length_squared + _TINY), directions, value=-1.0)


def vector_maximum(vectors: Tensor, direction: nn.Linear, dim: int) -> Tensor:
    """For each channel the vector that reaches furthest along its own direction.

    Args:
        vectors: (..., 3, C).
        direction: Maps the vectors to their directions. It gets no gradient, as a choice has none:
            training leaves it as it was drawn, in the reference too.
        dim: The dimension to reduce, one of those before the last two.
    """
    with torch.no_grad():
        reach = (vectors * direction(vectors)).sum(dim=-2, keepdim=True)  # (..., 1, C)
        furthest = reach.max(dim, keepdim=True).indices  # several times faster than argmax
    return vectors.take_along_dim(furthest, dim).squeeze(dim)


class VNReLU(nn.Module):
    """Vector ReLU along directions that are learned from the vectors themselves."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.direction = RowLinear(width, width, bias=False)

    def forward(self, vectors: Tensor) -> Tensor:
        """Maps (M, 3, width) to the same shape."""
        return vector_relu(vectors, self.direction(vectors))


class VNLinearReLU(nn.Module):
    """A linear layer and a vector ReLU, both fed by the layer's input."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.feature = RowLinear(inputs, outputs, bias=False)
        self.direction = RowLinear(inputs, outputs, bias=False)

    def forward(self, vectors: Tensor) -> Tensor:
        """Maps (M, 3, inputs) to (M, 3, outputs)."""
        return vector_relu(self.feature(vectors), self.direction(vectors))


class VNSharedLinearReLU(nn.Module):
    """`VNLinearReLU` on rows [own, shared[row]], multiplying each shared part only once."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.feature = SharedLinear(inputs, outputs, bias=False)
        self.direction = SharedLinear(inputs, outputs, bias=False)

    def forward(self, own: Tensor, shared: Tensor, shared_of_row: Tensor) -> Tensor:
        """Maps own (M, 3, C1), shared (B, 3, C2), shared_of_row (M,) int64 to (M, 3, outputs)."""
        return vector_relu(
            self.feature(own, shared, shared_of_row), self.direction(own, shared, shared_of_row)
        )
