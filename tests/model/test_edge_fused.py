"""EdgeGraspNet's compiled graph convolution."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edgegrasp_model import compiled
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import EDGEGRASP_SMALL

pytest.importorskip("numba", reason="the extra `fast` is not installed")


def test_a_compiled_convolution_is_the_plain_one(random_scene, monkeypatch):
    layer = build_network(EDGEGRASP_SMALL).conv2
    batch = random_scene(1).batch(torch.float32)
    features = torch.randn(len(batch.points), 32, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        fused = layer(features, batch)
        monkeypatch.setattr(compiled, "find_spec", lambda name: None)
        plain = layer(features, batch)
    assert plain.std() > 0.01
    np.testing.assert_allclose(fused.numpy(), plain.numpy(), rtol=0, atol=1e-6)
    assert not np.array_equal(fused.numpy(), plain.numpy())  # two ways, not one twice
