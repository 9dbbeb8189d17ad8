"""The labelled views that come with the project."""

import re
from pathlib import Path

import pytest

from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_training.data_card import CARD_FILE, write_data_card
from edgegrasp_training.recipes import RECIPES
from edgegrasp_training.training import Trainer, TrainingOptions
from edgegrasp_training.views import find_views, load_view, split_by_scene

SAMPLE = Path(__file__).parents[2] / "examples" / "labelled_views"


def trainer(folder: Path, **options: int) -> Trainer:
    train, validation = split_by_scene(find_views([SAMPLE]), 0.1, seed=0)
    metadata = CheckpointMetadata("sample", RECIPES["edgegrasp-plus"], 0.0045, "panda")
    return Trainer(metadata, train, validation, folder, TrainingOptions(**options))


def test_loss_falls_in_a_few_steps_and_going_on_is_exact(tmp_path: Path) -> None:
    through = trainer(tmp_path / "through", evaluate_every=1000)
    before = through.evaluate()
    through.run(lambda step, loss: None, until=40)
    after = through.evaluate()
    assert after.loss < 0.8 * before.loss
    assert after.auroc > 0.8
    trainer(tmp_path / "paused", evaluate_every=1000).run(lambda step, loss: None, until=25)
    resumed = trainer(tmp_path / "paused", evaluate_every=1000)
    assert resumed.step == 25
    resumed.run(lambda step, loss: None, until=40)
    assert resumed.evaluate().loss == after.loss


def test_every_view_says_which_objects_it_shows() -> None:
    for path in find_views([SAMPLE]):
        view = load_view(path)
        assert len(view.objects) == len(view.object_digests) > 0
        assert view.firm is not None
        assert (view.firm <= view.success).all()


@pytest.mark.parametrize("kind", SceneKind)
def test_no_test_object_is_in_a_training_view(shared_dir: Path, kind: SceneKind) -> None:
    kept_apart = ObjectSet.from_folder(shared_dir / "objects", kind, "test").models
    names, digests = {model.name for model in kept_apart}, {model.digest for model in kept_apart}
    # A generator's own folder, where there is one, is held to the same.
    generated = [path for path in (SAMPLE.parents[1] / "data").glob("*") if any(path.glob("*.npz"))]
    for path in find_views([SAMPLE, *generated]):
        view = load_view(path)
        assert not names & set(view.objects), path
        assert not digests & set(view.object_digests), path


def test_the_card_counts_what_is_there(tmp_path: Path) -> None:
    paths = find_views([SAMPLE])
    card = write_data_card(tmp_path, paths, "edgegrasp generate-data").read_text()
    committed = (SAMPLE / CARD_FILE).read_text()
    assert card.split("Made by:")[0] == committed.split("Made by:")[0]
    tried = sum(len(load_view(path).tried()) for path in paths)
    assert f"| {tried} |" in card


@pytest.mark.parametrize("kind", SceneKind)
def test_no_test_object_is_in_the_data_of_the_shipped_weights(
    shared_dir: Path, kind: SceneKind
) -> None:
    card = (SAMPLE.parents[1] / "docs" / "training_data.md").read_text()
    listed = re.findall(r"^- (\S+) `([0-9a-f]{64})`: \d+$", card, re.MULTILINE)
    assert len(listed) > 300
    kept_apart = ObjectSet.from_folder(shared_dir / "objects", kind, "test").models
    assert not {name for name, _ in listed} & {model.name for model in kept_apart}
    assert not {digest for _, digest in listed} & {model.digest for model in kept_apart}
