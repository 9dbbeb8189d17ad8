"""Hollow shapes and shapes drawn at random."""

from pathlib import Path

import numpy as np
import pytest

from edgegrasp_training.shapes import (
    DRAWN,
    HOLLOW,
    LONGEST,
    NUM_DRAWN,
    NUM_FREE,
    PLAIN_HEIGHT,
    PLAIN_WIDTH,
    SHAPES,
    THINNEST,
    any_made_object,
    drawn_shape,
    made_object,
    revolved,
)


def _surface(obj: str) -> tuple[np.ndarray, np.ndarray]:
    rows = [line.split() for line in obj.splitlines()]
    points = np.array([row[1:] for row in rows if row[0] == "v"], dtype=float)
    faces = np.array([row[1:] for row in rows if row[0] == "f"], dtype=int) - 1
    return points, faces


def _volume(obj: str) -> float:
    points, faces = _surface(obj)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all(), "not closed"
    a, b, c = points[faces].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize("name", SHAPES)
def test_hollow_shapes_are_closed_and_face_outwards(name: str) -> None:
    profile = SHAPES[name]
    radius, height = profile[:, 0], profile[:, 1]
    full = np.pi * radius.max() ** 2 * np.ptp(height)
    assert 0.05 * full < _volume(revolved(profile)) < 0.9 * full


def test_a_torus_has_the_volume_of_a_torus() -> None:
    radius, tube = 0.030, 0.006
    volume = 2 * np.pi**2 * radius * tube**2
    # Twelve corners and 24 segments cut off some of it.
    assert _volume(revolved(SHAPES["made-torus-slim"])) == pytest.approx(volume, rel=0.06)


@pytest.mark.parametrize("index", range(0, NUM_FREE, 5))
def test_drawn_shapes_are_closed_and_of_a_size_to_grasp(index: int) -> None:
    shape = drawn_shape(index)
    points, _ = _surface(shape)
    extents = np.ptp(points, axis=0)
    assert 0.0 < _volume(shape) < 4.0 * extents.prod()  # parts overlap
    assert extents.min() > 0.999 * THINNEST - 1e-5
    assert LONGEST[0] - 1e-5 < extents.max() < LONGEST[1] + 1e-5


@pytest.mark.parametrize("index", range(NUM_FREE, NUM_DRAWN, 5))
def test_plain_shapes_are_closed_and_stand_on_a_shelf(index: int) -> None:
    shape = drawn_shape(index)
    width, depth, height = np.ptp(_surface(shape)[0], axis=0)
    assert 0.4 * width * depth * height < _volume(shape) < 1.001 * width * depth * height
    assert 0.86 * PLAIN_WIDTH[0] < min(width, depth)  # a hexagon is less wide one way
    assert max(width, depth) < PLAIN_WIDTH[1] + 1e-5
    assert PLAIN_HEIGHT[0] - 1e-5 < height < PLAIN_HEIGHT[1] + 1e-5


def test_drawn_shapes_differ_and_stay_the_same() -> None:
    assert len({drawn_shape(index) for index in range(NUM_DRAWN)}) == NUM_DRAWN
    assert drawn_shape(7) == drawn_shape(7)


@pytest.mark.parametrize("index", [-1, NUM_DRAWN])
def test_there_are_so_many_drawn_shapes(index: int) -> None:
    with pytest.raises(IndexError, match=f"{index} of {NUM_DRAWN}"):
        drawn_shape(index)


def test_the_digest_of_a_made_object_is_that_of_its_own_files(tmp_path: Path) -> None:
    alone = made_object("made-torus", tmp_path / "alone").digest
    for name in (*HOLLOW, *DRAWN[:3]):
        made_object(name, tmp_path / "all")
    assert made_object("made-torus", tmp_path / "all").digest == alone


def test_made_objects_come_of_both_sorts(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    names = {any_made_object(tmp_path, rng).name for _ in range(30)}
    assert names & set(HOLLOW)
    assert names & set(DRAWN)
