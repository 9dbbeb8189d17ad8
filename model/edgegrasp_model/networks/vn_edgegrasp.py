"""VNEdgeGraspNet: EdgeGraspNet on vector neurons; its scores do not change when the cloud turns.

Huang et al., ICRA 2023, section IV-D, with the widths of the authors' release. Features are
(M, 3, C): C vectors each; P points in B balls, E grasps. On a processor inference runs in loops
that Numba compiles: there each ReLU's and each maximum's direction map is composed with the linear
layer before it, so that one product gives vectors and directions side by side, (M, 3, 2C).
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edgegrasp_model.kernels import compiled
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.networks.layers import (
    CONVOLVED,
    EDGE_ROWS,
    BallChunk,
    PackedLinear,
    PackedMlp,
    RowLinear,
    SharedLinear,
    SharedProduct,
    ball_chunks,
    by_chunks,
    float32_inference,
    gather_rows,
    in_chunks,
    mlp,
    row_linear,
)

Float32 = NDArray[np.float32]

_TINY = 1e-7  # keeps the division finite where a direction vanishes; the reference's value
FUSED_CONVOLVED = 32  # points at a time in a graph convolution, each with its neighbours
FUSED_ROWS = 256  # points at a time in the global layers

# Sums may be reordered and divisions turned into products; NaN and infinity stay themselves.
_compiled = compiled("contract", "nsz", "arcp", "reassoc")


class VNEdgeGraspNet(nn.Module):
    """The paper's rotation-invariant network."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        width_1, width_2, width_3 = config.conv_widths
        self.conv1 = VNPointNetConv(2, width_1)
        self.conv2 = VNPointNetConv(width_1, width_2)
        self.conv3 = VNPointNetConv(width_2, width_3)
        self.ball_feature = VNGlobalFeature(
            config.local_width, config.global_widths_1, config.global_widths_2
        )
        channels = 3 + width_3 + config.global_widths_2[-1]  # 3: approach, contact and normal
        self.frame_1 = VNSharedLinearReLU(channels, channels // 2)
        self.frame_2 = VNLinearReLU(channels // 2, channels // 4)
        self.frame_3 = RowLinear(channels // 4, 3, bias=False)
        self.classifier = mlp((3 * channels, *config.classifier_widths, 1))

    def forward(self, batch: BallBatch) -> Tensor:
        """Scores the edge grasps of a batch: logits (E,) of success."""
        contact = batch.contact
        f1 = self.conv1(torch.stack((batch.points, batch.normals), dim=2), batch)  # (P, 3, 32)
        f2 = self.conv2(f1, batch)  # (P, 3, 64)
        f3 = self.conv3(f2, batch)  # (P, 3, 128)
        ball = self.ball_feature(torch.cat((f1, f2, f3), dim=2), batch)  # (B, 3, 381)
        named = (batch.approach, batch.points[contact], batch.normals[contact])
        grasp = torch.cat((torch.stack(named, dim=2), f3[contact]), dim=2)  # (E, 3, 131)
        if float32_inference(ball):
            return fused_logits(self, grasp, ball, batch.ball_of_edge)
        # Three vectors learned from the grasp turn with it: coordinates along them are invariant.
        frame = self.frame_3(self.frame_2(self.frame_1(grasp, ball, batch.ball_of_edge)))
        vectors = torch.cat((grasp, ball[batch.ball_of_edge]), dim=2)  # (E, 3, 512)
        invariant = (vectors.transpose(1, 2) @ frame).flatten(1)  # (E, 512, 3) -> (E, 1536)
        logits: Tensor = self.classifier(invariant).squeeze(1)  # (E, 1) -> (E,)
        return logits


class VNPointNetConv(nn.Module):
    """Graph convolution: a two-layer vector MLP on [f_j, p_j - p_i], maximum over neighbours j."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.hidden = RowLinear(inputs + 1, width, bias=False)
        self.hidden_relu = VNReLU(width)
        self.output = RowLinear(width, width, bias=False)
        self.reach = RowLinear(width, width, bias=False)
        self.output_relu = VNReLU(width)

    def forward(self, features: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 3, inputs) to (P, 3, width)."""
        if float32_inference(features):
            return fused_convolution(self, features, batch)
        # W [f_j, p_j - p_i] = u_j - v_i, and the ReLU's direction likewise: both run per point.
        widths = [features.shape[2], 1]
        feature_weight, point_weight = torch.split(self.hidden.weight, widths, dim=1)
        v = row_linear(batch.points.unsqueeze(2), point_weight)  # (P, 3, width)
        u = row_linear(features, feature_weight) + v  # (P, 3, width)
        u_direction, v_direction = self.hidden_relu.direction(u), self.hidden_relu.direction(v)
        pooled = []
        for neighbors, v_here, v_direction_here in in_chunks(
            CONVOLVED, batch.neighbors, v, v_direction
        ):
            hidden = gather_rows(u, neighbors) - v_here.unsqueeze(1)  # (p, k, 3, width)
            direction = gather_rows(u_direction, neighbors) - v_direction_here.unsqueeze(1)
            messages = self.output(vector_relu(hidden, direction))  # (p, k, 3, width)
            pooled.append(vector_maximum(messages, self.reach, dim=1))
        vectors: Tensor = self.output_relu(torch.cat(pooled)[: len(v)])
        return vectors


class VNGlobalFeature(nn.Module):
    """One feature per ball: vector MLP, maximum, joined to each point; the same again."""

    def __init__(self, inputs: int, widths_1: tuple[int, ...], widths_2: tuple[int, ...]) -> None:
        super().__init__()
        self.vn_1 = VNLinearReLU(inputs, widths_1[0])
        self.vn_2 = VNLinearReLU(widths_1[0], widths_1[1])
        self.vn_3 = RowLinear(widths_1[1], widths_1[2], bias=False)
        self.maximum_1 = VNBallMaximum(widths_1[2])
        self.join = VNSharedLinearReLU(inputs + widths_1[2], widths_2[0])
        self.vn_5 = RowLinear(widths_2[0], widths_2[1], bias=False)
        self.maximum_2 = VNBallMaximum(widths_2[1])

    def forward(self, local: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 3, 224) to ball features (B, 3, 381)."""
        if float32_inference(local):
            return fused_ball_feature(self, local, batch)
        hidden = self.vn_3(self.vn_2(self.vn_1(local)))  # (P, 3, 128)
        pooled = self.maximum_1(hidden, batch)  # (B, 3, 128)
        joined = self.join(local, pooled, batch.ball_of_point)  # (P, 3, 381)
        ball: Tensor = self.maximum_2(self.vn_5(joined), batch)
        return ball


class VNBallMaximum(nn.Module):
    """Per channel the vector of each ball that reaches furthest along its learned direction."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.reach = RowLinear(width, width, bias=False)
        self.relu = VNReLU(width)

    def forward(self, vectors: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 3, width) to ball features (B, 3, width)."""
        balls = torch.split(vectors, batch.ball_sizes)
        furthest = [vector_maximum(ball, self.reach, dim=0) for ball in balls]
        pooled: Tensor = self.relu(torch.stack(furthest))
        return pooled


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


class VNReLU(nn.Module):
    """Vector ReLU along directions that are learned from the vectors themselves."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.direction = RowLinear(width, width, bias=False)

    def forward(self, vectors: Tensor) -> Tensor:
        """Maps (M, 3, width) to the same shape."""
        return vector_relu(vectors, self.direction(vectors))


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


def fused_convolution(layer: VNPointNetConv, features: Tensor, batch: BallBatch) -> Tensor:
    """`VNPointNetConv.forward`: maps point features (P, 3, inputs) to (P, 3, width)."""
    # W [f_j, p_j - p_i] = W [f_j, p_j] - w p_i, w the last column: the product runs per point.
    weight = _beside(layer.hidden.weight, layer.hidden_relu.direction.weight)
    output = PackedLinear(_beside(layer.output.weight, layer.reach.weight))
    u = by_chunks(
        PackedLinear(weight), torch.cat((features, batch.points.unsqueeze(2)), dim=2), FUSED_ROWS
    )
    (count, k), width = batch.neighbors.shape, len(layer.output.weight)
    offset = weight[:, -1].contiguous().numpy()
    points, neighbors = batch.points.numpy(), batch.neighbors.numpy()
    hidden = torch.zeros(FUSED_CONVOLVED * k, 3, width)
    best = np.empty((FUSED_CONVOLVED, width), np.float32)
    pooled = torch.zeros(count, 3, width)
    for first in range(0, count, FUSED_CONVOLVED):
        part = slice(first, min(first + FUSED_CONVOLVED, count))
        _gathered_relu(u.numpy(), points[part], offset, neighbors[part], hidden.numpy())
        messages = output(hidden)  # (FUSED_CONVOLVED k, 3, 2 width)
        best.fill(-np.inf)
        bounds = np.arange(0, (part.stop - part.start) * k + 1, k)
        _furthest(messages.numpy(), bounds, best, pooled[part].numpy())
    return _own_relu(pooled, layer.output_relu.direction)


def fused_ball_feature(layer: VNGlobalFeature, local: Tensor, batch: BallBatch) -> Tensor:
    """`VNGlobalFeature.forward`: maps point features (P, 3, C) to ball features (B, 3, width)."""
    first, second = PackedLinear(_weights(layer.vn_1)), PackedLinear(_weights(layer.vn_2))
    third = PackedLinear(_beside(layer.vn_3.weight, layer.maximum_1.reach.weight))
    last = PackedLinear(_beside(layer.vn_5.weight, layer.maximum_2.reach.weight))
    chunks = ball_chunks(local, batch, FUSED_ROWS)
    maximum = _BallMaximum(batch.num_balls, len(layer.vn_3.weight))
    for chunk in chunks:
        maximum.add(third(_relu(second(_relu(first(chunk.values))))), chunk)
    ball = maximum.activated(layer.maximum_1)  # (B, 3, width)
    join = SharedProduct(_weights(layer.join), None, ball)
    maximum = _BallMaximum(batch.num_balls, len(layer.vn_5.weight))
    for chunk in chunks:
        maximum.add(last(_relu(join(chunk.values, chunk.ball_of_point))), chunk)
    return maximum.activated(layer.maximum_2)


def fused_logits(
    network: VNEdgeGraspNet, grasp: Tensor, ball: Tensor, ball_of_edge: Tensor
) -> Tensor:
    """The end of `VNEdgeGraspNet.forward`: logits (E,) of grasps (E, 3, C) in balls (B, 3, D)."""
    join = SharedProduct(_weights(network.frame_1), None, ball)
    frame_2, frame_3 = PackedLinear(_weights(network.frame_2)), PackedLinear(network.frame_3.weight)
    classifier, result = PackedMlp(network.classifier), []
    for own, of_ball in in_chunks(EDGE_ROWS, grasp, ball_of_edge):
        frame = frame_3(_relu(frame_2(_relu(join(own, of_ball)))))  # (e, 3, 3)
        vectors = torch.cat((own, ball[of_ball]), dim=2)
        result.append(classifier((vectors.transpose(1, 2) @ frame).flatten(1)))  # (e, 1)
    return torch.cat(result).squeeze(1)[: len(grasp)]


def _beside(weight: Tensor, direction: Tensor) -> Tensor:
    """The weight (C, inputs) and its direction map composed with it, one above the other."""
    return torch.cat((weight, direction @ weight))


def _own_relu(vectors: Tensor, direction: nn.Linear) -> Tensor:
    directions = PackedLinear(direction.weight)
    return by_chunks(lambda v: _relu(torch.cat((v, directions(v)), dim=2)), vectors, FUSED_ROWS)


def _weights(layer: VNLinearReLU | VNSharedLinearReLU) -> Tensor:
    """The weights of a layer and of its directions, one above the other."""
    return torch.cat((layer.feature.weight, layer.direction.weight))


class _BallMaximum:
    """`VNBallMaximum` chunk by chunk."""

    def __init__(self, num_balls: int, width: int) -> None:
        self._best = torch.full((num_balls, width), -torch.inf)
        self._vectors = torch.zeros(num_balls, 3, width)

    def add(self, both: Tensor, chunk: BallChunk) -> None:
        """Take in the vectors and directions (p, 3, 2 width) of a chunk's points."""
        bounds = np.cumsum([0, *chunk.sizes[: len(chunk.balls)]])
        balls = slice(chunk.balls[0], chunk.balls[-1] + 1)
        _furthest(both.numpy(), bounds, self._best[balls].numpy(), self._vectors[balls].numpy())

    def activated(self, layer: VNBallMaximum) -> Tensor:
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
