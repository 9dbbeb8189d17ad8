"""EdgeGraspNet on padded balls: few large operations, and nothing that waits for the device."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from edgegrasp_model.layers import gather_rows
from edgegrasp_model.network import EdgeGraspNet, GlobalFeature, PointNetConv
from edgegrasp_model.on_device.padded_balls import PaddedBalls, in_pieces
from edgegrasp_model.on_device.precision import products_in


def edge_grasp_logits(
    network: EdgeGraspNet, balls: PaddedBalls, half: torch.dtype | None = None
) -> Tensor:
    """What the network says of the edge grasps (E,), those that fill up included.

    Args:
        network: Its weights.
        balls: What to score.
        half: Type of the global features and the classifier; None: float32. The graph
            convolutions, which subtract what is nearly alike, are float32 always.
    """
    contact = balls.contact
    f1 = F.relu(_convolution(network.conv1, torch.cat((balls.points, balls.normals), 1), balls))
    f2 = F.relu(_convolution(network.conv2, f1, balls))
    f3 = F.relu(_convolution(network.conv3, f2, balls))
    own = (balls.points[contact], balls.normals[contact], balls.depth.unsqueeze(1), balls.approach)
    grasp = torch.cat((*own, f3[contact]), dim=1)
    with products_in(half, f3.device):
        ball = _ball_feature(network.ball_feature, torch.cat((f1, f2, f3), dim=1), balls)
        hidden = F.relu(network.join(grasp, ball, balls.ball_of_edge))
        logits: Tensor = network.classifier(hidden).squeeze(1)
    return logits.float()


def _convolution(layer: PointNetConv, features: Tensor, balls: PaddedBalls) -> Tensor:
    """`PointNetConv.forward`, in few pieces."""
    widths = [features.shape[1], 3]
    feature_weight, point_weight = torch.split(layer.hidden.weight, widths, dim=1)
    v = F.linear(balls.points, point_weight)
    u = F.linear(features, feature_weight, layer.hidden.bias) + v
    pooled = []
    for neighbors, here in zip(in_pieces(balls.neighbors), in_pieces(v), strict=True):
        hidden = gather_rows(u, neighbors).sub_(here.unsqueeze(1)).relu_()  # (p, k, width)
        pooled.append(F.linear(hidden, layer.output.weight).amax(dim=1))
    return torch.cat(pooled) + layer.output.bias


def _ball_feature(layer: GlobalFeature, local: Tensor, balls: PaddedBalls) -> Tensor:
    """`GlobalFeature.forward`, all balls at once."""
    ball = _ball_maximum(layer.mlp_1(local), balls)
    joined = layer.join(local, ball, balls.ball_of_point).relu_()
    return _ball_maximum(layer.mlp_2(joined), balls)


def _ball_maximum(values: Tensor, balls: PaddedBalls) -> Tensor:
    """Maximum of values (P, C) over the points of each ball: (B, C)."""
    return gather_rows(values, balls.members).amax(dim=1)
