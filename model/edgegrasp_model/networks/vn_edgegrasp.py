"""VNEdgeGraspNet: EdgeGraspNet on vector neurons; scores are invariant to rotations.

Huang et al., ICRA 2023, section IV-D, with the widths of the authors' release. Features are
(M, 3, C): C vectors each; P points in B balls, E grasps. The map to the directions of a ReLU or of
a maximum is composed with the linear layer before it, so that one product gives `both`: vectors
and directions side by side, (M, 3, 2C).
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from edgegrasp_camera.arrays import Float32, Int64
from edgegrasp_model.kernels import compiled
from edgegrasp_model.networks import layers
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.config import NetworkConfig

_TINY = 1e-7  # keeps the division finite where a direction vanishes; as in the reference system
VN_CONVOLVED = 32  # points at a time in a graph convolution, each with its neighbours
VN_ROWS = 256  # points at a time in the global layers

# Allows reordered sums and reciprocal divisions; NaN and infinity are preserved.
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
        self.frame_1 = VNLinearReLU(channels, channels // 2)
        self.frame_2 = VNLinearReLU(channels // 2, channels // 4)
        self.frame_3 = nn.Linear(channels // 4, 3, bias=False)
        self.classifier = layers.mlp((3 * channels, *config.classifier_widths, 1))

    def forward(self, batch: BallBatch) -> Tensor:
        """Scores the edge grasps of a batch: logits (E,) of success."""
        contact = batch.contact
        f1 = self.conv1(torch.stack((batch.points, batch.normals), dim=2), batch)  # (P, 3, 32)
        f2 = self.conv2(f1, batch)  # (P, 3, 64)
        f3 = self.conv3(f2, batch)  # (P, 3, 128)
        ball = self.ball_feature(torch.cat((f1, f2, f3), dim=2), batch)  # (B, 3, 381)
        named = (batch.approach, batch.points[contact], batch.normals[contact])
        grasp = torch.cat((torch.stack(named, dim=2), f3[contact]), dim=2)  # (E, 3, 131)
        join = layers.shared_product(self.frame_1.weights, None, ball)
        frame_2 = layers.packed_linear(self.frame_2.weights)
        frame_3 = layers.packed_linear(self.frame_3.weight)
        classifier, logits = layers.packed(self.classifier), []
        for own, ball_of_edge in layers.split_chunks(layers.EDGE_ROWS, grasp, batch.ball_of_edge):
            # Three learned vectors rotate with the grasp, so coordinates along them are invariant.
            frame = frame_3(relu(frame_2(relu(join(own, ball_of_edge)))))  # (e, 3, 3)
            vectors = torch.cat((own, ball.index_select(0, ball_of_edge)), dim=2)  # (e, 3, 512)
            invariant = (vectors.transpose(1, 2) @ frame).flatten(1)  # (e, 512, 3) -> (e, 1536)
            logits.append(classifier(invariant))  # (e, 1)
        return torch.cat(logits).squeeze(1)[: len(grasp)]


class VNPointNetConv(nn.Module):
    """Graph convolution: a two-layer vector MLP on [f_j, p_j - p_i], maximum over neighbours j."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs + 1, width, bias=False)
        self.hidden_relu = VNReLU(width)
        self.output = nn.Linear(width, width, bias=False)
        self.reach = nn.Linear(width, width, bias=False)
        self.output_relu = VNReLU(width)

    def forward(self, features: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 3, inputs) to (P, 3, width)."""
        # W [f_j, p_j - p_i] = W [f_j, p_j] - w p_i, w the last column: the product runs per point.
        weight, direction = self.hidden.weight, self.hidden_relu.direction.weight
        weight = torch.cat((weight, direction @ weight))
        output = layers.packed_linear(_with_reach(self.output, self.reach))
        u = torch.cat((features, batch.points.unsqueeze(2)), dim=2)
        u = layers.map_chunks(layers.packed_linear(weight), u, VN_ROWS)  # (P, 3, 2 width)
        if layers.float32_inference(u):
            vectors = _convolved(u, weight[:, -1].contiguous(), output, batch)
        else:
            here, pooled = batch.points.unsqueeze(2) * weight[:, -1], []  # (P, 3, 2 width)
            for neighbors, own in layers.split_chunks(VN_CONVOLVED, batch.neighbors, here):
                both = layers.gather_rows(u, neighbors) - own.unsqueeze(1)  # (p, k, 3, 2 width)
                messages = output(relu(both.flatten(0, 1))).view(both.shape)
                pooled.append(_furthest(messages, dim=1))  # (p, 3, width)
            vectors = torch.cat(pooled)[: len(features)]
        activated: Tensor = self.output_relu(vectors)
        return activated


class VNGlobalFeature(nn.Module):
    """One feature per ball: a vector MLP and a maximum, joined to each point; then both again."""

    def __init__(self, inputs: int, widths_1: tuple[int, ...], widths_2: tuple[int, ...]) -> None:
        super().__init__()
        self.vn_1 = VNLinearReLU(inputs, widths_1[0])
        self.vn_2 = VNLinearReLU(widths_1[0], widths_1[1])
        self.vn_3 = nn.Linear(widths_1[1], widths_1[2], bias=False)
        self.maximum_1 = VNBallMaximum(widths_1[2])
        self.join = VNLinearReLU(inputs + widths_1[2], widths_2[0])
        self.vn_5 = nn.Linear(widths_2[0], widths_2[1], bias=False)
        self.maximum_2 = VNBallMaximum(widths_2[1])

    def forward(self, local: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 3, 224) to ball features (B, 3, 381)."""
        vn_1 = layers.packed_linear(self.vn_1.weights)
        vn_2 = layers.packed_linear(self.vn_2.weights)
        vn_3 = layers.packed_linear(_with_reach(self.vn_3, self.maximum_1.reach))
        vn_5 = layers.packed_linear(_with_reach(self.vn_5, self.maximum_2.reach))
        chunks = layers.ball_chunks(local, batch, VN_ROWS)
        first = self.maximum_1(chunks, lambda chunk: vn_3(relu(vn_2(relu(vn_1(chunk.values))))))
        join = layers.shared_product(self.join.weights, None, first)  # of (B, 3, 128)
        ball: Tensor = self.maximum_2(
            chunks, lambda chunk: vn_5(relu(join(chunk.values, chunk.ball_of_point)))
        )
        return ball


class VNBallMaximum(nn.Module):
    """The vectors of each ball that reach furthest along their directions, and a ReLU of them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.reach = nn.Linear(width, width, bias=False)
        self.relu = VNReLU(width)

    def forward(
        self, chunks: list[layers.BallChunk], layer: Callable[[layers.BallChunk], Tensor]
    ) -> Tensor:
        """Maps `both` (p, 3, 2 width), which a layer gives for each chunk, to (B, 3, width)."""
        shape = chunks[-1].balls[-1] + 1, 3, self.reach.in_features
        like = chunks[0].values
        furthest, best = like.new_zeros(shape), like.new_full(shape[::2], -torch.inf)
        for chunk in chunks:
            both, balls = layer(chunk), slice(chunk.balls[0], chunk.balls[-1] + 1)
            if layers.float32_inference(both):
                bounds = np.cumsum([0, *chunk.sizes[:-1]])
                _furthest_rows(both.numpy(), bounds, best[balls].numpy(), furthest[balls].numpy())
            else:  # the only chunk
                parts = torch.split(both, chunk.sizes)[:-1]
                furthest = torch.stack([_furthest(part, dim=0) for part in parts])
        activated: Tensor = self.relu(furthest)
        return activated


class VNLinearReLU(nn.Module):
    """A linear layer and a vector ReLU, both fed by the layer's input."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.feature = nn.Linear(inputs, outputs, bias=False)
        self.direction = nn.Linear(inputs, outputs, bias=False)

    @property
    def weights(self) -> Tensor:
        """The weight that gives vectors and directions: (2 outputs, inputs)."""
        return torch.cat((self.feature.weight, self.direction.weight))


class VNReLU(nn.Module):
    """Vector ReLU along directions that are learned from the vectors themselves."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.direction = nn.Linear(width, width, bias=False)

    def forward(self, vectors: Tensor) -> Tensor:
        """Maps (M, 3, width) to the same shape."""
        directions = layers.packed_linear(self.direction.weight)
        return layers.map_chunks(
            lambda v: relu(torch.cat((v, directions(v)), dim=2)), vectors, VN_ROWS
        )


def _with_reach(layer: nn.Linear, reach: nn.Linear) -> Tensor:
    """Weights of the vectors that a maximum chooses from, and of the directions that decide.

    A choice has no gradient, so training leaves the direction map at its random initialisation,
    as in the reference system.
    """
    return torch.cat((layer.weight, (reach.weight @ layer.weight).detach()))


def relu(both: Tensor) -> Tensor:
    """Remove each vector's component against its direction, if any: (M, 3, 2C) to (M, 3, C)."""
    if layers.float32_inference(both):
        result = both.new_empty(len(both), 3, both.shape[2] // 2)
        alone = np.arange(len(both))[:, None]
        nowhere, offset = np.zeros((len(both), 3), np.float32), np.zeros(both.shape[2], np.float32)
        _gathered_relu_rows(both.numpy(), nowhere, offset, alone, result.numpy())
        return result
    vectors, directions = both.chunk(2, dim=-1)
    along = (vectors * directions).sum(dim=-2, keepdim=True).clamp(max=0.0)  # (M, 1, C)
    length_squared = directions.square().sum(dim=-2, keepdim=True)  # (M, 1, C)
    return torch.addcmul(vectors, along / (length_squared + _TINY), directions, value=-1.0)


def _convolved(u: Tensor, offset: Tensor, output: layers.Layer, batch: BallBatch) -> Tensor:
    """The furthest (P, 3, C) of the messages from each point's neighbours; reuses one buffer."""
    (count, k), width = batch.neighbors.shape, len(offset) // 2
    points, neighbors = batch.points.numpy(), batch.neighbors.numpy()
    hidden = u.new_zeros(VN_CONVOLVED * k, 3, width)
    best = np.empty((VN_CONVOLVED, width), np.float32)
    pooled = u.new_zeros(count, 3, width)
    for first in range(0, count, VN_CONVOLVED):
        part = slice(first, min(first + VN_CONVOLVED, count))
        arrays = (u.numpy(), points[part], offset.numpy(), neighbors[part], hidden.numpy())
        _gathered_relu_rows(*arrays)
        best.fill(-np.inf)
        bounds = np.arange(0, (part.stop - part.start) * k + 1, k)
        _furthest_rows(output(hidden).numpy(), bounds, best, pooled[part].numpy())
    return pooled


def _furthest(both: Tensor, dim: int) -> Tensor:
    """The furthest vectors along a dimension before the last two; the first one on ties."""
    vectors, directions = both.chunk(2, dim=-1)
    with torch.no_grad():
        reach = (vectors * directions).sum(dim=-2, keepdim=True)  # (..., 1, C)
        furthest = reach.max(dim, keepdim=True).indices  # several times faster than argmax
    return vectors.take_along_dim(furthest, dim).squeeze(dim)


@_compiled
def _gathered_relu_rows(
    u: Float32, points: Float32, offset: Float32, neighbors: Int64, result: Float32
) -> None:
    """`relu` of u_j - offset p_i for the neighbours (p, k) of each of p points."""
    width, k = result.shape[2], neighbors.shape[1]
    zero, tiny = np.float32(0.0), np.float32(_TINY)
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
def _furthest_rows(both: Float32, bounds: Int64, best: Float32, result: Float32) -> None:
    """Write the furthest vectors between consecutive `bounds` to `result`, if beyond `best`."""
    width = result.shape[2]
    furthest = np.empty(width, np.int32)
    for i in range(len(bounds) - 1):
        row, reached = result[i], best[i]
        furthest[:] = -1  # Choosing rows first and vectors after is several times faster.
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
