"""Hollow shapes, shapes drawn at random, and stretched ones."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks import ur5_objects

from edgegrasp_sim.engine import make_world
from edgegrasp_sim.objects import ObjectModel, ObjectSet, SceneKind
from edgegrasp_sim.scene import load_object
from edgegrasp_training.shapes import (
    DRAWN_NAMES,
    NUM_DRAWN,
    NUM_VARIED,
    STRETCH,
    drawn_shape,
    household_objects,
    made_object,
    stretched,
    varied_objects,
)


def _surface(obj: str) -> tuple[np.ndarray, np.ndarray]:
    rows = [line.split() for line in obj.splitlines()]
    points = np.array([row[1:] for row in rows if row[0] == "v"], dtype=float)
    faces = np.array([row[1:] for row in rows if row[0] == "f"], dtype=int) - 1
    return points, faces


@pytest.mark.parametrize("index", range(0, NUM_DRAWN, 13))
def test_drawn_shapes_are_closed(index: int) -> None:
    points, faces = _surface(drawn_shape(index))
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    a, b, c = points[faces].transpose(1, 0, 2)
    assert (np.cross(a, b) * c).sum() / 6 > 0


def test_drawn_shapes_differ_and_stay_the_same() -> None:
    assert len({drawn_shape(index) for index in range(NUM_DRAWN)}) == NUM_DRAWN
    assert drawn_shape(7) == drawn_shape(7)
    for index in (-1, NUM_DRAWN):
        with pytest.raises(IndexError, match=f"{index} of {NUM_DRAWN}"):
            drawn_shape(index)


@pytest.fixture
def shapes(tmp_path: Path) -> tuple[ObjectModel, ...]:
    return tuple(made_object(name, tmp_path / "shapes") for name in DRAWN_NAMES[:6])


def _extents(model: ObjectModel) -> np.ndarray:
    with make_world() as world:
        body = load_object(world, model, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), 1.0).body
        low, high = body.bounds
        return high - low


def test_a_stretched_object_is_longer_by_each_factor(shapes, tmp_path) -> None:
    model = shapes[1]
    longer = stretched(model, (1.3, 0.8, 2.0), tmp_path / "stretched")
    assert longer.name == model.name
    assert longer.origin is model
    margin = 0.004  # the engine's own, around every shape
    np.testing.assert_allclose(
        _extents(longer), _extents(model) * (1.3, 0.8, 2.0), atol=2 * margin, rtol=0
    )
    assert _extents(longer)[2] > 1.5 * _extents(model)[2]
    twice = stretched(longer, (0.5, 1.0, 2.0), tmp_path / "twice")
    assert 'scale="0.65000 0.80000 4.00000"' in twice.urdf.read_text()


def test_varied_sets_hold_both_sorts_and_depend_on_the_seed_alone(shapes, tmp_path) -> None:
    plain = ObjectSet("plain", shapes[:4])

    def descriptions(folder: str, seed: int) -> dict[str, str]:
        drawn = varied_objects(plain, tmp_path / folder, np.random.default_rng(seed))
        assert len(drawn.models) <= NUM_VARIED
        texts = {model.name: model.urdf.read_text() for model in drawn.models}
        return {name: text.replace(f"/{folder}/", "/") for name, text in texts.items()}

    first = descriptions("a", 1)
    assert first == descriptions("b", 1)
    assert first != descriptions("c", 2)
    named = {model.name for model in plain.models}
    assert set(first) & named
    assert set(first) - named
    factors = np.array(
        [
            text.split('scale="')[1].split('"')[0].split()
            for name, text in first.items()
            if not name.startswith("blob_")  # their meshes have a scale of their own
        ],
        dtype=float,
    )
    assert 1 / STRETCH <= factors.min() < 0.95
    assert 1.05 < factors.max() <= STRETCH
    alike = factors[:, 0] == factors[:, 1]
    assert 0 < alike.sum() < len(factors)


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
            wall = np.array([low[0] + 0.006, middle[1], 0.0])
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
