import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import expit, logit
from tests.model.scenes import VIEW, box_on_table

from edgegrasp_model.detector import WEIGHTS_FOLDER, GraspDetector
from edgegrasp_model.networks.checkpoint import load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.options import DetectOptions
from edgegrasp_training.evaluation import fit_scale_and_shift, read_outcomes, recalibrate
from edgegrasp_training.examples import GRASPS_PER_BALL, Teacher
from edgegrasp_training.options import TrainingOptions
from edgegrasp_training.recipes import RECIPES, build_network
from edgegrasp_training.training import Trainer
from edgegrasp_training.views import find_views, split_by_scene

from .conftest import NETWORKS, SAMPLE, made_up_view

FAST = {"steps": 40, "views_per_step": 2, "balls_per_view": 3, "evaluate_every": 10}


@pytest.fixture(scope="session")
def make_trainer(views: list[Path]) -> Callable[..., Trainer]:
    """Makes the trainer of a small network, on made-up views unless others are given."""

    def make(folder, network="hands", name="tiny", views=views, teacher=None, start=None, **asked):
        metadata = CheckpointMetadata(name, NETWORKS[network], voxel_size=0.0045, gripper="panda")
        train, validation = split_by_scene(views, 0.25, seed=0)
        chosen = TrainingOptions(learning_rate=3e-3, **FAST | asked)
        return Trainer(metadata, train, validation, folder, chosen, teacher=teacher, start=start)

    return make


def same_weights(one: Trainer, other: Trainer) -> bool:
    state = other.network.state_dict()
    return all(torch.equal(value, state[name]) for name, value in one.network.state_dict().items())


def test_loss_falls_and_the_best_network_is_kept_with_a_card(make_trainer, tmp_path) -> None:
    run = make_trainer(tmp_path)
    before = run.evaluate()
    list(run.run())
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
    run = Trainer(metadata, train, validation, tmp_path, TrainingOptions(evaluate_every=1000))
    before = run.evaluate()
    list(run.run(until=20))
    after = run.evaluate()
    assert after.loss < 0.9 * before.loss
    assert after.auroc > 0.7


@pytest.mark.parametrize("network", ["balls", "hands"])
def test_pausing_and_resuming_is_the_same_as_going_through(make_trainer, tmp_path, network) -> None:
    through = make_trainer(tmp_path / "through", network)
    list(through.run(until=14))
    list(make_trainer(tmp_path / "paused", network).run(until=9))
    resumed = make_trainer(tmp_path / "paused", network)
    assert resumed.step == 9
    list(resumed.run(until=14))
    assert resumed.step == through.step == 14
    assert same_weights(through, resumed)
    with pytest.raises(ValueError, match=r"was begun with another seed\."):
        make_trainer(tmp_path / "paused", network, seed=1)
    other = make_trainer(tmp_path / "other", network, seed=1)
    list(other.run(until=3))
    assert not same_weights(through, other)


@pytest.mark.parametrize("network", ["balls", "hands"])
def test_a_run_may_start_where_another_ended(make_trainer, tmp_path, network) -> None:
    first = make_trainer(tmp_path / "first", network, steps=4)
    list(first.run())
    start = tmp_path / "first" / "tiny.safetensors"
    on = make_trainer(tmp_path / "on", network, start=start, steps=4)
    np.testing.assert_allclose(on.evaluate().logit, first.evaluate().logit, atol=1e-5)
    list(on.run())
    assert not same_weights(first, on)
    on.finish({}, "edgegrasp train data")
    _, metadata = load_checkpoint(tmp_path / "on" / "tiny.safetensors")
    assert metadata.training["started_from"] == "tiny"
    assert metadata.training["started_from_digest"] == load_checkpoint(start)[1].digest
    half = make_trainer(tmp_path / "half", network, start=start, steps=4, keep=0.5)
    list(half.run())
    np.testing.assert_array_equal(*(half.finish({}, "").logit for _ in range(2)))
    kept = make_trainer(tmp_path / "kept", network, start=start, steps=4, keep=1.0)
    list(kept.run())
    logit = kept.finish({}, "edgegrasp train data").logit  # all of the old weights is kept
    np.testing.assert_allclose(logit, first.evaluate().logit, atol=1e-4)


@pytest.fixture(scope="module")
def teacher(make_trainer, tmp_path_factory: pytest.TempPathFactory) -> Teacher:
    """A hand network that learned which grasps of the made-up views hold."""
    folder = tmp_path_factory.mktemp("guide")
    trainer = make_trainer(folder, name="guide")
    list(trainer.run())
    trainer.finish({}, "")
    return Teacher(folder / "guide.safetensors", 0.04)


def test_a_teacher_scores_candidates_above_the_table(views, teacher) -> None:
    view = made_up_view(0)
    labels = teacher.soft_labels(views[0])
    balls, count = np.unique(labels.candidates.approach_index, return_counts=True)
    assert 6 < len(balls) <= 24
    assert set(np.unique(view.approach_index)) <= set(balls.tolist())
    assert 0 < count.max() <= GRASPS_PER_BALL
    toward, chance = labels.candidates.approach[:, 2].astype(float), labels.chance.astype(float)
    assert chance[toward > 0.6].mean() > 1.5 * chance[toward < 0.2].mean()


def test_loss_falls_with_a_teacher_who_is_named_in_card_and_checkpoint(
    make_trainer, teacher: Teacher, tmp_path: Path
) -> None:
    run = make_trainer(tmp_path, "balls", teacher=teacher)
    before = run.evaluate()
    list(run.run())
    after = run.finish({}, "edgegrasp train data --teacher guide.safetensors")
    assert after.loss < 0.9 * before.loss
    _, metadata = load_checkpoint(tmp_path / "tiny.safetensors")
    digest = teacher.metadata.digest
    assert metadata.training["teacher"] == "guide"
    assert metadata.training["teacher_digest"] == digest
    card = (tmp_path / "tiny.md").read_text()
    assert "| teacher | guide |" in card
    assert digest in card


def test_a_teacher_alone_labels_views_in_which_no_grasp_was_tried(make_trainer, teacher, tmp_path):
    for number in range(8):
        none = dict.fromkeys(("approach_index", "contact_index", "success"), np.empty(0, np.int8))
        replace(made_up_view(number), **none).save(tmp_path / f"packed_{number}_0.npz")
    run = make_trainer(tmp_path / "run", "balls", teacher=teacher, views=find_views([tmp_path]))
    before = run.evaluate()
    list(run.run())
    assert run.evaluate().loss < 0.95 * before.loss


def test_hands_go_on_with_hands_alone_and_teach_balls_alone(make_trainer, teacher, tmp_path):
    list(make_trainer(tmp_path / "balls", "balls", steps=1).run())
    balls = tmp_path / "balls" / "tiny.safetensors"
    with pytest.raises(ValueError, match="same model"):
        make_trainer(tmp_path / "on", "hands", start=balls)
    with pytest.raises(ValueError, match="holds another model"):
        make_trainer(tmp_path / "balls", "hands")
    with pytest.raises(ValueError, match="teacher: got a network of architecture 'edgegrasp'"):
        Teacher(balls, 0.04)
    with pytest.raises(ValueError, match="tiny learns from labels alone"):
        make_trainer(tmp_path / "run", "hands", teacher=teacher)


def write_outcomes(folder: Path, digest: str, held: list[bool]) -> Path:
    """Add outcomes of grasps, scored 0.9 by the weights of a digest, to a file."""
    file = folder / "outcomes.jsonl"
    with file.open("a") as lines:
        for one in held:
            lines.write(json.dumps({"digest": digest, "score": 0.9, "held": one}) + "\n")
    return file


@pytest.mark.parametrize("name", ["balls", "vn", "hands"])
def test_the_new_weights_answer_the_fitted_probability(name, tmp_path):
    config, old = NETWORKS[name], tmp_path / "old.safetensors"
    metadata = CheckpointMetadata("old", config, 0.0045, "panda", temperature=1.5)
    network = build_network(config, torch.Generator().manual_seed(0))
    save_checkpoint(old, network, metadata)
    network, metadata = load_checkpoint(old)
    file = write_outcomes(tmp_path, metadata.digest, [number % 3 == 0 for number in range(60)])
    write_outcomes(tmp_path, "of other weights", [True])
    for wrong in ('{"held": 3, "score": 0.9}', '{"held": true, "score": NaN}', '{"held": true}'):
        (tmp_path / "wrong.jsonl").write_text(f'{wrong[:-1]}, "digest": "a"}}\n')
        with pytest.raises(ValueError, match=r"wrong\.jsonl, line 1"):
            read_outcomes(tmp_path / "wrong.jsonl", "a")
    assert recalibrate(old, file, tmp_path).startswith("60 outcomes, 0.33 held")
    new = tmp_path / "old-robot.safetensors"
    assert load_checkpoint(new)[1].training["recalibrated_from_digest"] == metadata.digest
    scale, shift = fit_scale_and_shift(*read_outcomes(file, metadata.digest))
    assert shift < -0.5
    options = DetectOptions(viewpoint=VIEW, min_score=0.0)
    box = box_on_table(table=True)
    before, after = GraspDetector.load(old), GraspDetector.load(new)
    answers = [one.detect(box, options) for one in (before, after)]
    assert max(one.confidence for one in answers[0].objects) < 1.0  # counts in the score
    poses = np.array([one.T_cloud_hand for one in answers[0].grasps])
    given = [one.score(box, options, hand_poses=poses).evaluations for one in (before, after)]
    for pair in ([one.grasps for one in answers], [[one.grasp for one in some] for some in given]):
        first, second = (np.array([one.score for one in grasps]) for grasps in pair)
        np.testing.assert_allclose(second, expit(scale * logit(first) + shift), atol=1e-4)


def test_the_order_of_grasps_stays_and_few_outcomes_warn(tmp_path: Path) -> None:
    old = WEIGHTS_FOLDER / "edgegrasp-plus.safetensors"
    before = GraspDetector.load(old)
    file = write_outcomes(tmp_path, before.metadata.digest, [row == 0 for row in range(9)])
    assert "Warning: fewer than 25 outcomes" in recalibrate(old, file, tmp_path)
    after = GraspDetector.load(tmp_path / "edgegrasp-plus-robot.safetensors")
    box = np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * (0.02, 0.03, 0.05)
    boxes = np.concatenate([box, box @ np.diag([1, 0.6, 1]) + (0.15, 0, 0)])
    alone = {"support": None, "objects": "off", "order": "highest", "min_score": 0.0}
    options = DetectOptions(viewpoint=(0.0, -0.3, 0.5), **alone)
    for asked in (options, options.model_copy(update={"order": "score"})):
        first, second = (one.detect(boxes, asked).grasps for one in (before, after))
        assert len(first) > 5
        for one, other in zip(first, second, strict=True):
            np.testing.assert_array_equal(one.T_cloud_hand, other.T_cloud_hand)
        assert second[0].score < first[0].score - 0.1
