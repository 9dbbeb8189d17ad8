"""The rotation-invariant network and its layers."""

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.vn_edgegrasp import vector_maximum, vector_relu

from .scenes import SEED, TINY, RandomScene

# In double precision no two vectors of a random cloud come within rounding of a tie.
NETWORK = build_network(TINY["vn-edgegrasp"]).double()


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


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, SEED))
def test_scores_are_invariant_under_rotation_and_translation(seed):
    rng, scene = np.random.default_rng(seed), RandomScene.of_seed(seed)
    moved = scene.turned(Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3))
    with torch.no_grad():
        expected, scores = NETWORK(scene.batch()), NETWORK(moved.batch())
    assert expected.std() > 1e-6
    torch.testing.assert_close(scores, expected, rtol=0, atol=1e-9)


def test_scores_depend_on_the_normals_and_those_of_the_plain_network_on_the_frame():
    scene = RandomScene.of_seed(1)
    batch = scene.batch()
    plain = build_network(TINY["edgegrasp"]).double()
    turned = scene.turned(Rotation.from_rotvec([0.3, 0.9, -0.5]).as_matrix(), np.zeros(3))
    with torch.no_grad():
        changed = NETWORK(replace(batch, normals=batch.normals.flip(0)))
        assert (changed - NETWORK(batch)).abs().max() > 1e-6
        assert (plain(turned.batch()) - plain(batch)).abs().max() > 1e-4


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, SEED))
def test_layers_turn_with_their_input(seed):
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
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


def test_vector_relu_removes_what_points_against_the_direction_if_there_is_one() -> None:
    vectors = torch.tensor([[[1.0, 1.0], [2.0, -2.0], [0.0, 0.0]]])  # (1, 3, 2)
    directions = torch.tensor([[[0.0, 0.0], [3.0, 3.0], [0.0, 0.0]]])
    expected = torch.tensor([[[1.0, 1.0], [2.0, 0.0], [0.0, 0.0]]])
    torch.testing.assert_close(vector_relu(vectors, directions), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(vector_relu(vectors, torch.zeros_like(vectors)), vectors)


def test_vector_maximum_picks_per_channel_the_furthest():
    vectors, direction = random_vectors(1, 6, 3, 5), random_direction(2, 5)
    picked = vector_maximum(vectors, direction, dim=0)
    directions = direction(vectors).detach()
    for channel in range(5):
        reach = [float(vectors[i, :, channel] @ directions[i, :, channel]) for i in range(6)]
        assert torch.equal(picked[:, channel], vectors[int(np.argmax(reach)), :, channel])
