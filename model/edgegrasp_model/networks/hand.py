"""HandNet: scores edge grasps from what each hand sees in its own frame.

A PointNet over the points around the fingers, beside the hand description. Where the paper's
network shares one ball among all its edge grasps and has to learn what a rotation does, this one
sees each edge grasp in the frame of its own hand: invariant by construction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_camera.arrays import Float32, Int64
from edgegrasp_model.candidates.collision import hand_views
from edgegrasp_model.candidates.edge_grasps import Candidates
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import (
    HAND_DESCRIPTION_SIZE,
    describe_hands,
    points_around_fingers,
)
from edgegrasp_model.kernels import compiled
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.networks.layers import (
    EDGE_ROWS,
    PackedMlp,
    by_chunks,
    float32_inference,
    in_chunks,
    maximum,
    mlp,
)
from edgegrasp_model.scene.scene import Surroundings

POINT_UNIT = 0.05  # metres; scale of the positions around the fingers
DROPOUT = 0.1  # dropout of the classifier's inputs
CONSTANT = 1e-6  # standard deviation below which a number of the description counts as constant
CHUNK = 64  # hands at a time, so that the work stays in cache


@dataclass(frozen=True)
class HandBatch:
    """E edge grasps, each with the points near its hand. Metres."""

    description: Tensor  # (E, F) float32, F at least what the network reads
    points: Tensor  # (E, P, 6) float32, positions and normals around the fingers, hand frame
    point_count: Tensor  # (E,) int64, how many of the P there are; zeros follow

    @classmethod
    def of_hands(
        cls,
        around: Surroundings,
        candidates: Candidates,
        gripper: Gripper,  # open to its maximum
        num_points: int,
        description_size: int = HAND_DESCRIPTION_SIZE,
    ) -> Self:
        """The view of each candidate's hand, with at most `num_points` points."""
        T_cloud_hand = candidates.T_cloud_hand
        view = hand_views(around.cloud, T_cloud_hand, gripper)
        description = describe_hands(around, candidates, gripper, view, description_size)
        points, count = points_around_fingers(around, T_cloud_hand, gripper, view, num_points)
        return cls(torch.from_numpy(description), torch.from_numpy(points), torch.from_numpy(count))

    @staticmethod
    def concatenate(batches: Sequence["HandBatch"]) -> "HandBatch":
        """Join batches into one, as training does; scores come out in the same order."""
        parts = zip(*(vars(batch).values() for batch in batches), strict=True)
        return HandBatch(*map(torch.cat, parts))

    @classmethod
    def made_up(cls, config: NetworkConfig) -> Self:
        """A fixed batch of 32 hands, for checking that a network still computes the same logits."""
        rng = np.random.default_rng(0)
        description = rng.normal(size=(32, config.description_size))
        points = rng.normal(size=(32, config.hand_points, 6)) * (0.02, 0.02, 0.02, 1.0, 1.0, 1.0)
        count = rng.integers(0, config.hand_points + 1, 32)
        return cls(
            torch.from_numpy(description.astype(np.float32)),
            torch.from_numpy(points.astype(np.float32)),
            torch.from_numpy(count),
        )

    def to(self, device: torch.device | str) -> "HandBatch":
        """Moves every tensor to a device."""
        return HandBatch(*(tensor.to(device) for tensor in vars(self).values()))


class HandNet(nn.Module):
    """E edge grasps, P points around the fingers of each."""

    mean: Tensor  # (F,) of the training data's descriptions
    std: Tensor  # (F,)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(config.description_size))
        self.register_buffer("std", torch.ones(config.description_size))
        self.point_encoder = mlp((6, *config.hand_widths))
        inputs = config.description_size + 2 * config.hand_widths[-1]
        self.classifier = mlp((inputs, *config.classifier_widths, 1))

    def set_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Stores mean (F,) and standard deviation (F,) of the training data's descriptions."""
        size = self.config.description_size
        self.mean.copy_(mean[:size])
        # A number that never varied in training, such as the only hand's opening, must have little
        # weight.
        self.std.copy_(torch.where(std < CONSTANT, 1.0, std.clamp_min(1e-3))[:size])

    def forward(self, batch: HandBatch, left_out: torch.Generator | None = None) -> Tensor:
        """Logits (E,) of success; in training `left_out` draws what dropout removes."""
        known = batch.description[:, : self.config.description_size]
        description = (known - self.mean) / self.std  # (E, F)
        encoder = PackedMlp(self.point_encoder)
        chunks = in_chunks(CHUNK, batch.points, batch.point_count)
        around = torch.cat([_around(encoder, *chunk) for chunk in chunks])
        around = around[: len(description)]  # (E, 2 C)
        seen = torch.cat((description, around), dim=1)
        if left_out is not None:
            draws = torch.rand(seen.shape, generator=left_out, device=left_out.device)
            seen = seen * (draws >= DROPOUT).to(seen.device) / (1.0 - DROPOUT)
        logits = by_chunks(PackedMlp(self.classifier), seen, EDGE_ROWS)
        return logits.squeeze(1)  # (E,)


def _around(encoder: PackedMlp, points: Tensor, count: Tensor) -> Tensor:
    """Maximum and mean of the features of the valid points of (E, P, 6): (E, 2 C)."""
    positions, normals = torch.split(points, 3, dim=2)
    unit = torch.cat((positions / POINT_UNIT, normals), dim=2)  # (E, P, 6)
    encoded = encoder(unit)  # (E, P, C)
    if float32_inference(encoded):
        pooled = torch.zeros(len(encoded), 2 * encoded.shape[2])
        _pool(encoded.numpy(), count.numpy(), pooled.numpy())
        return pooled
    there = torch.arange(points.shape[1], device=points.device) < count.unsqueeze(1)  # (E, P)
    features = F.relu(encoded) * there.unsqueeze(2)  # (E, P, C), none below 0
    mean = features.sum(dim=1) / count.clamp_min(1).unsqueeze(1)  # (E, C)
    return torch.cat((maximum(features, dim=1), mean), dim=1)  # (E, 2 C)


@compiled("contract", "nsz")
def _pool(features: Float32, count: Int64, pooled: Float32) -> None:
    """Maximum and mean of the ReLU of the first `count` (E,) of features (E, P, C)."""
    channels = features.shape[2]
    zero = np.float32(0.0)
    for e in range(len(count)):
        largest, mean = pooled[e, :channels], pooled[e, channels:]
        for p in range(count[e]):
            here = features[e, p]
            for c in range(channels):
                value = max(here[c], zero)
                largest[c] = max(largest[c], value)
                mean[c] += value
        for c in range(channels):
            mean[c] /= np.float32(max(count[e], 1))
