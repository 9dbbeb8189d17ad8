"""The ball networks and the one of hands, what they share, and their configuration."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import Candidates, edge_grasps
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud, unit
from edgegrasp_training.recipes import RECIPES, build_network

from .scenes import PANDA, SEED, TINY, VIEW, scene_of

SMALL, HAND = RECIPES["edgegrasp-small"], RECIPES["edgegrasp-plus"]
architectures = pytest.mark.parametrize("architecture", ["edgegrasp", "vn-edgegrasp"])


@dataclass(frozen=True)
class RandomScene:
    """A cloud with candidate edge grasps, as the ball networks take them."""

    points: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3)
    approach_index: np.ndarray  # (A,)
    edges: np.ndarray  # (E, 2) ball, contact row of the cloud

    @staticmethod
    def of_seed(seed: int) -> "RandomScene":
        """4 balls, some 40 edge grasps."""
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.06, 0.06, (150, 3)) * (1.0, 1.0, 0.4)
        normals = unit(rng.normal(size=(150, 3)))
        approach_index = rng.choice(150, 4, replace=False)
        distance = np.linalg.norm(points[approach_index][:, None] - points, axis=2)  # (A, N)
        edges = np.argwhere((distance > 0.003) & (distance < 0.038))
        return RandomScene(points, normals, approach_index, edges[:: max(1, len(edges) // 40)])

    def turned(self, rotation: np.ndarray, translation: np.ndarray) -> "RandomScene":
        points = self.points @ rotation.T + translation
        return replace(self, points=points, normals=self.normals @ rotation.T)

    def reordered(self, order: np.ndarray) -> "RandomScene":
        """The same scene with its point order[i] at row i."""
        row_of = np.argsort(order)
        edges = np.column_stack((self.edges[:, 0], row_of[self.edges[:, 1]]))
        cloud = self.points[order], self.normals[order]
        return RandomScene(*cloud, row_of[self.approach_index], edges)

    def only_ball(self, ball: int) -> "RandomScene":
        edges = self.edges[self.edges[:, 0] == ball] * (0, 1)
        return replace(self, approach_index=self.approach_index[[ball]], edges=edges)

    def batch(self, dtype: type = np.float64) -> BallBatch:
        approach_index, contact_index = self.approach_index[self.edges[:, 0]], self.edges[:, 1]
        edge = self.points[contact_index] - self.points[approach_index]
        normal = self.normals[contact_index]
        ahead = edge - (edge * normal).sum(axis=1, keepdims=True) * normal
        depth = np.linalg.norm(ahead, axis=1)
        hands = np.zeros((len(edge), 4, 4))
        hands[:, :3, 2] = ahead / depth[:, None]
        points, normals, depth, hands = (
            each.astype(dtype) for each in (self.points, self.normals, depth, hands)
        )
        edges = Candidates(contact_index, approach_index, contact_index, depth, depth, hands)
        return BallBatch.from_candidates(Cloud(points, normals), edges, 0.05)


def scores(network: torch.nn.Module, batch: BallBatch | HandBatch) -> torch.Tensor:
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


@pytest.mark.parametrize(
    "config",
    [SMALL, replace(SMALL, architecture="vn-edgegrasp", conv_widths=(32, 48, 64))],
    ids=["edgegrasp", "vn-edgegrasp"],
)
def test_a_score_is_the_same_to_the_last_bit_whatever_is_scored_with_it(config):
    network, scene = build_network(config), RandomScene.of_seed(3)
    together = scores(network, scene.batch(np.float32))
    for ball in range(len(scene.approach_index)):
        alone = scores(network, scene.only_ball(ball).batch(np.float32))
        assert torch.equal(alone, together[torch.from_numpy(scene.edges[:, 0] == ball)])
    some = replace(scene, edges=scene.edges[::3])
    assert torch.equal(scores(network, some.batch(np.float32)), together[::3])


@architectures
def test_neither_single_precision_nor_recorded_gradients_change_a_score(architecture):
    network, scene = build_network(TINY[architecture]), RandomScene.of_seed(3)
    batch = scene.batch(np.float32)
    single = scores(network, batch)  # by fused loops
    in_one_place = replace(batch, points=0 * batch.points, normals=0 * batch.normals)
    assert scores(network, in_one_place).isfinite().all()
    none = {name: getattr(batch, name)[:0] for name in ("contact", "approach", "depth")}
    assert scores(network, replace(batch, **none)).shape == (0,)
    network.double()
    exact = scores(network, scene.batch())
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=0.01 * float(exact.std()))
    torch.testing.assert_close(network(scene.batch()).detach(), exact, rtol=0, atol=1e-12)


def look(seed: int) -> HandBatch:
    """What the hands of 60 random pairs of a cloud see of it."""
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-0.5, 0.5, (150, 3)) * (0.06, 0.05, 0.07)).astype(np.float32)
    cloud = Cloud(points, unit(points))
    candidates, _ = edge_grasps(cloud, *rng.integers(150, size=(2, 60)), PANDA)
    support = SupportPlane(normal=(0.0, 0.0, 1.0), offset=-0.05)
    scene = scene_of(points, cloud=cloud, support=support, viewpoints=np.float32([VIEW]))
    return HandBatch.from_hands(scene, candidates, PANDA, 400)


def hand_scores(batch: HandBatch, config: NetworkConfig = TINY["hand"]) -> torch.Tensor:
    return scores(build_network(config).eval(), batch)


def test_the_order_of_the_points_and_what_follows_them_mean_nothing() -> None:
    batch = look(3)
    draws = torch.rand(batch.points.shape[:2], generator=torch.Generator().manual_seed(1))
    order = draws.argsort(dim=1)
    there = torch.arange(400) < batch.point_count[:, None]
    order = order.gather(1, (~there.gather(1, order)).int().argsort(dim=1, stable=True))
    shuffled = replace(batch, points=batch.points.gather(1, order[:, :, None].expand(-1, -1, 6)))
    assert not torch.equal(shuffled.points, batch.points)
    torch.testing.assert_close(hand_scores(shuffled), hand_scores(batch), atol=1e-5, rtol=1e-4)
    filled = batch.points.clone()
    filled[~there] = 7.0
    torch.testing.assert_close(hand_scores(replace(batch, points=filled)), hand_scores(batch))
    nothing = replace(batch, point_count=torch.zeros_like(batch.point_count))
    assert hand_scores(nothing).isfinite().all()


def test_a_hand_s_score_is_the_same_to_the_last_bit_whatever_is_scored_with_it() -> None:
    batch, older = look(0), replace(HAND, description_size=61)
    fewer = replace(batch, description=batch.description[:, :61].contiguous())
    assert torch.equal(hand_scores(batch, older), hand_scores(fewer, older))  # all that it knows
    together = hand_scores(batch, HAND)
    for rows in (slice(1), slice(3), slice(20, 37), slice(None, None, 2)):
        parts = batch.description[rows], batch.points[rows], batch.point_count[rows]
        assert torch.equal(hand_scores(HandBatch(*parts), HAND), together[rows])


def test_bfloat16_changes_a_hand_s_score_little() -> None:
    batch, network = look(4), build_network(HAND).eval()
    exact = network(batch).detach()  # while gradients are recorded
    close = 0.03 * float(exact.std())
    torch.testing.assert_close(scores(network, batch), exact, rtol=0, atol=close)


def test_weights_that_were_changed_are_those_that_score() -> None:
    batch = look(5)
    changed, fresh = (build_network(TINY["hand"]).eval() for _ in range(2))
    before = scores(changed, batch)
    for weight in changed.parameters():
        weight.data += 0.01
    fresh.load_state_dict(changed.state_dict())
    assert not torch.equal(scores(changed, batch), before)
    assert torch.equal(scores(changed, batch), scores(fresh, batch))
