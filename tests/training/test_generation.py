from pathlib import Path

import numpy as np
import pytest
from benchmarks import ur5_objects

from edgegrasp_lab.train import DataFlags
from edgegrasp_model.detector import WEIGHTS_FOLDER
from edgegrasp_sim.engine import ENGINES, choose_engine, installed, make_world
from edgegrasp_sim.engine.urdf import parse_obj
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.scene import load_object
from edgegrasp_training.examples import tried_grasps
from edgegrasp_training.generation import generate, missing_scenes
from edgegrasp_training.options import GenerationOptions
from edgegrasp_training.recipes import RECIPES
from edgegrasp_training.shapes import NUM_DRAWN, drawn_shape, household_objects
from edgegrasp_training.views import find_views, load_view

SMALL = GenerationOptions(scenes=4, views_per_scene=1, grasps_per_view=8, seed=5)


def small(**other: object) -> GenerationOptions:
    return SMALL.model_copy(update=other)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    results = list(generate(folder, None, SMALL))
    assert sorted(index for index, _, _ in results) == [0, 1, 2, 3]
    assert sum(tried for _, tried, _ in results) > 0
    return folder


def test_views_hold_tried_grasps_of_every_kind_of_scene(data: Path) -> None:
    paths = find_views([data])
    assert [path.name.split("_")[0] for path in paths] == ["bin", "packed", "pile", "table"]
    held = []
    for path in paths:
        view = load_view(path)
        assert 0 < len(view.tried()) <= 8
        assert (view.T_world_hand[:, 2, 3] > 0.05).all()
        assert view.support is not None
        assert view.object_of_point.max() >= 0
        held += view.success.tolist()
    assert 0 < np.mean(held) < 1


def test_nothing_is_made_twice_and_a_lost_view_is_made_again_the_same(data: Path) -> None:
    assert missing_scenes(data, SMALL) == []
    lost = find_views([data])[0]
    before = lost.read_bytes()
    lost.unlink()
    assert missing_scenes(data, SMALL) == [2]
    assert [index for index, _, _ in generate(data, None, SMALL)] == [2]
    assert lost.read_bytes() == before


def test_a_network_clears_the_scenes_and_its_own_grasps_are_tried(tmp_path: Path) -> None:
    shipped = WEIGHTS_FOLDER / "edgegrasp-plus.safetensors"
    asked = {"scenes": 2, "views_per_scene": 3, "scene": "packed", "seed": 7}
    held = []
    for weights in (shipped, None):
        folder = tmp_path / str(weights is None)
        list(generate(folder, None, small(weights=weights, **asked)))
        views = [load_view(path) for path in find_views([folder])]
        left = np.array([len(view.objects) for view in views]).reshape(2, 3)
        assert (left[:, 2] < left[:, 0]).any() == (weights is not None)
        held.append(np.concatenate([view.success for view in views]).mean())
    assert held[0] > held[1]


def test_labels_of_two_engines_are_not_mixed(data: Path) -> None:
    engine = load_view(find_views([data])[0]).engine
    assert engine == choose_engine()
    for other in set(ENGINES) - {engine}:
        if installed(other):
            with pytest.raises(ValueError, match=f"holds labels of {engine}, not of {other}"):
                list(generate(data, None, small(scenes=5, engine=other)))


def test_scenes_of_a_seed_are_all_made_with_the_same_options(tmp_path: Path) -> None:
    asked = {"scene": "packed", "views_per_scene": 1, "grasps_per_view": 4}
    next(generate(tmp_path / "none", None, small(**asked)))
    for first in (tmp_path / "none").glob("*.npz"):
        first.unlink()
    list(generate(tmp_path / "none", None, small(scenes=1, **asked | {"grasps_per_view": 5})))
    list(generate(tmp_path, None, small(scenes=1, **asked)))
    with pytest.raises(ValueError, match=r"grasps_per_view: .*holds scenes of seed 5"):
        list(generate(tmp_path, None, small(scenes=2, **asked | {"grasps_per_view": 5})))
    # As the command does; the number of workers changes no scene.
    again = DataFlags(**small(scenes=2, **asked).model_dump(), workers=2)
    assert len(list(generate(tmp_path, None, again))) == 1


def test_random_hands_differ_between_scenes_and_are_what_the_network_is_told(tmp_path) -> None:
    options = small(scenes=3, views_per_scene=2, scene="packed", gripper="random")
    list(generate(tmp_path, None, options))
    views = [load_view(path) for path in find_views([tmp_path])]
    openings = [view.hand.max_opening for view in views]
    assert openings[::2] == openings[1::2]  # of the two views of each scene
    assert len(set(openings)) == 3
    assert all(0.04 <= opening <= 0.14 for opening in openings)
    assert any(view.success.any() for view in views)
    for view in views:
        if len(view.tried()):
            hand, seen = view.hand, tried_grasps(view, RECIPES["edgegrasp-plus"]).hand_batch
            measures = (hand.max_opening, hand.tip_z - hand.palm_z, hand.pad_half_width)
            expected = np.tile(measures, (len(seen.points), 1))
            assert seen.description[:, 71:74] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("index", range(0, NUM_DRAWN, 13))
def test_drawn_shapes_are_closed(index: int) -> None:
    ((_, (points, faces)),) = parse_obj(drawn_shape(index))
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    a, b, c = points[faces].transpose(1, 0, 2)
    assert (np.cross(a, b) * c).sum() / 6 > 0


def test_household_objects_are_hollow_in_the_engine_and_read_again_from_their_folder(tmp_path):
    drawn = household_objects(tmp_path, 40, np.random.default_rng(2))
    again = ObjectSet.from_folder(tmp_path, SceneKind.TABLE)
    assert sorted(model.name for model in drawn.models) == [model.name for model in again.models]
    trays = [model for model in again.models if model.name.startswith(("tray", "frame"))]
    assert trays
    for model in trays:
        with make_world() as world:
            body = load_object(world, model, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 1.0).body
            low, high = body.bounds
            assert (np.abs(body.position) < 0.2).all()  # it is loaded where it is put
            world.detect_collisions()
            middle, height = (low + high) / 2, high[2] - 0.3 * (high[2] - low[2])
            start = np.array([[middle[0], middle[1], high[2] + 0.1]])
            end = np.array([[middle[0], middle[1], height]])
            inside = 0.006 if choose_engine() == "pybullet" else 0.002  # its bounds have a margin
            wall = np.array([low[0] + inside, middle[1], 0.0])
            over_wall = start * (0, 0, 1) + wall, end * (0, 0, 1) + wall
            assert world.first_hits(start, end) == [-1]
            assert world.first_hits(*over_wall) == [body.uid]


def test_objects_of_the_ur5_protocols_stay_the_same_and_are_new(tmp_path: Path) -> None:
    first, again = tmp_path / "first", tmp_path / "again"
    for folder in (first, again):
        ur5_objects.write(folder)
    files = [file.relative_to(first) for file in sorted(first.glob("*/*"))]
    assert all((first / file).read_bytes() == (again / file).read_bytes() for file in files)
    assert len(ObjectSet.from_folder(first / "hard", SceneKind.PILE).models) == 20
    shapes = {file.read_text() for file in first.glob("adversarial/*.obj")}
    assert len(shapes) == 8
    assert not shapes & {drawn_shape(index) for index in range(NUM_DRAWN)}
