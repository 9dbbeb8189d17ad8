from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edgegrasp_model.networks.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_training.teacher import GRASPS_PER_BALL, Teacher
from edgegrasp_training.training import Trainer

MakeTrainer = Callable[..., Trainer]


@pytest.fixture(scope="module")
def weights(make_trainer: MakeTrainer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hand network that learned which grasps of the made-up views hold."""
    folder = tmp_path_factory.mktemp("guide")
    trainer = make_trainer(folder, name="guide")
    trainer.run(lambda step, loss: None)
    trainer.finish({}, "")
    return folder / "guide.safetensors"


@pytest.fixture(scope="module")
def teacher(weights: Path) -> Teacher:
    return Teacher(weights, 0.04)


def test_a_teacher_scores_candidates_above_the_table(made_up_view, views, teacher) -> None:
    view = made_up_view(0)
    labels = teacher.soft_labels(views[0])
    balls, count = np.unique(labels.approach_index, return_counts=True)
    assert 6 < len(balls) <= 24
    assert set(np.unique(view.approach_index)) <= set(balls.tolist())
    assert 0 < count.max() <= GRASPS_PER_BALL
    toward, chance = labels.approach[:, 2].astype(float), labels.chance.astype(float)
    assert chance[toward > 0.6].mean() > 1.5 * chance[toward < 0.2].mean()


def test_loss_falls_with_a_teacher_who_is_named_in_card_and_checkpoint(
    make_trainer: MakeTrainer, teacher: Teacher, tmp_path: Path
) -> None:
    run = make_trainer(tmp_path, "balls", teacher=teacher)
    before = run.evaluate()
    run.run(lambda step, loss: None)
    after = run.finish({}, "edgegrasp train data --teacher guide.safetensors")
    assert after.loss < 0.9 * before.loss
    _, metadata = load_checkpoint(tmp_path / "tiny.safetensors")
    digest = teacher.metadata.digest
    assert metadata.training["teacher"] == "guide"
    assert metadata.training["teacher_digest"] == digest
    card = (tmp_path / "tiny.md").read_text()
    assert "| teacher | guide |" in card
    assert digest in card


def test_only_hands_teach_and_only_balls_are_taught(make_trainer, networks, teacher, tmp_path):
    metadata = CheckpointMetadata("tiny", networks["balls"], voxel_size=0.0045, gripper="panda")
    save_checkpoint(tmp_path / "tiny.safetensors", build_network(networks["balls"]), metadata)
    with pytest.raises(ValueError, match="teacher: got a network of architecture 'edgegrasp'"):
        Teacher(tmp_path / "tiny.safetensors", 0.04)
    with pytest.raises(ValueError, match="tiny learns from labels alone"):
        make_trainer(tmp_path / "run", "hands", teacher=teacher)
