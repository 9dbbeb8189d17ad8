import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edgegrasp_model.gripper import gripper_fields, load_gripper
from edgegrasp_sim.objects import CLUTTER, ObjectSet
from edgegrasp_training.views import find_views, load_view, scene_of, split_by_scene

SAMPLE = Path(__file__).parents[2] / "examples" / "labelled_views"


def test_a_view_comes_back_with_the_hand_that_tried_its_grasps(made_up_view, tmp_path) -> None:
    file, view = tmp_path / "pile_1-000001_0.npz", made_up_view(0)
    view.save(file)
    read = load_view(file)
    np.testing.assert_array_equal(read.points, view.points)
    np.testing.assert_allclose(read.normals, view.normals, atol=1e-3)
    np.testing.assert_array_equal(read.success, view.success)
    assert (read.T_world_hand, read.hand) == (None, load_gripper("panda"))
    hands = np.arange(len(view.success) * 16, dtype=np.float32).reshape(-1, 4, 4)
    tried = replace(view, T_world_hand=hands, gripper=json.dumps(gripper_fields("robotiq-2f-140")))
    tried.save(file)
    np.testing.assert_array_equal(load_view(file).T_world_hand, hands)
    assert load_view(file).hand == load_gripper("robotiq-2f-140")


def test_scenes_never_fall_on_both_sides_and_keep_theirs_as_data_grows() -> None:
    paths = [Path(f"pile_{scene}_{view}.npz") for scene in range(200) for view in range(2)]
    train, validation = split_by_scene(paths, 0.2, seed=0)
    assert {scene_of(path) for path in train}.isdisjoint(map(scene_of, validation))
    assert len(train) + len(validation) == len(paths)
    assert 0.1 < len(validation) / len(paths) < 0.3
    _, fewer = split_by_scene(paths[:100], 0.2, seed=0)
    assert set(fewer) <= set(validation)
    _, others = split_by_scene(paths, 0.2, seed=1)
    assert set(others) != set(validation)


def test_every_view_says_which_objects_it_shows() -> None:
    for path in find_views([SAMPLE]):
        view = load_view(path)
        assert len(view.objects) == len(view.object_digests) > 0
        assert view.firm is not None
        assert (view.firm <= view.success).all()


@pytest.mark.parametrize("kind", CLUTTER)
def test_no_test_object_is_in_a_training_view(shared_dir: Path, kind) -> None:
    kept_apart = ObjectSet.from_folder(shared_dir / "objects", kind, "test").models
    names, digests = {model.name for model in kept_apart}, {model.digest for model in kept_apart}
    # A generator's own folder, where there is one, is held to the same.
    generated = [path for path in (SAMPLE.parents[1] / "data").glob("*") if any(path.glob("*.npz"))]
    for path in find_views([SAMPLE, *generated]):
        view = load_view(path)
        assert not names & set(view.objects), path
        assert not digests & set(view.object_digests), path


@pytest.mark.parametrize("kind", CLUTTER)
def test_no_test_object_is_in_the_data_of_the_shipped_weights(shared_dir, kind) -> None:
    with (SAMPLE.parents[1] / "docs" / "training_objects.csv").open(newline="") as opened:
        listed = [(row["name"], row["sha256"]) for row in csv.DictReader(opened)]
    assert len(listed) > 300
    kept_apart = ObjectSet.from_folder(shared_dir / "objects", kind, "test").models
    assert not {name for name, _ in listed} & {model.name for model in kept_apart}
    assert not {digest for _, digest in listed} & {model.digest for model in kept_apart}
