from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp_model import compiled
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.vn_edgegrasp import vector_maximum, vector_relu

pytest.importorskip("numba", reason="the extra `fast` is not installed")
vn_fused = pytest.importorskip("edgegrasp_model.vn_fused")

SEEDS = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def network(tiny_config):
    return build_network(replace(tiny_config, architecture="vn-edgegrasp"))


@pytest.fixture
def without_numba(monkeypatch):
    monkeypatch.setattr(compiled, "find_spec", lambda name: None)


def random_vectors(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def single(batch: BallBatch) -> BallBatch:
    """The batch in single precision, as the pipeline makes it."""
    names = ("points", "normals", "approach", "depth")
    return replace(batch, **{name: getattr(batch, name).float() for name in names})


def scores(network: torch.nn.Module, batch: BallBatch) -> np.ndarray:
    with torch.inference_mode():
        return network(batch).numpy()


def test_inference_scores_as_the_plain_layers_do(random_scene, network, monkeypatch):
    batches = [single(random_scene(seed).batch()) for seed in range(6)]
    fused = [scores(network, batch) for batch in batches]
    monkeypatch.setattr(compiled, "find_spec", lambda name: None)
    plain = [scores(network, batch) for batch in batches]
    # A near tie may fall to another vector, in a scene at most.
    close = [
        np.allclose(a, b, rtol=0, atol=0.05 * b.std()) for a, b in zip(fused, plain, strict=True)
    ]
    assert sum(close) >= 5


def test_only_inference_in_float32_is_fused(network, monkeypatch):
    monkeypatch.setattr(compiled, "find_spec", lambda name: object())
    values = torch.zeros(1, 3, 2)
    assert compiled.fused("vn_fused", values) is None
    with torch.no_grad():
        assert compiled.fused("vn_fused", values.double()) is None
        assert compiled.fused("vn_fused", values) is vn_fused
        with torch.autocast("cpu", torch.bfloat16):
            assert compiled.fused("vn_fused", values) is None


def test_inference_needs_no_numba(random_scene, network, without_numba):
    with torch.no_grad():
        assert compiled.fused("vn_fused", torch.zeros(1, 3, 2)) is None
    assert np.isfinite(scores(network, single(random_scene(0).batch()))).all()


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, rows=st.integers(1, 40), width=st.integers(1, 20))
def test_compiled_relu_is_the_plain_one(seed, rows, width):
    both = random_vectors(seed, rows, 3, 2 * width)
    expected = vector_relu(both[..., :width], both[..., width:])
    torch.testing.assert_close(vn_fused._relu(both), expected, rtol=1e-4, atol=1e-5)


def test_compiled_relu_of_a_vanishing_direction_is_the_vector():
    both = torch.cat((random_vectors(0, 2, 3, 4), torch.zeros(2, 3, 4)), dim=2)
    torch.testing.assert_close(vn_fused._relu(both), both[..., :4], rtol=0, atol=0)


def furthest(*parts: torch.Tensor) -> torch.Tensor:
    """The furthest of all vectors, part after part."""
    width = parts[0].shape[2] // 2
    best, result = np.full((1, width), -np.inf, np.float32), torch.zeros(1, 3, width)
    for part in parts:
        vn_fused._furthest(part.numpy(), np.array([0, len(part)]), best, result.numpy())
    return result[0]


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, rows=st.integers(1, 40), width=st.integers(1, 20))
def test_compiled_maximum_is_the_plain_one(seed, rows, width):
    direction = torch.nn.Linear(width, width, bias=False)
    direction.weight.data.copy_(random_vectors(seed, width, width))
    vectors = random_vectors(seed + 1, rows, 3, width)
    with torch.no_grad():
        both = torch.cat((vectors, direction(vectors)), dim=2)
        expected = vector_maximum(vectors, direction, dim=0)
    torch.testing.assert_close(furthest(both), expected, rtol=0, atol=0)
    torch.testing.assert_close(furthest(both[:1], both[1:]), expected, rtol=0, atol=0)


def test_neighbours_are_gathered_from_their_own_rows():
    u, points, offset = random_vectors(1, 5, 3, 8), random_vectors(2, 2, 3), random_vectors(3, 8)
    neighbors = np.array([[0, 4, 2], [3, 3, 1]])
    result = torch.empty(6, 3, 4)
    vn_fused._gathered_relu(u.numpy(), points.numpy(), offset.numpy(), neighbors, result.numpy())
    edges = u[torch.from_numpy(neighbors)] - (points[:, :, None] * offset)[:, None]
    expected = vector_relu(edges[..., :4], edges[..., 4:]).flatten(0, 1)
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)
