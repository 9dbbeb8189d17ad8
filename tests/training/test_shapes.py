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
    drawn_shape,
    household_objects,
    made_object,
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


@pytest.fixture
def shapes(tmp_path: Path) -> tuple[ObjectModel, ...]:
    return tuple(made_object(name, tmp_path / "shapes") for name in DRAWN_NAMES[:6])


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
