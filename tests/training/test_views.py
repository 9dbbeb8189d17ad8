from pathlib import Path

import numpy as np
import pytest

from edgegrasp_training.views import (
    LabelledView,
    find_views,
    load_view,
    part_of,
    scene_of,
    split_by_scene,
)


def some_view(T_world_hand: np.ndarray | None = None) -> LabelledView:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return LabelledView(
        points=rng.normal(size=(50, 3)).astype(np.float32),
        normals=normals.astype(np.float32),
        camera_position=np.array([0, 0, 1], np.float32),
        approach_index=np.array([3, 3, 7]),
        contact_index=np.array([4, 5, 6]),
        T_world_hand=T_world_hand,
        success=np.array([1, -1, 0], np.int8),
    )


@pytest.mark.parametrize("hands", [None, np.arange(48, dtype=np.float32).reshape(3, 4, 4)])
def test_a_view_comes_back_from_its_file(tmp_path: Path, hands: np.ndarray | None) -> None:
    view = some_view(hands)
    view.save(tmp_path / "pile_1-000001_0.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["pile_1-000001_0.npz"]
    read = load_view(tmp_path / "pile_1-000001_0.npz")
    np.testing.assert_array_equal(read.points, view.points)
    np.testing.assert_allclose(read.normals, view.normals, atol=1e-3)
    np.testing.assert_array_equal(read.contact_index, view.contact_index)
    np.testing.assert_array_equal(read.success, view.success)
    assert read.tried().tolist() == [0, 2]
    if hands is None:
        assert read.T_world_hand is None
    else:
        np.testing.assert_array_equal(read.T_world_hand, hands)


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


def test_one_scene_at_least_is_held_out() -> None:
    train, validation = split_by_scene([Path("a_0.npz"), Path("b_0.npz")], 0.0, seed=0)
    assert len(train) == len(validation) == 1


def test_a_larger_part_holds_the_smaller_one_and_whole_scenes() -> None:
    paths = [Path(f"pile_{scene}_{view}.npz") for scene in range(200) for view in range(2)]
    small, large = part_of(paths, 0.1, seed=0), part_of(paths, 0.4, seed=0)
    assert set(small) < set(large) < set(paths)
    assert 0.05 < len(small) / len(paths) < 0.2
    assert len(large) == 2 * len({scene_of(path) for path in large})
    assert part_of(paths, 1.0, seed=0) == paths
    assert set(part_of(paths, 0.1, seed=1)) != set(small)
    with pytest.raises(ValueError, match="training_share"):
        part_of(paths, 0.0, seed=0)


def test_no_views_is_an_error_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="generate-data"):
        find_views([tmp_path])
