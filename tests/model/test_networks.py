"""The ball networks, what all networks share, and their configuration."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.networks import layers
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import EDGEGRASP_SMALL

from .scenes import SEED, TINY, RandomScene

architectures = pytest.mark.parametrize("architecture", ["edgegrasp", "vn-edgegrasp"])
has_onednn = pytest.mark.skipif(
    not hasattr(torch.ops.mkldnn, "_reorder_linear_weight"), reason="PyTorch has no oneDNN here"
)


def scores(network: torch.nn.Module, batch: BallBatch) -> torch.Tensor:
    with torch.inference_mode():
        return network(batch)


@settings(max_examples=8)
@given(seed=st.integers(0, SEED))
def test_vn_scores_are_invariant_under_rotation_and_translation(seed):
    rng, scene = np.random.default_rng(seed), RandomScene.of_seed(seed)
    moved = scene.turned(Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3))
    # In double precision no two vectors of a random cloud come within rounding of a tie.
    network = build_network(TINY["vn-edgegrasp"]).double()
    expected, found = scores(network, scene.batch()), scores(network, moved.batch())
    assert expected.std() > 1e-6
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


@architectures
@settings(max_examples=5)
@given(seed=st.integers(0, SEED))
def test_scores_depend_neither_on_point_order_nor_on_other_balls(architecture, seed):
    network, scene = build_network(TINY[architecture]).double(), RandomScene.of_seed(seed)
    expected = scores(network, scene.batch())
    assert expected.std() > 1e-6
    order = np.random.default_rng(seed).permutation(len(scene.points))
    shuffled = scores(network, scene.reordered(order).batch())
    torch.testing.assert_close(shuffled, expected, rtol=0, atol=1e-10)
    for ball in range(len(scene.approach_index)):
        alone = scores(network, scene.only_ball(ball).batch())
        here = expected[torch.from_numpy(scene.edges[:, 0] == ball)]
        torch.testing.assert_close(alone, here, rtol=0, atol=1e-10)


@pytest.mark.parametrize("onednn", [False, pytest.param(True, marks=has_onednn)])
@pytest.mark.parametrize(
    "config",
    [
        EDGEGRASP_SMALL,
        replace(EDGEGRASP_SMALL, architecture="vn-edgegrasp", conv_widths=(32, 48, 64)),
    ],
    ids=["edgegrasp", "vn-edgegrasp"],
)
def test_a_score_is_the_same_to_the_last_bit_whatever_is_scored_with_it(
    config, onednn, monkeypatch
):
    monkeypatch.setattr(layers, "onednn_is_faster", lambda: onednn)
    network, scene = build_network(config), RandomScene.of_seed(3)
    together = scores(network, scene.batch(torch.float32))
    for ball in range(len(scene.approach_index)):
        alone = scores(network, scene.only_ball(ball).batch(torch.float32))
        assert torch.equal(alone, together[torch.from_numpy(scene.edges[:, 0] == ball)])
    some = replace(scene, edges=scene.edges[::3])
    assert torch.equal(scores(network, some.batch(torch.float32)), together[::3])


@architectures
def test_neither_single_precision_nor_recorded_gradients_change_a_score(architecture):
    network, scene = build_network(TINY[architecture]), RandomScene.of_seed(3)
    batch = scene.batch(torch.float32)
    single = scores(network, batch)  # by fused loops
    in_one_place = replace(batch, points=0 * batch.points, normals=0 * batch.normals)
    assert scores(network, in_one_place).isfinite().all()
    network.double()
    exact = scores(network, scene.batch())
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=0.01 * float(exact.std()))
    recorded = network(scene.batch()).detach()
    torch.testing.assert_close(recorded, exact, rtol=0, atol=1e-12)


@architectures
def test_a_batch_without_grasps_has_no_scores(architecture):
    empty = replace(RandomScene.of_seed(1), edges=np.empty((0, 2), dtype=np.int64))
    assert scores(build_network(TINY[architecture]), empty.batch(torch.float32)).shape == (0,)
