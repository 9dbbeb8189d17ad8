"""VNEdgeGraspNet: EdgeGraspNet on vector neurons; its scores do not change when the cloud turns.

Huang et al., ICRA 2023, section IV-D, with the widths of the authors' release. Features are
(M, 3, C), see `vn_layers`; P points in B balls, E grasps.
"""

import torch
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.compiled import fused
from edgegrasp_model.layers import RowLinear, gather_rows, mlp
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.pieces import CONVOLVED, in_pieces
from edgegrasp_model.products import row_linear
from edgegrasp_model.vn_layers import (
    VNLinearReLU,
    VNReLU,
    VNSharedLinearReLU,
    vector_maximum,
    vector_relu,
)


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
        if (vn_fused := fused("vn_fused", features)) is not None:
            fused_vectors: Tensor = vn_fused.convolution(self, features, batch)
            return fused_vectors
        # W [f_j, p_j - p_i] = u_j - v_i, and the ReLU's direction likewise: both run per point.
        widths = [features.shape[2], 1]
        feature_weight, point_weight = torch.split(self.hidden.weight, widths, dim=1)
        v = row_linear(batch.points.unsqueeze(2), point_weight)  # (P, 3, width)
        u = row_linear(features, feature_weight) + v  # (P, 3, width)
        u_direction, v_direction = self.hidden_relu.direction(u), self.hidden_relu.direction(v)
        pooled = []
        for neighbors, v_here, v_direction_here in in_pieces(
            CONVOLVED, batch.neighbors, v, v_direction
        ):
            hidden = gather_rows(u, neighbors) - v_here.unsqueeze(1)  # (p, k, 3, width)
            direction = gather_rows(u_direction, neighbors) - v_direction_here.unsqueeze(1)
            messages = self.output(vector_relu(hidden, direction))  # (p, k, 3, width)
            pooled.append(vector_maximum(messages, self.reach, dim=1))
        vectors: Tensor = self.output_relu(torch.cat(pooled)[: len(v)])
        return vectors


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
        if (vn_fused := fused("vn_fused", local)) is not None:
            fused_ball: Tensor = vn_fused.ball_feature(self, local, batch)
            return fused_ball
        hidden = self.vn_3(self.vn_2(self.vn_1(local)))  # (P, 3, 128)
        pooled = self.maximum_1(hidden, batch)  # (B, 3, 128)
        joined = self.join(local, pooled, batch.ball_of_point)  # (P, 3, 381)
        ball: Tensor = self.maximum_2(self.vn_5(joined), batch)
        return ball


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
        if (vn_fused := fused("vn_fused", ball)) is not None:
            fused_logits: Tensor = vn_fused.logits(self, grasp, ball, batch.ball_of_edge)
            return fused_logits

        # Three vectors learned from the grasp turn with it: coordinates along them are invariant.
        frame = self.frame_3(self.frame_2(self.frame_1(grasp, ball, batch.ball_of_edge)))
        vectors = torch.cat((grasp, ball[batch.ball_of_edge]), dim=2)  # (E, 3, 512)
        invariant = (vectors.transpose(1, 2) @ frame).flatten(1)  # (E, 512, 3) -> (E, 1536)
        logits: Tensor = self.classifier(invariant).squeeze(1)  # (E, 1) -> (E,)
        return logits
