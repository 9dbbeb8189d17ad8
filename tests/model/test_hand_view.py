"""What a hand sees of the cloud in its own frame, and the network that scores it by that."""

from dataclasses import replace

import numpy as np
import torch

from edgegrasp_model.candidates.edge_grasps import Candidates, edge_grasps
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import Surroundings
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import HAND, NetworkConfig
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud

from .scenes import PANDA, TINY

UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)
CAMERA = np.array([0.3, 0.2, 0.5], dtype=np.float32)


def scene(seed: int) -> tuple[Cloud, Candidates]:
    """A cloud with edge grasps of 60 random pairs."""
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-0.5, 0.5, (150, 3)) * (0.06, 0.05, 0.07)).astype(np.float32)
    cloud = Cloud(points, points / np.linalg.norm(points, axis=1, keepdims=True))
    return cloud, edge_grasps(cloud, *rng.integers(150, size=(2, 60)), PANDA)


def plane(up: np.ndarray, offset: float) -> SupportPlane:
    return SupportPlane(normal=tuple(up.tolist()), offset=offset)


def look(
    cloud: Cloud,
    candidates: Candidates,
    camera: np.ndarray | None = CAMERA,
    support: SupportPlane | None = None,
    limit: int = 400,
    gripper: Gripper = PANDA,
) -> HandBatch:
    support = support or plane(UP, -0.05)
    up = np.array(support.normal, dtype=np.float32)
    cameras = None if camera is None else camera[None]
    around = Surroundings(cloud, up, support, cameras)
    return HandBatch.of_hands(around, candidates, gripper, limit)


def scores(batch: HandBatch, config: NetworkConfig = TINY["hand"]) -> torch.Tensor:
    with torch.inference_mode():
        return build_network(config).eval()(batch)


def test_the_order_of_the_points_and_what_follows_them_mean_nothing() -> None:
    batch = look(*scene(3))
    draws = torch.rand(batch.points.shape[:2], generator=torch.Generator().manual_seed(1))
    order = draws.argsort(dim=1)
    there = torch.arange(400) < batch.point_count[:, None]
    order = order.gather(1, (~there.gather(1, order)).int().argsort(dim=1, stable=True))
    shuffled = replace(batch, points=batch.points.gather(1, order[:, :, None].expand(-1, -1, 6)))
    assert not torch.equal(shuffled.points, batch.points)
    torch.testing.assert_close(scores(shuffled), scores(batch), atol=1e-5, rtol=1e-4)
    filled = batch.points.clone()
    filled[~there] = 7.0
    torch.testing.assert_close(scores(replace(batch, points=filled)), scores(batch))
    nothing = replace(batch, point_count=torch.zeros_like(batch.point_count))
    assert scores(nothing).isfinite().all()


def test_an_older_network_reads_the_numbers_that_it_knows() -> None:
    batch, older = look(*scene(2)), replace(HAND, description_size=61)
    fewer = replace(batch, description=batch.description[:, :61].contiguous())
    assert torch.equal(scores(batch, older), scores(fewer, older))


def test_a_score_is_the_same_to_the_last_bit_whatever_is_scored_with_it() -> None:
    batch = look(*scene(0))
    together = scores(batch, HAND)
    for rows in (slice(1), slice(3), slice(20, 37), slice(None, None, 2)):
        parts = batch.description[rows], batch.points[rows], batch.point_count[rows]
        assert torch.equal(scores(HandBatch(*parts), HAND), together[rows])


def test_weights_that_were_changed_are_those_that_score() -> None:
    batch = look(*scene(5))
    changed, fresh = (build_network(TINY["hand"]).eval() for _ in range(2))
    with torch.inference_mode():
        before = changed(batch)
    with torch.no_grad():
        for weight in changed.parameters():
            weight += 0.01
    fresh.load_state_dict(changed.state_dict())
    with torch.inference_mode():
        assert not torch.equal(changed(batch), before)
        assert torch.equal(changed(batch), fresh(batch))
