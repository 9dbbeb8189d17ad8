"""The textbook implementation computes what ours computes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from benchmarks import readme
from benchmarks.textbook.edge_grasp import edge_grasp_logits
from benchmarks.textbook.vn_edge_grasp import vn_edge_grasp_logits
from benchmarks.timing import interleaved, summary

from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import NetworkConfig

WIDTHS = {"conv_widths": (8, 8, 16), "global_widths_2": (24, 24), "classifier_widths": (16,)}


def network(architecture: str) -> torch.nn.Module:
    config = NetworkConfig(architecture=architecture, global_widths_1=(16, 16, 16), **WIDTHS)
    return build_network(config).double()


@pytest.fixture(scope="module")
def batch() -> BallBatch:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 0.12, (400, 3)).astype(np.float32)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    approach_index = np.array([3, 50, 200])
    crop = crop_balls(points, approach_index, 0.05)
    contact = np.arange(0, len(crop.ball_rows), 7)
    approach = rng.normal(size=(len(contact), 3))
    made = BallBatch.from_cloud(
        points, normals, approach_index, crop, contact, approach, rng.uniform(0, 0.04, len(contact))
    )
    return BallBatch(
        points=made.points.double(),
        normals=made.normals.double(),
        neighbors=made.neighbors,
        ball_of_point=made.ball_of_point,
        num_balls=made.num_balls,
        contact=made.contact,
        approach=made.approach.double(),
        depth=made.depth.double(),
    )


def test_edge_grasp_logits_are_those_of_the_network(batch: BallBatch) -> None:
    plain = network("edgegrasp")
    with torch.no_grad():
        ours, theirs = plain(batch), edge_grasp_logits(plain, batch)
    assert ours.std() > 1e-6
    torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-9)


def test_vn_logits_are_those_of_the_network(batch: BallBatch) -> None:
    vn = network("vn-edgegrasp")
    with torch.no_grad():
        ours, theirs = vn(batch), vn_edge_grasp_logits(vn, batch)
    assert ours.std() > 1e-6
    torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-9)


def test_variants_take_turns() -> None:
    order: list[str] = []
    names = ("a", "b")
    times = interleaved({name: lambda name=name: order.append(name) for name in names}, runs=2)
    assert order == ["a", "b"] * 3
    assert {name: len(seconds) for name, seconds in times.items()} == {"a": 2, "b": 2}


def test_the_ratio_is_the_median_of_rounds() -> None:
    measured = summary({"x": [1.0, 2.0, 1.0], "y": [3.0, 4.0, 9.0]}, "x", "y")
    assert measured == {"seconds": {"x": 1.0, "y": 4.0}, "times_faster": 3.0, "rounds": 3}


def test_a_readme_without_markers_is_refused(tmp_path) -> None:
    page = tmp_path / "README.md"
    page.write_text("nothing")
    with pytest.raises(ValueError, match="bench:begin"):
        readme.write_table(page, {})
