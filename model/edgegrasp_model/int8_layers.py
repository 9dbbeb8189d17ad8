"""Layers of EdgeGraspNet on bytes: four products in the time of one in float32.

What goes into a product is kept as bytes 0..255 of one scale for all channels, and its weights as
bytes -127..127 of one scale for each output channel. PyTorch's oneDNN multiplies and adds them up
in whole numbers, so no score depends on what else is in a batch. Every product has the same number
of rows: oneDNN prepares anew for each, which would take half as long as the product.
"""

import torch
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_model.layers import gather_rows
from edgegrasp_model.network import GlobalFeature, PointNetConv
from edgegrasp_model.pieces import CONVOLVED, BallMaximum, ball_pieces, in_pieces
from edgegrasp_model.products import linear_layers, row_linear

BYTE, WEIGHT_BYTE = 255, 127  # the largest of a value and of a weight
# The byte of a large value. Not 255: larger ones have room, and where a processor without VNNI adds
# two products up in 16 bits they fit.
LARGE_BYTE = 127


class Int8Linear(nn.Module):
    """A linear layer on bytes; its weights come from a float32 one by `fill` or a checkpoint."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        if not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
            raise InvalidCheckpoint(
                "architecture: got int8, and PyTorch has no oneDNN here. "
                "Use the float32 weights it was made from."
            )
        weight = torch.zeros(outputs, inputs, dtype=torch.int8)
        self.weight = nn.Parameter(weight, requires_grad=False)
        self.register_buffer("weight_scale", torch.ones(outputs))
        self.register_buffer("bias", torch.zeros(outputs))
        self.register_buffer("input_scale", torch.ones(()))
        self.weight_scale: Tensor
        self.bias: Tensor
        self.input_scale: Tensor  # of the bytes that go in
        self._packed: Tensor | None = None  # the weights as oneDNN reads them
        self._zeros = torch.zeros(outputs, dtype=torch.int64)  # what a weight of zero is

    def fill(self, weight: Tensor, bias: Tensor | None, largest: float) -> None:
        """Take over a float32 layer.

        Args:
            weight: (outputs, inputs).
            bias: (outputs,), or none.
            largest: A large input; twice as large ones are cut off.
        """
        scale = weight.abs().amax(dim=1).clamp_min(1e-12) / WEIGHT_BYTE
        self.weight.copy_((weight / scale[:, None]).round())
        self.weight_scale.copy_(scale)
        if bias is not None:
            self.bias.copy_(bias)
        self.input_scale.fill_(max(largest, 1e-12) / LARGE_BYTE)
        self._packed = None

    def bytes_of(self, values: Tensor) -> Tensor:
        """The layer's input (M, inputs) from float32: whole bytes, below zero becomes zero."""
        return rounded_down(self.scaled(values).add_(0.5))

    def scaled(self, values: Tensor) -> Tensor:
        """Values in units of the layer's input bytes."""
        return values * (1.0 / float(self.input_scale))

    def forward(
        self, values: Tensor, bytes_for: "Int8Linear | None" = None, plus: Tensor | None = None
    ) -> Tensor:
        """Maps bytes (M, inputs) to (M, outputs) float32.

        Args:
            values: Made by `bytes_of`, or by the layer before this one.
            bytes_for: Next layer: the result is rectified, and comes as the bytes it takes.
            plus: (M, outputs) float32, added before that.
        """
        if self._packed is None:
            self._packed = torch.ops.onednn.qlinear_prepack(self.weight, None)
        weight = (self._packed, self.weight_scale, self._zeros)
        source = (values, float(self.input_scale), 0)
        scale = 1.0 if bytes_for is None else float(bytes_for.input_scale)
        target = (scale, 0, torch.float32 if bytes_for is None else torch.uint8)
        rectified: tuple[str, list[float], str] = ("none" if bytes_for is None else "relu", [], "")
        multiply = torch.ops.onednn.qlinear_pointwise
        result: Tensor
        if plus is None:
            result = multiply(*source, *weight, self.bias, *target, *rectified)
        else:
            added = (1.0, 0, "add", 1.0)
            result = multiply.binary(*source, *weight, plus, self.bias, *target, *added, *rectified)
        return result


class Int8PointNetConv(nn.Module):
    """`PointNetConv` with its second layer, which runs per neighbour, on bytes."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs + 3, width)
        self.output = Int8Linear(width, width)

    def fill(self, layer: PointNetConv, largest: float) -> None:
        """Take over a float32 layer; the largest hidden feature is that of `Int8Linear.fill`."""
        self.hidden.load_state_dict(layer.hidden.state_dict())
        self.output.fill(layer.output.weight, layer.output.bias, largest)

    def forward(self, features: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, inputs) to (P, width)."""
        u, v = point_parts(self.hidden, features, batch)
        u, v = self.output.scaled(u).add_(0.5), self.output.scaled(v)
        pooled = []
        for neighbors, v_here in in_pieces(CONVOLVED, batch.neighbors, v):
            hidden = gather_rows(u, neighbors).sub_(v_here.unsqueeze(1))  # (p, k, width)
            messages = self.output(rounded_down(hidden).flatten(0, 1))
            pooled.append(messages.view(hidden.shape).amax(dim=1))  # (p, width)
        return torch.cat(pooled)[: len(features)]


class Int8GlobalFeature(nn.Module):
    """`GlobalFeature` on bytes; the ball's share of the joining layer stays in float32."""

    def __init__(self, inputs: int, widths_1: tuple[int, ...], widths_2: tuple[int, ...]) -> None:
        super().__init__()
        self.first = Int8Linear(inputs, widths_1[0])
        self.second = Int8Linear(widths_1[0], widths_1[1])
        self.third = Int8Linear(widths_1[1], widths_1[2])
        self.join = Int8Linear(inputs, widths_2[0])
        self.ball = nn.Linear(widths_1[-1], widths_2[0], bias=False)
        self.last = Int8Linear(*widths_2)

    def forward(self, local: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 224) to ball features (B, 1024)."""
        first, second, third = self.first, self.second, self.third
        pieces = ball_pieces(first.bytes_of(local), batch)
        maximum = BallMaximum(batch.num_balls)
        for piece in pieces:
            hidden = second(first(piece.values, second), third)
            maximum.add(third(hidden), piece)
        shared = row_linear(maximum.result(), self.ball.weight)  # (B, 1024)
        maximum = BallMaximum(batch.num_balls)
        for piece in pieces:
            of_ball = shared.index_select(0, piece.ball_of_point)  # (p, 1024)
            joined = self.join(piece.values, self.last, of_ball)
            maximum.add(self.last(joined), piece)
        return maximum.result()

    def fill(self, layer: GlobalFeature, local: float, hidden: list[float], joined: float) -> None:
        """Take over a float32 layer; each product's largest input is that of `Int8Linear.fill`."""
        own = (self.first, self.second, self.third)
        for mine, of, largest in zip(
            own, linear_layers(layer.mlp_1), (local, *hidden), strict=True
        ):
            mine.fill(of.weight, of.bias, largest)
        widths = [self.join.weight.shape[1], self.ball.in_features]
        own_weight, ball_weight = torch.split(layer.join.weight, widths, dim=1)
        self.join.fill(own_weight, layer.join.bias, local)
        self.ball.weight.copy_(ball_weight)
        (last,) = linear_layers(layer.mlp_2)
        self.last.fill(last.weight, last.bias, joined)


def rounded_down(values: Tensor) -> Tensor:
    """Whole bytes of values 0..255, in place; what is beyond becomes the nearest."""
    # By way of int16: the conversion of float32 to uint8 is not vectorised.
    return values.clamp_(0, BYTE).to(torch.int16).to(torch.uint8)


def point_parts(hidden: nn.Linear, features: Tensor, batch: BallBatch) -> tuple[Tensor, Tensor]:
    """u, v (P, width) of W [f_j, p_j - p_i] + b = u_j - v_i, as in `PointNetConv`."""
    widths = [features.shape[1], 3]
    feature_weight, point_weight = torch.split(hidden.weight, widths, dim=1)
    v = row_linear(batch.points, point_weight)
    return row_linear(features, feature_weight, hidden.bias) + v, v
