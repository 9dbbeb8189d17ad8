from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from edgegrasp_model.candidates.edge_grasps import support_clearance
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.scene.scene import near_workspace_side
from edgegrasp_training.examples import (
    SUPPORT,
    TRIED_WEIGHT,
    UP,
    WORKSPACE,
    Lessons,
    pack_balls,
    tried_grasps,
)
from edgegrasp_training.teacher import GRASPS_PER_BALL, Teacher
from edgegrasp_training.training import Trainer, TrainingOptions
from edgegrasp_training.views import LabelledView, split_by_scene

MakeView = Callable[[int], LabelledView]
TINY = NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (16, 8), crop_radius=0.04)
HAND = NetworkConfig(
    "hand", hand_widths=(8, 16), hand_points=16, classifier_widths=(16, 8), crop_radius=0.04
)
FAST = TrainingOptions(
    steps=40, views_per_step=2, balls_per_view=3, learning_rate=3e-3, evaluate_every=10
)


@pytest.fixture(scope="module")
def weights(views: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hand network that learned which grasps of the made-up views hold."""
    folder = tmp_path_factory.mktemp("teacher")
    metadata = CheckpointMetadata("guide", HAND, voxel_size=0.0045, gripper="panda")
    train, validation = split_by_scene(views, 0.25, seed=0)
    trainer = Trainer(metadata, train, validation, folder, FAST)
    trainer.run(lambda step, loss: None)
    trainer.finish({}, "")
    return folder / "guide.safetensors"


def test_lessons_hold_what_the_teacher_says_of_candidates_above_the_table(
    made_up_view: MakeView, views: list[Path], weights: Path, tmp_path: Path
) -> None:
    view, teacher = made_up_view(0), Teacher(weights, 0.04, tmp_path)
    lessons = teacher.lessons(views[0])
    balls, count = np.unique(lessons.approach_index, return_counts=True)
    assert 6 < len(balls) <= 24
    assert set(np.unique(view.approach_index)) <= set(balls.tolist())
    assert 0 < count.max() <= GRASPS_PER_BALL
    toward = lessons.approach[:, 2].astype(float)
    chance = lessons.chance.astype(float)
    assert chance[toward > 0.6].mean() > 1.5 * chance[toward < 0.2].mean()

    # The hands of the view's own labels: as the network scores them when asked itself.
    grasps = tried_grasps(view, HAND, load_gripper())
    network, metadata = load_checkpoint(weights)
    hands = HandBatch.from_cloud(
        grasps.cloud,
        grasps.candidates,
        load_gripper(),
        UP,
        SUPPORT,
        view.camera_position,
        near_workspace_side(view.points, WORKSPACE, UP),
        HAND.hand_points,
    )
    with torch.inference_mode():
        own = torch.sigmoid(network(hands) / metadata.temperature).numpy()
    pairs = list(zip(lessons.approach_index.tolist(), lessons.contact_index.tolist(), strict=True))
    above = support_clearance(grasps.candidates.T_cloud_hand, SUPPORT, load_gripper()) > 0
    tried = grasps.candidates
    compared = [
        (own[row], chance[pairs.index(pair)])
        for row, pair in enumerate(
            zip(tried.approach_index.tolist(), tried.contact_index.tolist(), strict=True)
        )
        if above[row]
        and pairs.count(pair) == 1
        and np.allclose(tried.approach[row], lessons.approach[pairs.index(pair)], atol=2e-3)
    ]
    assert len(compared) > 10
    np.testing.assert_allclose(*np.transpose(compared), atol=2e-3)


def test_lessons_are_kept_and_a_changed_view_or_teacher_gets_new_ones(
    made_up_view: MakeView, views: list[Path], weights: Path, tmp_path: Path
) -> None:
    teacher = Teacher(weights, 0.04, tmp_path / "kept")
    first = teacher.lessons(views[0])
    (kept,) = (tmp_path / "kept").rglob("*.npz")
    written = kept.stat().st_mtime_ns
    again = Teacher(weights, 0.04, tmp_path / "kept").lessons(views[0])
    assert kept.stat().st_mtime_ns == written
    np.testing.assert_array_equal(first.chance, again.chance)
    same = tmp_path / views[0].name
    made_up_view(5).save(same)
    assert not np.array_equal(teacher.lessons(same).contact_index, first.contact_index)
    fresh = Teacher(weights, 0.04, tmp_path / "fresh").lessons(views[0])
    np.testing.assert_array_equal(fresh.chance, first.chance)


def test_a_view_without_points_teaches_nothing(
    made_up_view: MakeView, weights: Path, tmp_path: Path
) -> None:
    view = made_up_view(0)
    none = np.empty(0, np.int64)
    empty = replace(
        view,
        points=view.points[:0],
        normals=view.normals[:0],
        approach_index=none,
        contact_index=none,
        success=none.astype(np.int8),
    )
    empty.save(tmp_path / "packed_0_0.npz")
    lessons = Teacher(weights, 0.04, tmp_path / "kept").lessons(tmp_path / "packed_0_0.npz")
    assert len(lessons.chance) == 0


def test_lessons_are_packed_beside_the_labels_which_weigh_more(
    made_up_view: MakeView, views: list[Path], weights: Path, tmp_path: Path
) -> None:
    lessons = Teacher(weights, 0.04, tmp_path).lessons(views[0])
    grasps = tried_grasps(made_up_view(0), TINY, load_gripper())
    balls = np.unique(lessons.approach_index).astype(np.int64)
    batch, label, weight = pack_balls(grasps, balls, TINY, lessons)
    tried = weight == TRIED_WEIGHT
    assert tried.sum() == len(grasps.label)
    np.testing.assert_array_equal(np.sort(label[tried]), np.sort(grasps.label))
    np.testing.assert_array_equal(np.sort(label[~tried]), np.sort(lessons.chance))
    torch.testing.assert_close(
        batch.approach.norm(dim=1), torch.ones(len(label)), atol=2e-3, rtol=0
    )


def trainer(views: list[Path], weights: Path, folder: Path, options: TrainingOptions) -> Trainer:
    metadata = CheckpointMetadata("tiny", TINY, voxel_size=0.0045, gripper="panda")
    train, validation = split_by_scene(views, 0.25, seed=0)
    teacher = Teacher(weights, TINY.crop_radius, folder.parent / "taught")
    return Trainer(metadata, train, validation, folder, options, teacher=teacher)


def test_loss_falls_with_a_teacher_who_is_named_in_card_and_checkpoint(
    views: list[Path], weights: Path, tmp_path: Path
) -> None:
    run = trainer(views, weights, tmp_path / "run", FAST)
    before = run.evaluate()
    run.run(lambda step, loss: None)
    after = run.finish({}, "edgegrasp train data --teacher guide.safetensors")
    assert after.loss < 0.9 * before.loss
    _, metadata = load_checkpoint(tmp_path / "run" / "tiny.safetensors")
    digest = load_checkpoint(weights)[1].digest
    assert metadata.training["teacher"] == "guide"
    assert metadata.training["teacher_digest"] == digest
    card = (tmp_path / "run" / "tiny.md").read_text()
    assert "| teacher | guide |" in card
    assert digest in card


def test_pausing_and_resuming_with_a_teacher_is_the_same_as_going_through(
    views: list[Path], weights: Path, tmp_path: Path
) -> None:
    options = replace(FAST, schedule="cosine", rotations="none")
    through = trainer(views, weights, tmp_path / "through", options)
    through.run(lambda step, loss: None, until=12)
    trainer(views, weights, tmp_path / "paused", options).run(lambda step, loss: None, until=7)
    resumed = trainer(views, weights, tmp_path / "paused", options)
    resumed.run(lambda step, loss: None, until=12)
    assert resumed.step == through.step == 12
    for name, weight in through.network.state_dict().items():
        torch.testing.assert_close(weight, resumed.network.state_dict()[name], rtol=0, atol=0)


def test_only_hands_teach_and_only_balls_are_taught(
    views: list[Path], weights: Path, tmp_path: Path
) -> None:
    metadata = CheckpointMetadata("tiny", TINY, voxel_size=0.0045, gripper="panda")
    save_checkpoint(tmp_path / "tiny.safetensors", build_network(TINY), metadata)
    with pytest.raises(ValueError, match="teacher: got a network of architecture 'edgegrasp'"):
        Teacher(tmp_path / "tiny.safetensors", 0.04, tmp_path)
    hand = replace(metadata, network=HAND)
    teacher = Teacher(weights, 0.04, tmp_path)
    with pytest.raises(ValueError, match="tiny learns from labels alone"):
        Trainer(hand, views[:4], views[4:], tmp_path / "run", FAST, teacher=teacher)


def test_lessons_come_back_from_their_file(tmp_path: Path) -> None:
    Lessons.none().save(tmp_path / "none.npz")
    assert len(Lessons.load(tmp_path / "none.npz").approach) == 0
