"""EdgeGraspNet: scores edge grasps from local, global and grasp features.

Huang, Wang, Zhu, Walters, Platt: "Edge Grasp Network: A Graph-Based SE(3)-invariant Approach to
Grasp Detection", ICRA 2023, section IV. Widths below are the paper's; P points, B balls, E grasps.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.compiled import fused
from edgegrasp_model.hand_network import HandNet
from edgegrasp_model.layers import SharedLinear, gather_rows, mlp
from edgegrasp_model.network_config import Architecture, NetworkConfig
from edgegrasp_model.pieces import (
    CONVOLVED,
    EDGE_ROWS,
    BallMaximum,
    ball_pieces,
    in_pieces,
    maximum,
)
from edgegrasp_model.products import MlpProducts, Product, row_linear
from edgegrasp_model.vn_network import VNEdgeGraspNet

GRASP_WIDTH = 3 + 3 + 1 + 3  # contact point, its normal, depth, approach direction


class PointNetConv(nn.Module):
    """Graph convolution: a two-layer MLP on [f_j, p_j - p_i], maximum over neighbours j."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs + 3, width)
        self.output = nn.Linear(width, width)

    def forward(self, features: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, inputs) to (P, width)."""
        if (edge_fused := fused("edge_fused", features)) is not None:
            fused_features: Tensor = edge_fused.convolution(self, features, batch)
            return fused_features
        # W [f_j, p_j - p_i] + b = u_j - v_i: the first layer runs per point, not per neighbour.
        widths = [features.shape[1], 3]
        feature_weight, point_weight = torch.split(self.hidden.weight, widths, dim=1)
        v = row_linear(batch.points, point_weight)  # (P, width)
        u = row_linear(features, feature_weight, self.hidden.bias) + v  # (P, width)
        output, pooled = Product(self.output.weight), []
        for neighbors, v_here in in_pieces(CONVOLVED, batch.neighbors, v):
            hidden = gather_rows(u, neighbors).sub_(v_here.unsqueeze(1)).relu_()  # (p, k, width)
            pooled.append(maximum(output(hidden), dim=1))  # (p, width)
        # The bias is the same for all neighbours: added once, after the maximum.
        return torch.cat(pooled)[: len(v)] + self.output.bias


class GlobalFeature(nn.Module):
    """One feature per ball: MLP, maximum over the ball, joined to each point; the same again."""

    def __init__(self, inputs: int, widths_1: tuple[int, ...], widths_2: tuple[int, ...]) -> None:
        super().__init__()
        self.mlp_1 = mlp((inputs, *widths_1))
        self.join = SharedLinear(inputs + widths_1[-1], widths_2[0])
        self.mlp_2 = mlp(widths_2)

    def forward(self, local: Tensor, batch: BallBatch) -> Tensor:
        """Maps point features (P, 224) to ball features (B, 1024)."""
        pieces = ball_pieces(local, batch)
        mlp_1, maximum_1 = MlpProducts(self.mlp_1), BallMaximum(batch.num_balls)
        for piece in pieces:
            maximum_1.add(mlp_1(piece.values), piece)
        join = self.join.on(maximum_1.result())  # of (B, 512)
        mlp_2, maximum_2 = MlpProducts(self.mlp_2), BallMaximum(batch.num_balls)
        for piece in pieces:
            joined = join(piece.values, piece.ball_of_point).relu_()  # (p, 1024)
            maximum_2.add(mlp_2(joined), piece)
        return maximum_2.result()


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
        self.join = SharedLinear(
            own_width + config.global_widths_2[-1], config.classifier_widths[0]
        )
        self.classifier = mlp((*config.classifier_widths, 1))

    def forward(self, batch: BallBatch) -> Tensor:
        """Scores the edge grasps of a batch: logits (E,) of success."""
        f1 = F.relu(self.conv1(torch.cat((batch.points, batch.normals), dim=1), batch))  # (P, 32)
        f2 = F.relu(self.conv2(f1, batch))  # (P, 64)
        f3 = F.relu(self.conv3(f2, batch))  # (P, 128)
        ball = self.ball_feature(torch.cat((f1, f2, f3), dim=1), batch)  # (B, 1024)
        grasp = torch.cat((self._grasp_features(batch), f3[batch.contact]), dim=1)  # (E, 138)
        join, classifier, logits = self.join.on(ball), MlpProducts(self.classifier), []
        for own, ball_of_edge in in_pieces(EDGE_ROWS, grasp, batch.ball_of_edge):
            logits.append(classifier(join(own, ball_of_edge).relu_()))  # (e, 1)
        return torch.cat(logits).squeeze(1)[: len(grasp)]

    def _grasp_features(self, batch: BallBatch) -> Tensor:
        """What is told of each grasp itself, (E, 10)."""
        contact = batch.contact
        parts = (
            batch.points[contact],
            batch.normals[contact],
            batch.depth.unsqueeze(1),
            batch.approach,
        )
        return torch.cat(parts, dim=1)


def _int8_network(config: NetworkConfig) -> nn.Module:
    from edgegrasp_model.int8_network import Int8EdgeGraspNet  # it imports this file

    return Int8EdgeGraspNet(config)


NETWORKS: dict[Architecture, Callable[[NetworkConfig], nn.Module]] = {
    "edgegrasp": EdgeGraspNet,
    "edgegrasp-int8": _int8_network,
    "vn-edgegrasp": VNEdgeGraspNet,
    "hand": HandNet,
}


def build_network(config: NetworkConfig, generator: torch.Generator | None = None) -> nn.Module:
    """Builds a network with random weights.

    Args:
        config: Its architecture and widths.
        generator: Source of the weights; without one, those of seed 0.
    """
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    # The layers first initialise themselves from the global stream: leave it as it was.
    with torch.random.fork_rng(devices=[]):
        network = NETWORKS[config.architecture](config)
    for module in network.modules():
        if isinstance(module, nn.Linear):
            # PyTorch's own default, U(-1, 1) / sqrt(inputs), but from the given generator.
            bound = module.in_features**-0.5
            nn.init.uniform_(module.weight, -bound, bound, generator=generator)
            if module.bias is not None:
                nn.init.uniform_(module.bias, -bound, bound, generator=generator)
    return network
