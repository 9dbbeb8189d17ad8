"""A network as a device runs it: batches filled up to few shapes, one graph for each."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.network import EdgeGraspNet
from edgegrasp_model.on_device.captured import Captured
from edgegrasp_model.on_device.edge_network import edge_grasp_logits
from edgegrasp_model.on_device.padded_balls import (
    POINT_STEPS,
    PaddedBalls,
    bucket,
    filled,
    padded_balls,
)
from edgegrasp_model.on_device.precision import Precision, half_type, products_in
from edgegrasp_model.on_device.vn_network import vn_edge_grasp_logits
from edgegrasp_model.vn_network import VNEdgeGraspNet


class ScoringNetwork:
    """Scores batches with a network; the same logits as the network's own, up to rounding.

    Args:
        network: On the device where it is to run.
        precision: Of matrix products after the graph convolutions. `python -m benchmarks.gpu`
            says how well scores of half precision agree.
    """

    def __init__(self, network: nn.Module, precision: Precision = "float32") -> None:
        self.network = network
        self._half = half_type(precision)
        self._run = Captured(self._balls_function() or self._hand_logits)

    def __call__(self, batch: BallBatch | HandBatch) -> Tensor:
        """Logits (E,) of a batch on the network's device."""
        edges = len(batch.contact)
        if edges == 0:
            return torch.empty(0, device=batch.contact.device)
        with torch.inference_mode():
            if isinstance(batch, HandBatch):
                size = bucket(edges, POINT_STEPS)
                parts = (batch.description, batch.points, batch.point_count)
                return self._run(*(filled(part, size) for part in parts))[:edges]
            return self._run(*padded_balls(batch))[:edges]

    def _balls_function(self) -> Callable[..., Tensor] | None:
        network, half = self.network, self._half
        if isinstance(network, EdgeGraspNet):
            return lambda *parts: edge_grasp_logits(network, PaddedBalls(*parts), half)
        if isinstance(network, VNEdgeGraspNet):
            return lambda *parts: vn_edge_grasp_logits(network, PaddedBalls(*parts), half)
        return None

    def _hand_logits(self, description: Tensor, points: Tensor, point_count: Tensor) -> Tensor:
        with products_in(self._half, points.device):
            logits: Tensor = self.network(HandBatch(description, points, point_count, 0))
        return logits.float()
