from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.checkpoint import load_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.scene.scene import near_workspace_side
from edgegrasp_training.ball_network import LENGTH_UNIT
from edgegrasp_training.examples import (
    SUPPORT,
    UP,
    WORKSPACE,
    pack_balls,
    pack_hands,
    random_turn,
    tried_grasps,
    turned,
)
from edgegrasp_training.recipes import RECIPES, recipe
from edgegrasp_training.training import Trainer, TrainingOptions
from edgegrasp_training.views import LabelledView, split_by_scene

MakeView = Callable[[int], LabelledView]
TINY = NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (16, 8), crop_radius=0.04)
VN = NetworkConfig("vn-edgegrasp", (6, 6, 6), (6, 9, 9), (9, 9), (16, 8, 4), crop_radius=0.04)
HAND = NetworkConfig(
    "hand", hand_widths=(8, 16), hand_points=16, classifier_widths=(16, 8), crop_radius=0.04
)
FAST = TrainingOptions(
    steps=40, views_per_step=2, balls_per_view=3, learning_rate=3e-3, evaluate_every=10
)


def trainer(views: list[Path], folder: Path, config: NetworkConfig = HAND) -> Trainer:
    metadata = CheckpointMetadata("tiny", config, voxel_size=0.0045, gripper="panda")
    train, validation = split_by_scene(views, 0.25, seed=0)
    return Trainer(metadata, train, validation, folder, FAST)


def test_loss_falls_and_the_best_network_is_kept_with_a_card(
    views: list[Path], tmp_path: Path
) -> None:
    run = trainer(views, tmp_path)
    before = run.evaluate()
    run.run(lambda step, loss: None)
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


@pytest.mark.parametrize("config", [TINY, HAND], ids=["balls", "hands"])
def test_pausing_and_resuming_is_the_same_as_going_through(
    views: list[Path], tmp_path: Path, config: NetworkConfig
) -> None:
    through = trainer(views, tmp_path / "through", config)
    through.run(lambda step, loss: None, until=14)
    first = trainer(views, tmp_path / "paused", config)
    first.run(lambda step, loss: None, until=9)
    resumed = trainer(views, tmp_path / "paused", config)
    assert resumed.step == 9
    resumed.run(lambda step, loss: None, until=14)
    assert resumed.step == through.step == 14
    for one, other in zip(
        through.network.state_dict().values(), resumed.network.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize("config", [TINY, VN, HAND], ids=["balls", "vn", "hands"])
def test_mixed_precision_steps_are_nearly_those_in_full(
    views: list[Path], tmp_path: Path, config: NetworkConfig
) -> None:
    losses: dict[bool, list[float]] = {False: [], True: []}
    for mixed, kept in losses.items():
        run = trainer(views, tmp_path / str(mixed), config)
        run.options = replace(run.options, mixed_precision=mixed)
        run.run(lambda step, loss, kept=kept: kept.append(loss), until=3)
        assert all(value.dtype == torch.float32 for value in run.network.parameters())
    assert losses[True] != losses[False]
    np.testing.assert_allclose(losses[True], losses[False], rtol=0.05)


def test_the_seed_decides_everything(views: list[Path], tmp_path: Path) -> None:
    runs = [trainer(views, tmp_path / str(i)) for i in range(2)]
    for run in runs:
        run.run(lambda step, loss: None, until=3)
    one, other = (run.network.state_dict()["classifier.0.weight"] for run in runs)
    torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_packed_balls_hold_each_tried_grasp_and_its_contact(
    made_up_view: MakeView, views: list[Path]
) -> None:
    view = made_up_view(1)
    grasps = tried_grasps(view, TINY, load_gripper())
    batch, label, weight = pack_balls(grasps, grasps.balls(), TINY)
    assert len(label) == len(grasps.label) == len(batch.contact)
    assert (weight == 1).all()
    contact = grasps.cloud.points[grasps.candidates.contact_index]
    edge = contact - grasps.cloud.points[grasps.candidates.approach_index]
    found = batch.points[batch.contact].numpy() * LENGTH_UNIT
    np.testing.assert_allclose(found, edge @ grasps.turn.T, atol=1e-6)
    depth = batch.depth.numpy() * LENGTH_UNIT
    np.testing.assert_allclose(depth, grasps.candidates.depth, atol=1e-6)
    some = pack_balls(grasps, grasps.balls()[:2], TINY)
    assert some.batch.num_balls == 2
    assert 0 < len(some.label) < len(label)


def test_packed_balls_lie_in_the_axes_that_a_detector_works_in(made_up_view: MakeView) -> None:
    view = replace(made_up_view(1), camera_position=np.array([0.5, -0.3, 0.6], np.float32))
    grasps = tried_grasps(view, TINY, load_gripper())
    np.testing.assert_allclose(grasps.turn @ grasps.turn.T, np.eye(3), atol=1e-6)
    toward_camera = grasps.turn @ (view.camera_position - view.points.mean(axis=0))
    assert toward_camera[0] > 0.5
    assert toward_camera[1] == pytest.approx(0, abs=1e-5)
    assert (grasps.turn @ UP)[2] == pytest.approx(1)


def test_packed_hands_are_what_the_detector_would_pack_and_vary_with_a_stream(
    made_up_view: MakeView,
) -> None:
    view = made_up_view(1)
    grasps = tried_grasps(view, HAND, load_gripper())
    batch, label, _ = pack_hands(grasps, grasps.balls()[:2], HAND)
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, grasps.balls()[:2]))
    np.testing.assert_array_equal(label.numpy(), grasps.label[rows])
    assert batch.num_balls == 2
    exact = HandBatch.from_cloud(
        grasps.cloud,
        grasps.candidates.take(rows),
        load_gripper(),
        UP,
        SUPPORT,
        view.camera_position,
        near_workspace_side(view.points, WORKSPACE, UP),
        HAND.hand_points,
    )
    torch.testing.assert_close(batch.description, exact.description, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(batch.point_count, exact.point_count)
    varied = pack_hands(grasps, grasps.balls()[:2], HAND, np.random.default_rng(0)).batch
    assert not torch.equal(varied.points, batch.points)
    there = torch.arange(HAND.hand_points) < varied.point_count[:, None]
    assert (varied.points[there].abs().sum(dim=1) > 0).all()
    assert (varied.points[~there] == 0).all()


def test_a_hand_whose_camera_is_not_known_is_told_of_none(made_up_view: MakeView) -> None:
    view, gripper = made_up_view(1), load_gripper()
    known = tried_grasps(view, HAND, gripper).seen
    unknown = tried_grasps(view, HAND, gripper, viewpoint_known=False).seen
    assert known is not None
    assert unknown is not None
    changed = (known.description != unknown.description).any(axis=0)
    camera = slice(-8 - 6, -8 - 3)  # before the direction of up and the eight of the stance
    assert changed[camera].all()
    assert (unknown.description[:, camera] == 0).all()


def test_augmentation_turns_points_normals_and_approach_alike(made_up_view: MakeView) -> None:
    grasps = tried_grasps(made_up_view(2), TINY, load_gripper())
    batch = pack_balls(grasps, grasps.balls(), TINY).batch
    other = turned(batch, random_turn("any", np.random.default_rng(0)))
    assert not torch.allclose(batch.points, other.points)
    lengths, cosines = batch.points.norm(dim=1), (batch.points * batch.normals).sum(dim=1)
    torch.testing.assert_close(other.points.norm(dim=1), lengths, atol=1e-5, rtol=1e-4)
    other_cosines = (other.points * other.normals).sum(dim=1)
    torch.testing.assert_close(other_cosines, cosines, atol=1e-4, rtol=1e-4)
    along = (batch.points[batch.contact] * batch.approach).sum(dim=1)
    along_other = (other.points[other.contact] * other.approach).sum(dim=1)
    torch.testing.assert_close(along, along_other, atol=1e-4, rtol=1e-4)


def test_random_turns_are_any_or_upright_or_none() -> None:
    rng = np.random.default_rng(0)
    turns = {kind: [random_turn(kind, rng) for _ in range(50)] for kind in ("any", "upright")}
    for turn in turns["any"] + turns["upright"]:
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    raised = {kind: [(turn @ UP)[2] for turn in some] for kind, some in turns.items()}
    assert min(raised["any"]) < -0.5
    assert max(raised["any"]) > 0.5
    np.testing.assert_allclose(raised["upright"], 1.0, atol=1e-6)
    headings = [turn[0, 0] for turn in turns["upright"]]
    assert min(headings) < -0.5
    assert max(headings) > 0.5
    np.testing.assert_array_equal(random_turn("none", rng), np.eye(3))


def test_a_cosine_takes_the_learning_rate_to_nothing_by_the_last_step(
    views: list[Path], tmp_path: Path
) -> None:
    train, validation = split_by_scene(views, 0.25, seed=0)
    metadata = CheckpointMetadata("tiny", TINY, voxel_size=0.0045, gripper="panda")
    options = replace(FAST, steps=8, evaluate_every=4, schedule="cosine")
    run = Trainer(metadata, train, validation, tmp_path, options)
    run.run(lambda step, loss: None)
    rates = np.loadtxt(tmp_path / "log.csv", delimiter=",", skiprows=1)[:, 1]
    half, last = options.learning_rate * (1 + np.cos(np.pi * np.array([3 / 8, 7 / 8]))) / 2
    np.testing.assert_allclose(rates, [half, last], rtol=1e-3)


def test_a_view_without_labels_is_passed_over(
    made_up_view: MakeView, views: list[Path], tmp_path: Path
) -> None:
    view = made_up_view(3)
    none = replace(view, success=np.full_like(view.success, -1))
    none.save(tmp_path / "packed_99_0.npz")
    train, validation = split_by_scene(views, 0.25, seed=0)
    metadata = CheckpointMetadata("tiny", TINY, voxel_size=0.0045, gripper="panda")
    paths = [tmp_path / "packed_99_0.npz", train[0]]
    run = Trainer(metadata, paths, validation, tmp_path / "run", FAST)
    run.run(lambda step, loss: None, until=2)
    assert run.step == 2


def test_every_recipe_can_be_built_and_an_unknown_one_lists_them() -> None:
    for name in RECIPES:
        assert recipe(name).name == name
    with pytest.raises(ValueError, match="edgegrasp-plus"):
        recipe("edgegrasp-huge")


def test_a_grasp_that_stays_when_shaken_is_worth_a_little_more(made_up_view: MakeView) -> None:
    view = made_up_view(1)
    firm = np.where(view.success == 1, np.arange(len(view.success)) % 2, view.success)
    shaken = tried_grasps(replace(view, firm=firm.astype(np.int8)), TINY, load_gripper()).label
    unknown = tried_grasps(view, TINY, load_gripper()).label
    assert set(shaken.tolist()) == {0.0, 1.0, np.float32(0.8)}
    assert len(set(unknown.tolist())) == 2
    np.testing.assert_array_equal(unknown > 0.5, shaken > 0.5)
    assert 0.8 < unknown.max() < 1
