"""HandNet: scores edge grasps from what each hand sees in its own frame.

A PointNet over the points around the fingers, beside the hand description. Where the paper's
network shares one ball among all its edge grasps and has to learn what a rotation does, this one
sees each edge grasp in the frame of its own hand: invariant by construction.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE
from edgegrasp_model.layers import mlp
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.pieces import EDGE_ROWS, by_pieces, in_pieces, maximum
from edgegrasp_model.products import MlpProducts

POINT_UNIT = 0.05  # metres; positions around the fingers are a few centimetres
DROPOUT = 0.1  # share of what the classifier reads that a training step leaves out
PIECE = 32  # hands at a time, so that the work stays in cache


class HandNet(nn.Module):
    """E edge grasps, P points around the fingers of each."""

    mean: Tensor  # (F,) of the training data's descriptions
    std: Tensor  # (F,)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(HAND_DESCRIPTION_SIZE))
        self.register_buffer("std", torch.ones(HAND_DESCRIPTION_SIZE))
        self.point_encoder = mlp((6, *config.hand_widths))
        inputs = HAND_DESCRIPTION_SIZE + 2 * config.hand_widths[-1]
        self.classifier = mlp((inputs, *config.classifier_widths, 1))

    def set_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Stores mean (F,) and standard deviation (F,) of the training data's descriptions."""
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(1e-3))

    def forward(self, batch: HandBatch, left_out: torch.Generator | None = None) -> Tensor:
        """Scores the edge grasps of a batch: logits (E,) of success.

        Args:
            batch: What E hands see.
            left_out: In training, draws what the classifier is not told; None: it is told all.
        """
        description = (batch.description - self.mean) / self.std  # (E, F)
        encoder = MlpProducts(self.point_encoder)
        pieces = [
            _around(encoder, points, count)
            for points, count in in_pieces(PIECE, batch.points, batch.point_count)
        ]
        around = torch.cat(pieces)[: len(description)]  # (E, 2 C)
        seen = torch.cat((description, around), dim=1)
        if left_out is not None:
            draws = torch.rand(seen.shape, generator=left_out, device=left_out.device)
            seen = seen * (draws >= DROPOUT).to(seen.device) / (1.0 - DROPOUT)
        logits = by_pieces(MlpProducts(self.classifier), seen, EDGE_ROWS)
        return logits.squeeze(1)  # (E,)


def _around(encoder: MlpProducts, points: Tensor, count: Tensor) -> Tensor:
    """Maximum and mean over the points (E, P, 6) that there are of their features: (E, 2 C)."""
    positions, normals = torch.split(points, 3, dim=2)
    unit = torch.cat((positions / POINT_UNIT, normals), dim=2)  # (E, P, 6)
    there = torch.arange(points.shape[1], device=points.device) < count.unsqueeze(1)  # (E, P)
    features = F.relu(encoder(unit)) * there.unsqueeze(2)  # (E, P, C), none below 0
    mean = features.sum(dim=1) / count.clamp_min(1).unsqueeze(1)  # (E, C)
    return torch.cat((maximum(features, dim=1), mean), dim=1)  # (E, 2 C)
