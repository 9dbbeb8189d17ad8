"""The textbook implementation computes what ours computes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from benchmarks.textbook.networks import edge_grasp_logits, vn_edge_grasp_logits

from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import NetworkConfig

WIDTHS = {"conv_widths": (8, 8, 16), "global_widths_2": (24, 24), "classifier_widths": (16,)}


def network(architecture: str) -> torch.nn.Module:
    config = NetworkConfig(architecture=architecture, global_widths_1=(16, 16, 16), **WIDTHS)
    return build_network(config).double()


@pytest.fixture(scope="module")
def batch() -> BallBatch:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 0.12, (400, 3)).astype(np.float32)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    approach_index = np.array([3, 50, 200])
    crop = crop_balls(points, approach_index, 0.05)
    contact = np.arange(0, len(crop.ball_rows), 7)
    approach = rng.normal(size=(len(contact), 3))
    made = BallBatch.from_cloud(
        points, normals, approach_index, crop, contact, approach, rng.uniform(0, 0.04, len(contact))
    )
    return BallBatch(
        points=made.points.double(),
        normals=made.normals.double(),
        neighbors=made.neighbors,
        ball_of_point=made.ball_of_point,
        num_balls=made.num_balls,
        contact=made.contact,
        approach=made.approach.double(),
        depth=made.depth.double(),
    )


@pytest.mark.parametrize(
    ("architecture", "textbook"),
    [("edgegrasp", edge_grasp_logits), ("vn-edgegrasp", vn_edge_grasp_logits)],
)
def test_logits_are_those_of_the_network(architecture: str, textbook, batch: BallBatch) -> None:
    ours = network(architecture)
    with torch.no_grad():
        expected, found = ours(batch), textbook(ours, batch)
    assert expected.std() > 1e-6
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
