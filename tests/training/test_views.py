import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import expit

from edgegrasp_model.gripper import gripper_fields, load_gripper
from edgegrasp_model.networks.checkpoint import load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.scene.scene import Surroundings, near_workspace_side
from edgegrasp_sim.objects import CLUTTER, ObjectSet
from edgegrasp_training import views
from edgegrasp_training.evaluation import evaluate_scores, reliability, score_views
from edgegrasp_training.examples import pack_balls, pack_hands, tried_grasps
from edgegrasp_training.recipes import LENGTH_UNIT, build_network
from edgegrasp_training.views import TABLE, UP, WORKSPACE, scene_of

from .conftest import NETWORKS, SAMPLE, made_up_view


def test_a_view_comes_back_with_the_hand_that_tried_its_grasps_other_files_do_not(tmp_path) -> None:
    file, view = tmp_path / "pile_1-000001_0.npz", made_up_view(0)
    view.save(file)
    read = views.load_view(file)
    np.testing.assert_array_equal(read.points, view.points)
    np.testing.assert_allclose(read.normals, view.normals, atol=1e-3)
    np.testing.assert_array_equal(read.success, view.success)
    assert (read.T_world_hand, read.hand) == (None, load_gripper("panda"))
    hands = np.arange(len(view.success) * 16, dtype=np.float32).reshape(-1, 4, 4)
    tried = replace(view, T_world_hand=hands, gripper=json.dumps(gripper_fields("robotiq-2f-140")))
    tried.save(file)
    np.testing.assert_array_equal(views.load_view(file).T_world_hand, hands)
    assert views.load_view(file).hand == load_gripper("robotiq-2f-140")
    np.savez(file, depth=np.zeros(3))
    for content in (file.read_bytes(), file.read_bytes()[:99]):
        file.write_bytes(content)
        with pytest.raises(ValueError, match="is not a view"):
            views.load_view(file)


def test_scenes_never_fall_on_both_sides_and_keep_theirs_as_data_grows() -> None:
    paths = [Path(f"pile_{scene}_{view}.npz") for scene in range(200) for view in range(2)]
    train, validation = views.split_by_scene(paths, 0.2, seed=0)
    assert {scene_of(path) for path in train}.isdisjoint(map(scene_of, validation))
    assert len(train) + len(validation) == len(paths)
    assert 0.1 < len(validation) / len(paths) < 0.3
    _, fewer = views.split_by_scene(paths[:100], 0.2, seed=0)
    assert set(fewer) <= set(validation)
    _, others = views.split_by_scene(paths, 0.2, seed=1)
    assert set(others) != set(validation)


def test_every_view_says_which_objects_it_shows() -> None:
    for path in views.find_views([SAMPLE]):
        view = views.load_view(path)
        assert len(view.objects) == len(view.object_digests) > 0
        assert (view.firm <= view.success).all()


@pytest.mark.parametrize("kind", CLUTTER)
def test_no_test_object_is_in_a_training_view_or_the_data_of_the_shipped_weights(
    shared_dir: Path, kind
) -> None:
    kept_apart = ObjectSet.from_folder(shared_dir / "objects", kind, "test").models
    names, digests = {model.name for model in kept_apart}, {model.digest for model in kept_apart}
    # A generator's own folder, where there is one, is held to the same.
    generated = [path for path in (SAMPLE.parents[1] / "data").glob("*") if any(path.glob("*.npz"))]
    for path in views.find_views([SAMPLE, *generated]):
        view = views.load_view(path)
        assert not names & set(view.objects), path
        assert not digests & set(view.object_digests), path
    with (SAMPLE.parents[1] / "docs" / "training_objects.csv").open(newline="") as opened:
        listed = [(row["name"], row["sha256"]) for row in csv.DictReader(opened)]
    assert len(listed) > 300
    assert not names & {name for name, _ in listed}
    assert not digests & {digest for _, digest in listed}


def test_packed_balls_hold_each_tried_grasp_and_its_contact() -> None:
    balls = NETWORKS["balls"]
    grasps = tried_grasps(made_up_view(1), balls)
    batch, label, weight = pack_balls(grasps, grasps.balls(), balls)
    assert len(label) == len(grasps.label) == len(batch.contact)
    assert (weight == 1).all()
    contact = grasps.cloud.points[grasps.candidates.contact_index]
    edge = contact - grasps.cloud.points[grasps.candidates.approach_index]
    found = batch.points[batch.contact].numpy() * LENGTH_UNIT
    np.testing.assert_allclose(found, edge @ grasps.R_canonical_world.T, atol=1e-6)
    depth = batch.depth.numpy() * LENGTH_UNIT
    np.testing.assert_allclose(depth, grasps.candidates.depth, atol=1e-6)
    some = pack_balls(grasps, grasps.balls()[:2], balls)
    assert some.batch.num_balls == 2
    assert 0 < len(some.label) < len(label)


def test_packed_hands_are_what_the_detector_would_pack_and_vary() -> None:
    view, hands = made_up_view(1), NETWORKS["hands"]
    grasps = tried_grasps(view, hands)
    batch, label, _ = pack_hands(grasps, grasps.balls()[:2], hands)
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, grasps.balls()[:2]))
    np.testing.assert_array_equal(label.numpy(), grasps.label[rows])
    side = near_workspace_side(view.points, WORKSPACE, UP, view.points)
    known = TABLE, view.camera_position[None], side, view.numbered_objects()
    around = Surroundings(grasps.cloud, UP, *known)
    candidates = grasps.candidates.take(rows)
    exact = HandBatch.from_hands(around, candidates, load_gripper(), hands.hand_points)
    torch.testing.assert_close(batch.description, exact.description, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(batch.point_count, exact.point_count)
    varied = pack_hands(grasps, grasps.balls()[:2], hands, np.random.default_rng(0)).batch
    assert not torch.equal(varied.points, batch.points)
    there = torch.arange(hands.hand_points) < varied.point_count[:, None]
    assert (varied.points[there].abs().sum(dim=1) > 0).all()
    assert (varied.points[~there] == 0).all()


def test_a_grasp_that_stays_when_shaken_is_worth_a_little_more() -> None:
    view, balls = made_up_view(1), NETWORKS["balls"]
    firm = np.where(view.success == 1, np.arange(len(view.success)) % 2, view.success)
    shaken = tried_grasps(replace(view, firm=firm.astype(np.int8)), balls).label
    unknown = tried_grasps(view, balls).label
    assert set(shaken.tolist()) == {0.0, 1.0, np.float32(0.8)}
    assert len(set(unknown.tolist())) == 2
    np.testing.assert_array_equal(unknown > 0.5, shaken > 0.5)
    assert 0.8 < unknown.max() < 1


def test_the_temperature_undoes_overconfidence() -> None:
    rng = np.random.default_rng(0)
    honest = rng.normal(size=20_000)
    label = (rng.random(20_000) < expit(honest)).astype(float)
    found = evaluate_scores((honest * 3).astype(np.float32), label.astype(np.float32))
    assert found.temperature == pytest.approx(3, rel=0.1)
    ranges = reliability(expit(found.logit / found.temperature), found.label)
    assert all(each.score == pytest.approx(each.held, abs=0.05) for each in ranges.values())
    assert sum(each.number for each in ranges.values()) == 20_000


def test_views_are_scored_by_hand_networks_alone(tmp_path: Path) -> None:
    plate, other = made_up_view(1), made_up_view(2)
    seen = {"sensor": "stereo", "targets": np.full(len(plate.success), "plate-001")}
    replace(plate, **seen).save(tmp_path / "pile_0-000000_0.npz")
    other.save(tmp_path / "table_0-000001_0.npz")
    paths = sorted(tmp_path.glob("*.npz"))
    hands, balls = (tmp_path / f"{name}.safetensors" for name in ("hands", "balls"))
    for file in (hands, balls):
        metadata = CheckpointMetadata(file.stem, NETWORKS[file.stem], 0.0045, "panda")
        save_checkpoint(file, build_network(metadata.network), metadata)
    scored = score_views(paths, [hands, hands])
    assert set(map(tuple, scored.groups.T.tolist())) == {
        ("pile scenes", "stereo camera", "plate"),
        ("table scenes", "unknown camera", "unknown"),
    }
    assert scored.logit.shape == (2, len(scored.held))
    np.testing.assert_array_equal(*scored.logit)
    network, metadata = load_checkpoint(hands)
    robot = replace(metadata, training={"rescaled_by_outcomes": (0.5, -1.0)})
    save_checkpoint(tmp_path / "robot.safetensors", network, robot)
    plain, rescaled = score_views(paths, [hands, tmp_path / "robot.safetensors"]).logit
    np.testing.assert_allclose(rescaled, 0.5 * plain - 1.0, rtol=1e-6)
    assert 0 < scored.held.mean() < 1
    with pytest.raises(ValueError, match="hand networks"):
        score_views(paths, [balls])
