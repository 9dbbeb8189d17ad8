from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from edgegrasp_model.candidates import edge_grasps
from edgegrasp_model.checkpoint import CheckpointMetadata, load_checkpoint
from edgegrasp_model.cloud import Cloud
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.scene import at_workspace_side
from edgegrasp_training.examples import (
    SUPPORT,
    UP,
    WORKSPACE,
    pack_balls,
    pack_hands,
    rotated,
    tried_grasps,
)
from edgegrasp_training.recipes import RECIPES, recipe
from edgegrasp_training.training import Trainer, TrainingOptions
from edgegrasp_training.views import LabelledView, find_views, split_by_scene

TINY = NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (16, 8), crop_radius=0.04)
HAND = NetworkConfig(
    "hand", hand_widths=(8, 16), hand_points=16, classifier_widths=(16, 8), crop_radius=0.04
)
FAST = TrainingOptions(
    steps=40, views_per_step=2, balls_per_view=3, learning_rate=3e-3, evaluate_every=10
)


def made_up_view(seed: int) -> LabelledView:
    """A box on the table; grasps from above are said to hold, others not."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (300, 3)) * (0.05, 0.05, 0.06)
    face = rng.integers(3, size=300)
    points[np.arange(300), face] = np.sign(points[np.arange(300), face]) * (0.025, 0.025, 0.03)[0]
    normals = np.zeros((300, 3))
    normals[np.arange(300), face] = np.sign(points[np.arange(300), face])
    points += (0.15, 0.15, 0.085)
    cloud = Cloud(points.astype(np.float32), normals.astype(np.float32))
    approach = np.repeat(rng.choice(300, 6, replace=False), 30)
    contact = rng.integers(300, size=len(approach))
    made = edge_grasps(cloud, approach, contact, load_gripper())
    label = np.full(len(approach), -1, np.int8)
    label[made.pair] = made.approach[:, 2] > 0.4
    return LabelledView(
        cloud.points,
        cloud.normals,
        np.array([0.15, 0.15, 0.8], np.float32),
        approach,
        contact,
        None,
        label,
    )


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("views")
    for number in range(8):
        made_up_view(number).save(folder / f"packed_{number}_0.npz")
    return find_views([folder])


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


def test_the_seed_decides_everything(views: list[Path], tmp_path: Path) -> None:
    runs = [trainer(views, tmp_path / str(i)) for i in range(2)]
    for run in runs:
        run.run(lambda step, loss: None, until=3)
    one, other = (run.network.state_dict()["classifier.0.weight"] for run in runs)
    torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_packed_balls_hold_each_tried_grasp_and_its_contact(views: list[Path]) -> None:
    view = made_up_view(1)
    grasps = tried_grasps(view, TINY, load_gripper())
    batch, label = pack_balls(grasps, grasps.balls(), TINY)
    assert len(label) == len(grasps.label) == len(batch.contact)
    order = np.argsort(grasps.candidates.approach_index, kind="stable")
    contact = grasps.cloud.points[grasps.candidates.contact_index]
    edge = contact - grasps.cloud.points[grasps.candidates.approach_index]
    found = batch.points[batch.contact].numpy()
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(edge[order], axis=0), atol=1e-6)
    some, some_label = pack_balls(grasps, grasps.balls()[:2], TINY)
    assert some.num_balls == 2
    assert 0 < len(some_label) < len(label)


def test_packed_hands_are_what_the_detector_would_pack_and_vary_with_a_stream() -> None:
    view = made_up_view(1)
    grasps = tried_grasps(view, HAND, load_gripper())
    batch, label = pack_hands(grasps, grasps.balls()[:2], HAND)
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
        at_workspace_side(view.points, WORKSPACE, UP),
        HAND.hand_points,
    )
    torch.testing.assert_close(batch.description, exact.description, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(batch.point_count, exact.point_count)
    varied, _ = pack_hands(grasps, grasps.balls()[:2], HAND, np.random.default_rng(0))
    assert not torch.equal(varied.points, batch.points)
    there = torch.arange(HAND.hand_points) < varied.point_count[:, None]
    assert (varied.points[there].abs().sum(dim=1) > 0).all()
    assert (varied.points[~there] == 0).all()


def test_a_hand_whose_camera_is_not_known_is_told_of_none() -> None:
    view, gripper = made_up_view(1), load_gripper()
    known = tried_grasps(view, HAND, gripper).seen
    unknown = tried_grasps(view, HAND, gripper, viewpoint_known=False).seen
    assert known is not None
    assert unknown is not None
    changed = (known.description != unknown.description).any(axis=0)
    camera = slice(-8 - 6, -8 - 3)  # before the direction of up and the eight of the stance
    assert changed[camera].all()
    assert (unknown.description[:, camera] == 0).all()


def test_augmentation_turns_points_normals_and_approach_alike(views: list[Path]) -> None:
    grasps = tried_grasps(made_up_view(2), TINY, load_gripper())
    batch, _ = pack_balls(grasps, grasps.balls(), TINY)
    turned = rotated(batch, np.random.default_rng(0))
    assert not torch.allclose(batch.points, turned.points)
    lengths, cosines = batch.points.norm(dim=1), (batch.points * batch.normals).sum(dim=1)
    torch.testing.assert_close(turned.points.norm(dim=1), lengths, atol=1e-6, rtol=1e-4)
    turned_cosines = (turned.points * turned.normals).sum(dim=1)
    torch.testing.assert_close(turned_cosines, cosines, atol=1e-5, rtol=1e-4)
    along = (batch.points[batch.contact] * batch.approach).sum(dim=1)
    along_turned = (turned.points[turned.contact] * turned.approach).sum(dim=1)
    torch.testing.assert_close(along, along_turned, atol=1e-5, rtol=1e-4)


def test_a_view_without_labels_is_passed_over(views: list[Path], tmp_path: Path) -> None:
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
