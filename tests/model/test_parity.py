"""Both networks against the logits of the authors' code on five observed scenes."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edgegrasp_model.candidates.edge_grasps import Candidates, crop_balls
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.scene.cloud import Cloud
from edgegrasp_training.import_checkpoint import import_checkpoint

RADIUS = 0.05  # of the reference
NAMES = "packed_00", "packed_03", "pile_04", "pile_07", "pile_09"
scenes = pytest.mark.parametrize("scene", NAMES)


def golden_batch(shared_dir: Path, scene: str) -> tuple[BallBatch, np.ndarray]:
    """The scored edge grasps of a golden scene, and the authors' VN logits.

    Asserts that our balls hold the points that theirs do.
    """
    golden = np.load(shared_dir / "reference" / "golden" / f"{scene}.npz")
    crop = crop_balls(golden["points"], golden["approach_index"], RADIUS)
    approach_row = golden["approach_index"][crop.ball_of_point]
    ours = np.column_stack((approach_row, crop.ball_rows)).tolist()
    assert sorted(ours) == sorted(golden["ball_edges"].tolist())
    approach, contact = golden["ball_edges"][golden["edge_rows"]].T
    depth = golden["depth"]
    hands = np.zeros((len(depth), 4, 4), dtype=np.float32)
    hands[:, :3, 2] = -golden["approach"]
    edges = Candidates(contact, approach, contact, depth, depth, hands)
    cloud = Cloud(golden["points"], golden["normals"])
    batch = BallBatch.from_candidates(cloud, edges, RADIUS)
    return batch, golden["logit"]


def logits(folder: Path, batch: BallBatch) -> np.ndarray:
    """What the authors' weights in a folder say."""
    network, _ = import_checkpoint(folder)
    with torch.no_grad():
        return network(batch).numpy()


@scenes
def test_vn_logits_correlate_and_the_best_grasp_is_the_same(shared_dir: Path, scene: str) -> None:
    batch, golden = golden_batch(shared_dir, scene)
    scores = logits(shared_dir / "reference" / "vn_edge_grasp", batch)
    assert np.corrcoef(scores, golden)[0, 1] >= 0.995
    assert scores.argmax() == golden.argmax()
    # Where no choice of a vector falls the other way by rounding, the logits are the same.
    assert np.median(np.abs(scores - golden)) < 1e-4


@scenes
def test_edgegrasp_logits_are_the_same(shared_dir: Path, scene: str) -> None:
    batch, _ = golden_batch(shared_dir, scene)
    folder = shared_dir / "reference" / "edge_grasp_random"
    golden = np.load(folder / "logits.npz")[scene]
    np.testing.assert_allclose(logits(folder, batch), golden, rtol=0, atol=1e-3)
