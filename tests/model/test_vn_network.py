from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.vn_edgegrasp import vector_maximum, vector_relu

SEEDS = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def network(tiny_config):
    # In double precision no two vectors of a random cloud come within rounding of a tie.
    return build_network(replace(tiny_config, architecture="vn-edgegrasp")).double()


def random_vectors(seed: int, *shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def random_direction(seed: int, width: int) -> torch.nn.Linear:
    direction = torch.nn.Linear(width, width, bias=False).double()
    direction.weight.data.copy_(random_vectors(seed, width, width))
    return direction


def turned(vectors: torch.Tensor, rotation: np.ndarray) -> torch.Tensor:
    """Turns vectors (..., 3, C)."""
    return torch.from_numpy(rotation) @ vectors


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS)
def test_scores_are_invariant_under_rotation_and_translation(random_scene, network, seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    scene = random_scene(seed)
    moved = scene.turned(rotation, rng.uniform(-1, 1, 3))
    with torch.no_grad():
        expected, scores = network(scene.batch()), network(moved.batch())
    assert expected.std() > 1e-6
    torch.testing.assert_close(scores, expected, rtol=0, atol=1e-9)


def test_scores_depend_on_the_normals(random_scene, network):
    scene = random_scene(1)
    batch = scene.batch()
    changed = replace(batch, normals=batch.normals.flip(0))
    with torch.no_grad():
        assert (network(changed) - network(batch)).abs().max() > 1e-6


def test_the_plain_network_is_not_invariant(random_scene, tiny_config):
    plain = build_network(tiny_config).double()
    rotation = Rotation.from_rotvec([0.3, 0.9, -0.5]).as_matrix()
    scene = random_scene(1)
    with torch.no_grad():
        difference = plain(scene.turned(rotation, np.zeros(3)).batch()) - plain(scene.batch())
    assert difference.abs().max() > 1e-4


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS)
def test_layers_turn_with_their_input(seed):
    rotation = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    vectors, directions = random_vectors(seed, 5, 3, 7), random_vectors(seed + 1, 5, 3, 7)
    torch.testing.assert_close(
        vector_relu(turned(vectors, rotation), turned(directions, rotation)),
        turned(vector_relu(vectors, directions), rotation),
    )
    direction = random_direction(seed, 7)
    torch.testing.assert_close(
        vector_maximum(turned(vectors, rotation), direction, dim=0),
        turned(vector_maximum(vectors, direction, dim=0), rotation),
    )


def test_vector_relu_removes_what_points_against_the_direction():
    vectors = torch.tensor([[1.0, 1.0], [2.0, -2.0], [0.0, 0.0]]).unsqueeze(0)  # (1, 3, 2)
    directions = torch.tensor([[0.0, 0.0], [3.0, 3.0], [0.0, 0.0]]).unsqueeze(0)
    expected = torch.tensor([[1.0, 1.0], [2.0, 0.0], [0.0, 0.0]]).unsqueeze(0)
    torch.testing.assert_close(vector_relu(vectors, directions), expected, rtol=0, atol=1e-6)


def test_vector_relu_of_a_vanishing_direction_is_finite():
    vectors = random_vectors(1, 4, 3, 2)
    torch.testing.assert_close(vector_relu(vectors, torch.zeros_like(vectors)), vectors)


def test_vector_maximum_picks_per_channel_the_furthest():
    vectors, direction = random_vectors(1, 6, 3, 5), random_direction(2, 5)
    picked = vector_maximum(vectors, direction, dim=0)
    directions = direction(vectors).detach()
    for channel in range(5):
        reach = [float(vectors[i, :, channel] @ directions[i, :, channel]) for i in range(6)]
        assert torch.equal(picked[:, channel], vectors[int(np.argmax(reach)), :, channel])
