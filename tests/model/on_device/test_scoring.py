"""Networks on padded batches score as the networks themselves; padding counts for nothing."""

import pytest
import torch

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE
from edgegrasp_model.network import build_network
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.on_device.padded_balls import POINT_STEPS, STEPS, bucket, padded_balls
from edgegrasp_model.on_device.scoring import ScoringNetwork

CONFIGS = {
    "edgegrasp": NetworkConfig("edgegrasp", (8, 12, 16), (16, 20, 24), (28, 32), (24, 16)),
    "vn-edgegrasp": NetworkConfig("vn-edgegrasp", (6, 8, 10), (12, 12, 12), (18, 18), (16, 8)),
}


@pytest.fixture(params=CONFIGS)
def network(request: pytest.FixtureRequest) -> torch.nn.Module:
    return build_network(CONFIGS[request.param], torch.Generator().manual_seed(1)).eval()


@pytest.mark.parametrize("seed", range(5))
def test_padding_changes_no_score(random_scene, network: torch.nn.Module, seed: int) -> None:
    batch = random_scene(seed).batch(torch.float32)
    with torch.inference_mode():
        expected = network(batch)
    found = ScoringNetwork(network)(batch)
    assert len(found) == len(batch.contact)
    spread = float(expected.std())
    assert spread > 1e-5
    torch.testing.assert_close(found, expected, atol=0.005 * spread, rtol=0.0)


def test_several_requests_share_a_pass(random_scene, network: torch.nn.Module) -> None:
    parts = [random_scene(seed).batch(torch.float32) for seed in (1, 2, 3)]
    scored = ScoringNetwork(network)
    together = scored(BallBatch.concatenate(parts))
    torch.testing.assert_close(together, torch.cat([scored(part) for part in parts]))


def test_what_fills_up_has_no_effect(random_scene, network: torch.nn.Module) -> None:
    """Rows that fill up may hold anything: the function is asked with other ones there."""
    from edgegrasp_model.on_device.edge_network import edge_grasp_logits
    from edgegrasp_model.on_device.vn_network import vn_edge_grasp_logits

    batch = random_scene(0).batch(torch.float32)
    logits = vn_edge_grasp_logits if hasattr(network, "frame_1") else edge_grasp_logits
    balls = padded_balls(batch)
    spoilt = padded_balls(batch)
    for values, size in (
        (spoilt.points, len(batch.points)),
        (spoilt.normals, len(batch.points)),
        (spoilt.approach, len(batch.contact)),
        (spoilt.depth, len(batch.contact)),
    ):
        assert len(values) > size
        values[size:] = 7.0
    with torch.inference_mode():
        one, other = logits(network, balls), logits(network, spoilt)
    torch.testing.assert_close(one[: len(batch.contact)], other[: len(batch.contact)])
    assert not torch.allclose(one, other)


def test_padded_balls_have_few_shapes(random_scene) -> None:
    batch = random_scene(0).batch(torch.float32)
    balls = padded_balls(batch)
    for rows, size, steps in (
        (balls.points, len(batch.points), POINT_STEPS),
        (balls.contact, len(batch.contact), STEPS),
        (balls.members, batch.num_balls, STEPS),
    ):
        assert len(rows) == bucket(size, steps) >= size
    sizes = batch.ball_sizes
    for ball, members in enumerate(balls.members[: len(sizes)]):
        first = sum(sizes[:ball])
        assert set(members.tolist()) == set(range(first, first + sizes[ball]))


@pytest.mark.parametrize(("steps", "waste", "most"), [(STEPS, 2.0, 15), (POINT_STEPS, 1.125, 100)])
def test_buckets_are_few_and_little_larger(steps: int, waste: float, most: int) -> None:
    sizes = range(1, 40_000)
    buckets = [bucket(size, steps) for size in sizes]
    for size, found in zip(sizes, buckets, strict=True):
        assert size <= found <= max(8, waste * size + 1)
    assert buckets == sorted(buckets)
    assert len(set(buckets)) < most


def test_buckets() -> None:
    assert [bucket(size, 1) for size in (0, 1, 8, 9, 1024, 1025)] == [8, 8, 8, 16, 1024, 2048]
    assert [bucket(size, 8) for size in (1, 9, 1025, 2000, 2048)] == [8, 9, 1152, 2048, 2048]


def test_half_precision_is_close_and_not_the_same(random_scene, network: torch.nn.Module) -> None:
    batch = random_scene(0).batch(torch.float32)
    full = ScoringNetwork(network)(batch)
    half = ScoringNetwork(network, "bfloat16")(batch)
    assert half.dtype == torch.float32
    assert not torch.equal(full, half)
    torch.testing.assert_close(half, full, atol=0.01, rtol=0.0)


def test_hands_are_padded_too() -> None:
    config = NetworkConfig("hand", hand_widths=(8, 16), classifier_widths=(8,), hand_points=12)
    network = build_network(config).eval()
    generator = torch.Generator().manual_seed(0)
    batch = HandBatch(
        torch.randn(21, HAND_DESCRIPTION_SIZE, generator=generator),
        torch.randn(21, 12, 6, generator=generator),
        torch.arange(21) % 13,
        num_balls=3,
    )
    with torch.inference_mode():
        expected = network(batch)
    torch.testing.assert_close(ScoringNetwork(network)(batch), expected)
    none = HandBatch(batch.description[:0], batch.points[:0], batch.point_count[:0], 0)
    assert ScoringNetwork(network)(none).shape == (0,)
