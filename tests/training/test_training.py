import re
from pathlib import Path

import numpy as np
import pytest
import torch

from edgegrasp_model.networks.checkpoint import load_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_training.options import TrainingOptions
from edgegrasp_training.recipes import RECIPES, recipe
from edgegrasp_training.training import Trainer
from edgegrasp_training.views import find_views, split_by_scene

SAMPLE = Path(__file__).parents[2] / "examples" / "labelled_views"


def ignore(step: int, loss: float) -> None:
    """Where progress is not looked at."""


def same_weights(one: Trainer, other: Trainer) -> bool:
    state = other.network.state_dict()
    return all(torch.equal(value, state[name]) for name, value in one.network.state_dict().items())


def test_loss_falls_and_the_best_network_is_kept_with_a_card(make_trainer, tmp_path) -> None:
    run = make_trainer(tmp_path)
    before = run.evaluate()
    run.run(ignore)
    assert run.finished
    after = run.finish({"data": ["made up"]}, "edgegrasp train data")
    assert after.loss < 0.8 * before.loss
    assert after.auroc > 0.9
    network, metadata = load_checkpoint(tmp_path / "tiny.safetensors")
    assert metadata.temperature == pytest.approx(after.temperature)
    assert metadata.training["steps"] == 40
    assert metadata.training["data"] == ["made up"]
    card = (tmp_path / "tiny.md").read_text()
    assert f"{after.auroc:.4f}" in card
    assert "edgegrasp train data" in card
    assert len((tmp_path / "log.csv").read_text().splitlines()) == 1 + 40 // 10
    assert torch.isfinite(network.std).all()


def test_loss_falls_in_a_few_steps_on_the_views_that_come_with_the_project(tmp_path: Path) -> None:
    train, validation = split_by_scene(find_views([SAMPLE]), 0.1, seed=0)
    metadata = CheckpointMetadata("sample", RECIPES["edgegrasp-plus"], 0.0045, "panda")
    options = TrainingOptions(evaluate_every=1000)
    run = Trainer(metadata, train, validation, tmp_path, options)
    before = run.evaluate()
    run.run(ignore, until=20)
    after = run.evaluate()
    assert after.loss < 0.9 * before.loss
    assert after.auroc > 0.7


@pytest.mark.parametrize("network", ["balls", "hands"])
def test_pausing_and_resuming_is_the_same_as_going_through(make_trainer, tmp_path, network) -> None:
    through = make_trainer(tmp_path / "through", network)
    through.run(ignore, until=14)
    make_trainer(tmp_path / "paused", network).run(ignore, until=9)
    resumed = make_trainer(tmp_path / "paused", network)
    assert resumed.step == 9
    resumed.run(ignore, until=14)
    assert resumed.step == through.step == 14
    assert same_weights(through, resumed)
    other = make_trainer(tmp_path / "other", network, seed=1)
    other.run(ignore, until=3)
    assert not same_weights(through, other)


@pytest.mark.parametrize("network", ["balls", "hands"])
def test_a_run_may_start_where_another_ended(make_trainer, tmp_path, network) -> None:
    first = make_trainer(tmp_path / "first", network, steps=4)
    first.run(ignore)
    start = tmp_path / "first" / "tiny.safetensors"
    on = make_trainer(tmp_path / "on", network, start=start, steps=4)
    np.testing.assert_allclose(on.evaluate().logit, first.evaluate().logit, atol=1e-5)
    on.run(ignore)
    assert not same_weights(first, on)
    on.finish({}, "edgegrasp train data")
    _, metadata = load_checkpoint(tmp_path / "on" / "tiny.safetensors")
    assert metadata.training["started_from"] == "tiny"
    assert metadata.training["started_from_digest"] == load_checkpoint(start)[1].digest
    kept = make_trainer(tmp_path / "kept", network, start=start, steps=4, keep=1.0)
    kept.run(ignore)
    logit = kept.finish({}, "edgegrasp train data").logit  # all of the old weights is kept
    np.testing.assert_allclose(logit, first.evaluate().logit, atol=1e-4)


def test_weights_of_another_network_are_no_start(make_trainer, tmp_path) -> None:
    make_trainer(tmp_path / "balls", "balls", steps=1).run(ignore)
    with pytest.raises(ValueError, match="same model"):
        make_trainer(tmp_path / "on", "hands", start=tmp_path / "balls" / "tiny.safetensors")


def test_every_recipe_can_be_built_and_an_unknown_one_lists_them() -> None:
    for name in RECIPES:
        assert recipe(name).name == name
    with pytest.raises(ValueError, match=re.escape(", ".join(RECIPES))):
        recipe("edgegrasp-huge")
