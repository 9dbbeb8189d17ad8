"""The textbook networks compute what ours compute, with none of the savings."""

import pytest
import torch
from benchmarks.textbook.networks import edge_grasp_logits, vn_edge_grasp_logits

from edgegrasp_model.networks.checkpoint import build_network

from ..model.scenes import TINY, RandomScene


@pytest.mark.parametrize(
    ("architecture", "textbook"),
    [("edgegrasp", edge_grasp_logits), ("vn-edgegrasp", vn_edge_grasp_logits)],
)
def test_logits_are_those_of_the_network(architecture: str, textbook) -> None:
    ours, batch = build_network(TINY[architecture]).double(), RandomScene.of_seed(1).batch()
    with torch.no_grad():
        expected, found = ours(batch), textbook(ours, batch)
    assert expected.std() > 1e-6
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
