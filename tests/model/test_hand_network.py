from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import Candidates, edge_grasps
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE as SIZE
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import HAND, NetworkConfig
from edgegrasp_model.networks.hand import PIECE, HandBatch
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud

PANDA = load_gripper()
UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)
CAMERA = np.array([0.3, 0.2, 0.5], dtype=np.float32)
TINY = NetworkConfig(
    "hand", hand_widths=(8, 12), hand_points=16, classifier_widths=(12, 8), crop_radius=0.04
)


def scene(seed: int, count: int = 150) -> tuple[Cloud, Candidates]:
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-0.5, 0.5, (count, 3)) * (0.06, 0.05, 0.07)).astype(np.float32)
    cloud = Cloud(points, points / np.linalg.norm(points, axis=1, keepdims=True))
    a, c = rng.integers(count, size=(2, 60))
    return cloud, edge_grasps(cloud, a, c, PANDA)


def look(
    cloud: Cloud,
    candidates: Candidates,
    camera: NDArray[np.float32] | None = CAMERA,
    up: NDArray[np.float32] = UP,
    limit: int = 400,
) -> HandBatch:
    support = SupportPlane(normal=tuple(up.tolist()), offset=float(up @ [0.0, 0.0, -0.05]))
    return HandBatch.from_cloud(cloud, candidates, PANDA, up, support, camera, None, limit)


def scores(batch: HandBatch, config: NetworkConfig = TINY) -> torch.Tensor:
    network = build_network(config, torch.Generator().manual_seed(1)).eval()
    with torch.inference_mode():
        logits: torch.Tensor = network(batch)
    return logits


def test_points_are_those_between_and_around_the_fingers() -> None:
    cloud, candidates = scene(0)
    batch = look(cloud, candidates, camera=None)
    turn, shift = candidates.T_cloud_hand[:, :3, :3], candidates.T_cloud_hand[:, :3, 3]
    seen = np.einsum("end,edk->enk", cloud.points - shift[:, None], turn)  # (E, N, 3)
    seen[:, :, 2] -= PANDA.tip_z
    inside = (np.abs(seen) < (0.0375, 0.1, np.inf)).all(axis=2)
    inside &= (seen[:, :, 2] > PANDA.palm_z - 0.026 - PANDA.tip_z) & (seen[:, :, 2] < 0.012)
    # Points within rounding of the region's edge may fall on its other side.
    assert (np.abs(batch.point_count.numpy() - inside.sum(axis=1)) <= 1).all()
    for hand in np.flatnonzero(batch.point_count.numpy() == inside.sum(axis=1)):
        count = int(batch.point_count[hand])
        normal = cloud.normals[inside[hand]] @ turn[hand]
        expected = np.hstack([seen[hand][inside[hand]], normal])
        np.testing.assert_allclose(batch.points[hand, :count], expected, atol=1e-5)
        assert (batch.points[hand, count:] == 0).all()


def test_too_many_points_are_thinned_evenly() -> None:
    cloud, candidates = scene(0)
    every, some = look(cloud, candidates), look(cloud, candidates, limit=10)
    for hand, count in enumerate(every.point_count.tolist()):
        assert some.point_count[hand] == min(count, 10)
        if count <= 10:
            kept = np.arange(count)
        else:
            kept = np.flatnonzero(np.diff(np.arange(count + 1) * 10 // count))
        torch.testing.assert_close(some.points[hand, : len(kept)], every.points[hand][kept])


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_turning_the_whole_scene_changes_no_score(seed: int) -> None:
    cloud, candidates = scene(seed)
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix().astype(np.float32)
    turned = Cloud(cloud.points @ turn.T, cloud.normals @ turn.T)
    pairs = candidates.approach_index, candidates.contact_index
    again = edge_grasps(turned, *pairs, PANDA)
    before = scores(look(cloud, candidates))
    after = scores(look(turned, again, turn @ CAMERA, turn @ UP))
    assert np.isclose(before, after, atol=2e-3).mean() > 0.9  # rounding moves points over edges


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_mirroring_the_whole_scene_changes_no_score(seed: int) -> None:
    cloud, candidates = scene(seed)
    mirror = np.array([-1.0, 1.0, 1.0], dtype=np.float32)
    mirrored = Cloud(cloud.points * mirror, cloud.normals * mirror)
    pairs = candidates.approach_index, candidates.contact_index
    again = edge_grasps(mirrored, *pairs, PANDA)
    before = scores(look(cloud, candidates))
    after = scores(look(mirrored, again, CAMERA * mirror))
    assert np.isclose(before, after, atol=2e-3).mean() > 0.9


def test_the_order_of_the_points_and_what_follows_them_mean_nothing() -> None:
    batch = look(*scene(3))
    order = torch.stack(
        [
            torch.randperm(400, generator=torch.Generator().manual_seed(hand))
            for hand in range(len(batch.points))
        ]
    )
    there = torch.arange(400) < batch.point_count[:, None]
    order = order.gather(1, (~there.gather(1, order)).int().argsort(dim=1, stable=True))
    shuffled = replace(batch, points=batch.points.gather(1, order[:, :, None].expand(-1, -1, 6)))
    assert not torch.equal(shuffled.points, batch.points)
    torch.testing.assert_close(scores(shuffled), scores(batch), atol=1e-5, rtol=1e-4)
    filled = batch.points.clone()
    filled[~there] = 7.0
    torch.testing.assert_close(scores(replace(batch, points=filled)), scores(batch))


def test_a_hand_with_nothing_around_it_has_a_score() -> None:
    batch = look(*scene(4))
    nothing = replace(batch, point_count=torch.zeros_like(batch.point_count))
    assert scores(nothing).isfinite().all()


def test_joined_batches_score_as_each_alone() -> None:
    """To the last bit, whatever their sizes: a request gets the same scores in any company."""
    batches = [look(*scene(seed)) for seed in range(3)] * 4
    batches += [first_hands(batches[0], count) for count in (1, 2, 3, 5, 17)]
    joined = HandBatch.concatenate(batches)
    assert len(joined.contact) > PIECE
    assert joined.num_balls == sum(batch.num_balls for batch in batches)
    apart = torch.cat([scores(batch, HAND) for batch in batches])
    assert torch.equal(scores(joined, HAND), apart)
    with pytest.raises(ValueError, match="batches: got none"):
        HandBatch.concatenate([])


def first_hands(batch: HandBatch, count: int) -> HandBatch:
    return replace(
        batch,
        description=batch.description[:count],
        points=batch.points[:count],
        point_count=batch.point_count[:count],
    )


def test_the_description_is_standardised_within() -> None:
    batch = look(*scene(5))
    plain = scores(batch)
    network = build_network(TINY, torch.Generator().manual_seed(1)).eval()
    mean, std = torch.linspace(-3, 3, SIZE), torch.linspace(0.5, 4, SIZE)
    network.set_statistics(mean, std)
    shifted = replace(batch, description=batch.description * std + mean)
    with torch.inference_mode():
        torch.testing.assert_close(network(shifted), plain, atol=1e-4, rtol=1e-4)
        network.set_statistics(mean, torch.zeros(SIZE))  # numbers that never change
        assert network(shifted).isfinite().all()
