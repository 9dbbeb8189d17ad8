from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import EDGEGRASP, EDGEGRASP_SMALL, VN_EDGEGRASP
from edgegrasp_model.networks.edgegrasp import EdgeGraspNet

SEEDS = st.integers(0, 2**32 - 1)
ARCHITECTURES = ["edgegrasp", "vn-edgegrasp"]
VN_OF_FEW = replace(
    VN_EDGEGRASP,
    conv_widths=(32, 48, 64),
    global_widths_1=(64, 64, 64),
    global_widths_2=(64, 64),
    classifier_widths=(64, 32),
)


def scores(network: torch.nn.Module, batch: BallBatch) -> torch.Tensor:
    with torch.no_grad():
        return network(batch)


def parameter_count(network: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def as_written_in_the_paper(network: EdgeGraspNet, batch: BallBatch) -> torch.Tensor:
    """The same network neighbour by neighbour and grasp by grasp, with none of the savings."""

    def linear(layer, values):
        return F.linear(values, layer.weight, layer.bias)

    def convolve(conv, features):
        outputs = []
        for i, neighbors in enumerate(batch.neighbors):
            offset = batch.points[neighbors] - batch.points[i]  # (k, 3)
            hidden = linear(conv.hidden, torch.cat((features[neighbors], offset), dim=1)).relu()
            outputs.append(linear(conv.output, hidden).max(0).values)
        return torch.stack(outputs).relu()

    f1 = convolve(network.conv1, torch.cat((batch.points, batch.normals), dim=1))
    f2 = convolve(network.conv2, f1)
    f3 = convolve(network.conv3, f2)
    local = torch.cat((f1, f2, f3), dim=1)
    logits = []
    for contact, approach, depth in zip(batch.contact, batch.approach, batch.depth, strict=True):
        in_ball = local[batch.ball_of_point == batch.ball_of_point[contact]]
        pooled = network.ball_feature.mlp_1(in_ball).max(0).values
        joined = torch.cat((in_ball, pooled.expand(len(in_ball), -1)), dim=1)
        hidden = linear(network.ball_feature.join, joined).relu()
        ball = network.ball_feature.mlp_2(hidden).max(0).values
        grasp = torch.cat((batch.points[contact], batch.normals[contact], depth[None], approach))
        hidden = linear(network.join, torch.cat((grasp, f3[contact], ball))).relu()
        logits.append(network.classifier(hidden)[0])
    return torch.stack(logits)


@pytest.mark.parametrize(
    ("config", "count"),
    [(EDGEGRASP, 3_048_993), (VN_EDGEGRASP, 1_702_268), (EDGEGRASP_SMALL, 385_185)],
)
def test_parameter_counts(config, count):
    assert parameter_count(build_network(config)) == count


def test_the_savings_change_no_score(random_scene, tiny_config):
    network = build_network(tiny_config).double()
    batch = BallBatch.concatenate([random_scene(1).batch(), random_scene(2).batch()])
    expected = as_written_in_the_paper(network, batch)
    assert expected.std() > 1e-4
    torch.testing.assert_close(scores(network, batch), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_recording_gradients_changes_no_score(random_scene, tiny_config, architecture):
    network = build_network(replace(tiny_config, architecture=architecture)).double()
    batch = random_scene(1).batch()
    torch.testing.assert_close(network(batch).detach(), scores(network, batch), rtol=0, atol=1e-12)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_scores_do_not_depend_on_point_order(random_scene, tiny_config, architecture, seed):
    network = build_network(replace(tiny_config, architecture=architecture)).double()
    scene = random_scene(seed)
    order = np.random.default_rng(seed + 1).permutation(len(scene.points))
    torch.testing.assert_close(
        scores(network, scene.reordered(order).batch()),
        scores(network, scene.batch()),
        rtol=0,
        atol=1e-10,
    )


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_scores_do_not_depend_on_batch_composition(random_scene, tiny_config, architecture, seed):
    network = build_network(replace(tiny_config, architecture=architecture)).double()
    scene, other = random_scene(seed), random_scene(seed + 1)
    alone = scores(network, scene.batch())
    assert alone.std() > 1e-6

    with_another = scores(network, BallBatch.concatenate([other.batch(), scene.batch()]))
    torch.testing.assert_close(with_another[-len(alone) :], alone, rtol=0, atol=1e-10)
    for ball in range(len(scene.approach_index)):
        torch.testing.assert_close(
            scores(network, scene.only_ball(ball).batch()),
            alone[torch.from_numpy(scene.edges[:, 0] == ball)],
            rtol=0,
            atol=1e-10,
        )


@pytest.mark.parametrize("config", [EDGEGRASP_SMALL, VN_OF_FEW], ids=ARCHITECTURES)
def test_joined_batches_score_as_each_alone_to_the_last_bit(random_scene, config):
    """So that batching changes no answer; the widths are such as networks have."""
    network = build_network(config)
    batches = [random_scene(seed).batch(torch.float32) for seed in range(4)]
    batches += [random_scene(seed).only_ball(seed).batch(torch.float32) for seed in range(2)]
    with torch.inference_mode():
        together = network(BallBatch.concatenate(batches))
        alone = torch.cat([network(batch) for batch in batches])
    assert torch.equal(together, alone)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_single_precision_is_enough(random_scene, tiny_config, architecture):
    config = replace(tiny_config, architecture=architecture)
    scene = random_scene(3)
    exact = scores(build_network(config).double(), scene.batch())
    single = scores(build_network(config), scene.batch(torch.float32))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=1e-5)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_gradients_reach_every_parameter(random_scene, tiny_config, architecture):
    network = build_network(replace(tiny_config, architecture=architecture)).double()
    network(random_scene(1).batch()).square().sum().backward()
    for name, parameter in network.named_parameters():
        if ".reach." in name:  # chooses a vector: see vector_maximum
            continue
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


def test_gradients_are_those_of_finite_differences(random_scene, tiny_config):
    network = build_network(tiny_config).double()
    batch = random_scene(1).batch()
    network(batch).sum().backward()
    weight = network.conv1.hidden.weight
    step = torch.randn(weight.shape, generator=torch.Generator().manual_seed(1)).double() * 1e-6
    with torch.no_grad():
        weight += step
        above = network(batch).sum()
        weight -= 2 * step
        below = network(batch).sum()
    torch.testing.assert_close((weight.grad * step).sum(), (above - below) / 2, rtol=1e-4, atol=0)


def test_one_seed_makes_one_network_and_leaves_the_global_stream_alone(tiny_config):
    state = torch.random.get_rng_state()
    first, again = build_network(tiny_config), build_network(tiny_config)
    other = build_network(tiny_config, torch.Generator().manual_seed(1))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(first.join.weight, again.join.weight)
    assert not torch.equal(first.join.weight, other.join.weight)


def test_a_batch_without_grasps_has_no_scores(random_scene, tiny_config):
    scene = random_scene(1)
    empty = replace(scene, edges=np.empty((0, 2), dtype=np.int64))
    assert scores(build_network(tiny_config).double(), empty.batch()).shape == (0,)
