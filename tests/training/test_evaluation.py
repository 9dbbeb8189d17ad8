"""Figures of scores, and weights compared on labelled views."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

from edgegrasp_model.networks.checkpoint import build_network, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_training.evaluation import evaluate_scores, reliability, score_views


def test_the_temperature_undoes_overconfidence() -> None:
    rng = np.random.default_rng(0)
    honest = rng.normal(size=20_000)
    label = (rng.random(20_000) < expit(honest)).astype(float)
    found = evaluate_scores((honest * 3).astype(np.float32), label.astype(np.float32))
    assert found.temperature == pytest.approx(3, rel=0.1)
    ranges = reliability(expit(found.logit / found.temperature), found.label)
    assert all(each.score == pytest.approx(each.held, abs=0.05) for each in ranges.values())
    assert sum(each.number for each in ranges.values()) == 20_000


def test_views_are_scored_by_hand_networks_alone(made_up_view, networks, tmp_path: Path) -> None:
    made_up_view(1).save(tmp_path / "pile_0-000000_0.npz")
    made_up_view(2).save(tmp_path / "table_0-000001_0.npz")
    paths = sorted(tmp_path.glob("*.npz"))
    files = {}
    for name in ("hands", "balls"):
        files[name] = tmp_path / f"{name}.safetensors"
        metadata = CheckpointMetadata(name, networks[name], 0.0045, "panda")
        save_checkpoint(files[name], build_network(networks[name]), metadata)
    scored = score_views(paths, [files["hands"], files["hands"]])
    assert set(scored.kind.tolist()) == {"pile", "table"}
    assert scored.logit.shape == (2, len(scored.held))
    np.testing.assert_array_equal(*scored.logit)
    assert 0 < scored.held.mean() < 1
    with pytest.raises(ValueError, match="hand networks"):
        score_views(paths, [files["balls"]])
