"""EdgeGraspNet as the paper writes it: edge features are laid out, nothing is factored."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.edgegrasp import EdgeGraspNet, GlobalFeature, PointNetConv


def edge_grasp_logits(network: EdgeGraspNet, batch: BallBatch) -> Tensor:
    """Logits (E,) of a network's weights, computed from scratch."""
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
