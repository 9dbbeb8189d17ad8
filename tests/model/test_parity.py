"""Both networks against the logits of the authors' code on five observed scenes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from edgegrasp_model.on_device.scoring import ScoringNetwork
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.import_checkpoint import import_checkpoint

SCENES = ["packed_00", "packed_03", "pile_04", "pile_07", "pile_09"]
REFERENCE_RADIUS = 0.05


@pytest.fixture(scope="module")
def vn_network(shared_dir):
    return import_checkpoint(shared_dir / "reference" / "vn_edge_grasp")[0]


@pytest.fixture(scope="module")
def random_network(shared_dir):
    return import_checkpoint(shared_dir / "reference" / "edge_grasp_random")[0]


def golden_batch(path: Path, rotation: np.ndarray | None = None) -> tuple[BallBatch, np.ndarray]:
    """The scored edge grasps of a golden scene, perhaps turned, and the authors' VN logits."""
    golden = np.load(path)
    turn = np.eye(3, dtype=np.float32) if rotation is None else rotation.astype(np.float32)
    points, normals = golden["points"] @ turn.T, golden["normals"] @ turn.T
    crop = crop_balls(points, golden["approach_index"], REFERENCE_RADIUS)
    approach_row = golden["approach_index"][crop.ball_of_point]
    ours = np.column_stack((approach_row, crop.ball_rows))
    row_of = {tuple(pair): row for row, pair in enumerate(ours.tolist())}
    scored = golden["ball_edges"][golden["edge_rows"]]
    batch = BallBatch.from_cloud(
        points,
        normals,
        golden["approach_index"],
        crop,
        contact=np.array([row_of[tuple(pair)] for pair in scored.tolist()]),
        approach=golden["approach"] @ turn.T,
        depth=golden["depth"],
    )
    return batch, golden["logit"]


def logits(network: torch.nn.Module, batch: BallBatch) -> np.ndarray:
    with torch.no_grad():
        return network(batch).numpy()


@pytest.mark.parametrize("scene", SCENES)
def test_balls_hold_the_same_points(shared_dir, scene):
    golden = np.load(shared_dir / "reference" / "golden" / f"{scene}.npz")
    crop = crop_balls(golden["points"], golden["approach_index"], REFERENCE_RADIUS)
    approach_row = golden["approach_index"][crop.ball_of_point]
    ours = np.column_stack((approach_row, crop.ball_rows)).tolist()
    assert sorted(ours) == sorted(golden["ball_edges"].tolist())


@pytest.mark.parametrize("scene", SCENES)
def test_vn_logits_correlate_and_the_best_grasp_is_the_same(shared_dir, vn_network, scene):
    batch, golden = golden_batch(shared_dir / "reference" / "golden" / f"{scene}.npz")
    scores = logits(vn_network, batch)
    assert np.corrcoef(scores, golden)[0, 1] >= 0.995
    assert scores.argmax() == golden.argmax()
    # Where no choice of a vector falls the other way by rounding, the logits are the same.
    assert np.median(np.abs(scores - golden)) < 1e-4


@pytest.mark.parametrize("scene", SCENES)
def test_edgegrasp_logits_are_the_same(shared_dir, random_network, scene):
    reference = shared_dir / "reference"
    batch, _ = golden_batch(reference / "golden" / f"{scene}.npz")
    golden = np.load(reference / "edge_grasp_random" / "logits.npz")[scene]
    np.testing.assert_allclose(logits(random_network, batch), golden, rtol=0, atol=1e-3)


@pytest.mark.parametrize("scene", ["pile_07"])
def test_the_same_holds_of_the_networks_on_a_device(shared_dir, vn_network, random_network, scene):
    reference = shared_dir / "reference"
    batch, golden = golden_batch(reference / "golden" / f"{scene}.npz")
    scores = ScoringNetwork(vn_network)(batch).numpy()
    assert np.corrcoef(scores, golden)[0, 1] >= 0.995
    assert scores.argmax() == golden.argmax()
    assert np.median(np.abs(scores - golden)) < 1e-4
    golden = np.load(reference / "edge_grasp_random" / "logits.npz")[scene]
    np.testing.assert_allclose(ScoringNetwork(random_network)(batch).numpy(), golden, atol=1e-3)


def test_vn_logits_keep_when_an_observed_cloud_turns(shared_dir, vn_network):
    path = shared_dir / "reference" / "golden" / "pile_04.npz"
    rotation = Rotation.from_rotvec([1.1, -0.4, 2.0]).as_matrix()
    scores = logits(vn_network, golden_batch(path)[0])
    turned = logits(vn_network, golden_batch(path, rotation)[0])
    assert np.corrcoef(scores, turned)[0, 1] >= 0.995
