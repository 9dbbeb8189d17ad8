"""The paper's networks as the papers write them: edge features laid out, nothing factored.

Each computes the logits of a network's weights from scratch. Vector features are (..., C, 3), the
vector last, as in the Vector Neurons paper.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.edgegrasp import EdgeGraspNet, GlobalFeature, PointNetConv
from edgegrasp_model.networks.vn_edgegrasp import (
    VNBallMaximum,
    VNEdgeGraspNet,
    VNGlobalFeature,
    VNLinearReLU,
    VNPointNetConv,
    VNReLU,
    VNSharedLinearReLU,
)


def edge_grasp_logits(network: EdgeGraspNet, batch: BallBatch) -> Tensor:
    """Logits (E,) of EdgeGraspNet."""
    f1 = F.relu(_convolution(network.conv1, torch.cat((batch.points, batch.normals), 1), batch))
    f2 = F.relu(_convolution(network.conv2, f1, batch))
    f3 = F.relu(_convolution(network.conv3, f2, batch))
    ball = _ball_feature(network.ball_feature, torch.cat((f1, f2, f3), 1), batch)
    contact = batch.contact
    edge = torch.cat(
        (
            batch.points[contact],
            batch.normals[contact],
            batch.depth[:, None],
            batch.approach,
            f3[contact],
            ball[batch.ball_of_point[contact]],
        ),
        dim=1,
    )
    hidden = F.relu(F.linear(edge, network.join.weight, network.join.bias))
    logits: Tensor = network.classifier(hidden)[:, 0]
    return logits


def vn_edge_grasp_logits(network: VNEdgeGraspNet, batch: BallBatch) -> Tensor:
    """Logits (E,) of VNEdgeGraspNet."""
    f1 = _vn_convolution(network.conv1, torch.stack((batch.points, batch.normals), 1), batch)
    f2 = _vn_convolution(network.conv2, f1, batch)
    f3 = _vn_convolution(network.conv3, f2, batch)
    ball = _vn_ball_feature(network.ball_feature, torch.cat((f1, f2, f3), 1), batch)
    contact = batch.contact
    named = torch.stack((batch.approach, batch.points[contact], batch.normals[contact]), 1)
    edge = torch.cat((named, f3[contact], ball[batch.ball_of_point[contact]]), 1)  # (E, C, 3)
    frame = _linear_relu(network.frame_2, _linear_relu(network.frame_1, edge))
    frame = _linear(network.frame_3, frame)  # (E, 3, 3)
    invariant = torch.einsum("ecd,efd->ecf", edge, frame).flatten(1)
    logits: Tensor = network.classifier(invariant)[:, 0]
    return logits


def _convolution(layer: PointNetConv, features: Tensor, batch: BallBatch) -> Tensor:
    offsets = batch.points[batch.neighbors] - batch.points[:, None]  # (P, k, 3)
    edges = torch.cat((features[batch.neighbors], offsets), dim=2)  # (P, k, inputs + 3)
    messages: Tensor = layer.output(F.relu(layer.hidden(edges)))  # (P, k, width)
    return messages.max(dim=1).values


def _ball_feature(layer: GlobalFeature, local: Tensor, batch: BallBatch) -> Tensor:
    ball = _ball_maximum(layer.mlp_1(local), batch)
    joined = torch.cat((local, ball[batch.ball_of_point]), dim=1)
    hidden = F.relu(F.linear(joined, layer.join.weight, layer.join.bias))
    return _ball_maximum(layer.mlp_2(hidden), batch)


def _ball_maximum(values: Tensor, batch: BallBatch) -> Tensor:
    balls = [values[batch.ball_of_point == ball] for ball in range(batch.num_balls)]
    return torch.stack([ball.max(dim=0).values for ball in balls])


def _linear(layer: nn.Linear, vectors: Tensor) -> Tensor:
    mapped: Tensor = F.linear(vectors.transpose(-1, -2), layer.weight)
    return mapped.transpose(-1, -2)


def _relu(vectors: Tensor, directions: Tensor) -> Tensor:
    along = (vectors * directions).sum(-1, keepdim=True)
    length_squared = (directions * directions).sum(-1, keepdim=True)
    rest = vectors - along / (length_squared + 1e-7) * directions
    return torch.where(along >= 0, vectors, rest)


def _own_relu(layer: VNReLU, vectors: Tensor) -> Tensor:
    return _relu(vectors, _linear(layer.direction, vectors))


def _linear_relu(layer: VNLinearReLU | VNSharedLinearReLU, vectors: Tensor) -> Tensor:
    return _relu(_linear(layer.feature, vectors), _linear(layer.direction, vectors))


def _furthest(vectors: Tensor, reach: nn.Linear, dim: int) -> Tensor:
    along = (vectors * _linear(reach, vectors)).sum(-1, keepdim=True)
    return vectors.take_along_dim(along.argmax(dim, keepdim=True), dim).squeeze(dim)


def _vn_convolution(layer: VNPointNetConv, features: Tensor, batch: BallBatch) -> Tensor:
    offsets = batch.points[batch.neighbors] - batch.points[:, None]  # (P, k, 3)
    edges = torch.cat((features[batch.neighbors], offsets[:, :, None]), 2)  # (P, k, C + 1, 3)
    hidden = _own_relu(layer.hidden_relu, _linear(layer.hidden, edges))
    messages = _linear(layer.output, hidden)
    return _own_relu(layer.output_relu, _furthest(messages, layer.reach, dim=1))


def _vn_ball_maximum(layer: VNBallMaximum, vectors: Tensor, batch: BallBatch) -> Tensor:
    balls = [vectors[batch.ball_of_point == ball] for ball in range(batch.num_balls)]
    return _own_relu(layer.relu, torch.stack([_furthest(ball, layer.reach, 0) for ball in balls]))


def _vn_ball_feature(layer: VNGlobalFeature, local: Tensor, batch: BallBatch) -> Tensor:
    hidden = _linear(layer.vn_3, _linear_relu(layer.vn_2, _linear_relu(layer.vn_1, local)))
    ball = _vn_ball_maximum(layer.maximum_1, hidden, batch)
    joined = torch.cat((local, ball[batch.ball_of_point]), 1)
    return _vn_ball_maximum(
        layer.maximum_2, _linear(layer.vn_5, _linear_relu(layer.join, joined)), batch
    )
