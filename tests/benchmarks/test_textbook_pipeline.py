"""The textbook pipeline does what the reference system did with its own scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

pipeline = pytest.importorskip("benchmarks.textbook.pipeline", exc_type=ImportError)

TABLE = 0.05  # metres, of the reference's scenes
SCENES = Path(__file__).parents[3] / "shared/reference/golden"


@pytest.fixture(scope="module", params=["packed_03", "pile_09"])
def golden(request: pytest.FixtureRequest) -> dict[str, np.ndarray]:
    path = SCENES / f"{request.param}.npz"
    if not path.is_file():
        pytest.skip(f"the reference's scenes are not in {SCENES}")
    with np.load(path) as arrays:
        return dict(arrays)


def test_the_dense_cloud_becomes_the_reference_points_and_normals(golden) -> None:
    points, normals = pipeline.prepare(golden["dense_cloud"])
    assert len(points) == len(golden["points"])
    apart, row = cKDTree(points).query(golden["points"])
    assert apart.max() < 1e-6
    # The side that all normals face is the only thing left open.
    same, turned = (np.abs(normals[row] - sign * golden["normals"]).max() for sign in (1, -1))
    assert min(same, turned) < 1e-4


def test_every_grasp_of_the_reference_is_a_candidate(golden) -> None:
    rows = golden["approach_index"].astype(np.int64)
    found = pipeline.candidates(golden["points"], golden["normals"], rows, TABLE)
    place = {
        (rows[ball], contact): number
        for number, (ball, contact) in enumerate(zip(found.ball, found.contact, strict=True))
    }
    edges = golden["ball_edges"][golden["edge_rows"]]
    number = [place[approach, contact] for approach, contact in edges.tolist()]
    np.testing.assert_allclose(found.approach[number], golden["approach"], rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.depth[number], golden["depth"], rtol=0, atol=1e-5)
    theirs = golden["T_world_handcom"]
    np.testing.assert_allclose(found.T_cloud_hand[number], theirs, rtol=0, atol=1e-3)
    if len(edges) < 1500:  # fewer than the reference keeps: these are all it had
        assert len(found.contact) == len(edges)


def test_a_detection_ranks_what_it_scores() -> None:
    rng = np.random.default_rng(0)
    # A ball on a table: a closed surface, seen from above.
    ball = rng.normal(size=(6000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    ball[:, 2] = np.abs(ball[:, 2])
    cloud = (0.04 * ball + [0.15, 0.15, TABLE + 0.02]).astype(np.float32)
    score, pose = pipeline.detect(
        cloud, TABLE, lambda batch: batch.depth * torch.ones(1), approach_points=16, most=50
    )
    assert len(score) == 50
    assert (np.diff(score) <= 0).all()
    assert (pose[:, 2, 3] > TABLE).all()
