"""VNEdgeGraspNet on padded balls: few large operations, and nothing that waits for the device."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from edgegrasp_model.layers import gather_rows
from edgegrasp_model.on_device.padded_balls import PaddedBalls, in_pieces
from edgegrasp_model.on_device.precision import products_in
from edgegrasp_model.vn_layers import vector_maximum, vector_relu
from edgegrasp_model.vn_network import (
    VNBallMaximum,
    VNEdgeGraspNet,
    VNGlobalFeature,
    VNPointNetConv,
)


def vn_edge_grasp_logits(
    network: VNEdgeGraspNet, balls: PaddedBalls, half: torch.dtype | None = None
) -> Tensor:
    """What the network says of the edge grasps (E,), those that fill up included.

    Args:
        network: Its weights.
        balls: What to score.
        half: Type of the global features and what follows; None: float32. The graph convolutions
            are float32 always.
    """
    contact = balls.contact
    f1 = _convolution(network.conv1, torch.stack((balls.points, balls.normals), dim=2), balls)
    f2 = _convolution(network.conv2, f1, balls)
    f3 = _convolution(network.conv3, f2, balls)
    named = torch.stack((balls.approach, balls.points[contact], balls.normals[contact]), dim=2)
    grasp = torch.cat((named, f3[contact]), dim=2)
    with products_in(half, f3.device):
        ball = _ball_feature(network.ball_feature, torch.cat((f1, f2, f3), dim=2), balls)
        frame = network.frame_1(grasp, ball, balls.ball_of_edge)
        frame = network.frame_3(network.frame_2(frame))
        vectors = torch.cat((grasp, ball.float()[balls.ball_of_edge]), dim=2)
        invariant = (vectors.transpose(1, 2) @ frame.float()).flatten(1)
        logits: Tensor = network.classifier(invariant).squeeze(1)
    return logits.float()


def _convolution(layer: VNPointNetConv, features: Tensor, balls: PaddedBalls) -> Tensor:
    """`VNPointNetConv.forward`, in few pieces."""
    widths = [features.shape[2], 1]
    feature_weight, point_weight = torch.split(layer.hidden.weight, widths, dim=1)
    v = F.linear(balls.points.unsqueeze(2), point_weight)
    u = F.linear(features, feature_weight) + v
    u_way, v_way = layer.hidden_relu.direction(u), layer.hidden_relu.direction(v)
    pooled = []
    for neighbors, here, way in zip(*map(in_pieces, (balls.neighbors, v, v_way)), strict=True):
        hidden = vector_relu(
            gather_rows(u, neighbors).sub_(here.unsqueeze(1)),
            gather_rows(u_way, neighbors).sub_(way.unsqueeze(1)),
        )  # (p, k, 3, width)
        pooled.append(vector_maximum(layer.output(hidden), layer.reach, dim=1))
    vectors: Tensor = layer.output_relu(torch.cat(pooled))
    return vectors


def _ball_feature(layer: VNGlobalFeature, local: Tensor, balls: PaddedBalls) -> Tensor:
    """`VNGlobalFeature.forward`, all balls at once."""
    hidden = layer.vn_3(layer.vn_2(layer.vn_1(local)))
    pooled = _ball_maximum(layer.maximum_1, hidden, balls)
    joined = layer.join(local, pooled, balls.ball_of_point)
    return _ball_maximum(layer.maximum_2, layer.vn_5(joined), balls)


def _ball_maximum(layer: VNBallMaximum, vectors: Tensor, balls: PaddedBalls) -> Tensor:
    """`VNBallMaximum.forward` of vectors (P, 3, C): (B, 3, C)."""
    reach = (vectors * layer.reach(vectors)).sum(dim=1)  # (P, C)
    furthest = gather_rows(reach, balls.members).max(dim=1).indices  # (B, C)
    rows = balls.members.gather(1, furthest).unsqueeze(1).expand(-1, 3, -1)
    pooled: Tensor = layer.relu(vectors.gather(0, rows))
    return pooled
