"""EdgeGraspNet: scores edge grasps from local, global and grasp features.

Huang, Wang, Zhu, Walters, Platt: "Edge Grasp Network: A Graph-Based SE(3)-invariant Approach to
Grasp Detection", ICRA 2023, section IV. Widths below are the paper's; P points, B balls, E grasps.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_model.networks import layers
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.config import NetworkConfig

GRASP_WIDTH = 3 + 3 + 1 + 3  # contact point, its normal, depth, approach direction


class EdgeGraspNet(nn.Module):
    """The paper's network."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        width_1, width_2, width_3 = config.conv_widths
        self.conv1 = PointNetConv(3 + 3, width_1)
        self.conv2 = PointNetConv(width_1, width_2)
        self.conv3 = PointNetConv(width_2, width_3)
        self.ball_feature = GlobalFeature(
            config.local_width, config.global_widths_1, config.global_widths_2
        )
        own_width = GRASP_WIDTH + width_3
        self.join = nn.Linear(own_width + config.global_widths_2[-1], config.classifier_widths[0])
        self.classifier = layers.mlp((*config.classifier_widths, 1))

    def forward(self, batch: BallBatch) -> Tensor:
        """Scores the edge grasps of a batch: logits (E,) of success."""
        f1 = F.relu(self.conv1(torch.cat((batch.points, batch.normals), dim=1), batch))  # (P, 32)
        f2 = F.relu(self.conv2(f1, batch))  # (P, 64)
        f3 = F.relu(self.conv3(f2, batch))  # (P, 128)
        ball = self.ball_feature(torch.cat((f1, f2, f3), dim=1), batch)  # (B, 1024)
        contact, depth = batch.contact, batch.depth.unsqueeze(1)
        own = batch.points[contact], batch.normals[contact], depth, batch.approach, f3[contact]
        grasp = torch.cat(own, dim=1)  # (E, 138)
        join = layers.shared_product(self.join.weight, self.join.bias, ball)
        classifier, logits = layers.packed(self.classifier), []
        for rows, ball_of_edge in layers.split_chunks(layers.EDGE_ROWS, grasp, batch.ball_of_edge):
            logits.append(classifier(join(rows, ball_of_edge).relu_()))  # (e, 1)
        return torch.cat(logits).squeeze(1)[: len(grasp)]


class PointNetConv(nn.Module):
    """Graph convolution: a two-layer MLP on [f_j, p_j - p_i], maximum over neighbours j."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs + 3, width)
        self.output = nn.Linear(width, width)

    def forward(self, features: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, inputs) to (P, width)."""
        # W [f_j, p_j - p_i] + b = W [f_j, p_j] + b - V p_i: the product runs per point.
        weight, output = self.hidden.weight, layers.packed_linear(self.output.weight)
        u = torch.cat((features, batch.points), dim=1)
        u = layers.map_chunks(layers.packed_linear(weight, self.hidden.bias), u)  # (P, width)
        # The bias is the same for all neighbours, so it is added once, after the maximum.
        here, pooled = batch.points @ weight[:, -3:].t(), []  # (P, width)
        for neighbors, own in layers.split_chunks(layers.CONVOLVED, batch.neighbors, here):
            there = layers.gather_rows(u, neighbors)  # (p, k, width)
            hidden = there.sub_(own.unsqueeze(1)).relu_()
            pooled.append(layers.maximum(output(hidden), dim=1))  # (p, width)
        return torch.cat(pooled)[: len(features)] + self.output.bias


class GlobalFeature(nn.Module):
    """One feature per ball: an MLP and a maximum, joined to each point; then both again."""

    def __init__(self, inputs: int, widths_1: tuple[int, ...], widths_2: tuple[int, ...]) -> None:
        super().__init__()
        self.mlp_1 = layers.mlp((inputs, *widths_1))
        self.join = nn.Linear(inputs + widths_1[-1], widths_2[0])
        self.mlp_2 = layers.mlp(widths_2)

    def forward(self, local: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 224) to ball features (B, 1024)."""
        chunks = layers.ball_chunks(local, batch)
        mlp_1, mlp_2 = layers.packed(self.mlp_1), layers.packed(self.mlp_2)
        pooled = layers.ball_maximum(chunks, lambda chunk: mlp_1(chunk.values))  # (B, 512)
        join = layers.shared_product(self.join.weight, self.join.bias, pooled)
        return layers.ball_maximum(
            chunks, lambda chunk: mlp_2(join(chunk.values, chunk.ball_of_point).relu_())
        )
