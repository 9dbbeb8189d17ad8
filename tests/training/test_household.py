"""Household objects: their sizes, and parts that a physics engine can take as they are."""

import numpy as np
import pytest

from edgegrasp_training.household import FAMILIES, HouseholdMesh, household_mesh

SEEDS = range(12)


def _drawn(family: str) -> list[HouseholdMesh]:
    return [household_mesh(np.random.default_rng(seed), family) for seed in SEEDS]


def _planes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (F, 3) and offsets (F,) of the faces that have an area."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    kept = length > 1e-10
    normal = normal[kept] / length[kept, None]
    return normal, (normal * a[kept]).sum(axis=1)


@pytest.mark.parametrize("family", FAMILIES)
def test_parts_are_closed_convex_and_face_outwards(family: str) -> None:
    for mesh in _drawn(family):
        for vertices, faces in mesh.parts:
            directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            assert len(np.unique(directed, axis=0)) == len(directed)
            there = {tuple(edge) for edge in directed.tolist()}
            assert there == {(b, a) for a, b in there}, "not closed"
            normal, offset = _planes(vertices, faces)
            assert (vertices @ normal.T <= offset + 1e-6).all(), "not convex"
            assert (vertices.mean(axis=0) @ normal.T < offset).all(), "faces inwards"


@pytest.mark.parametrize("family", ["bowl", "cup", "plate", "glass", "tray", "ring", "frame"])
def test_hollow_objects_surround_space_that_no_part_fills(family: str) -> None:
    for mesh in _drawn(family)[:4]:
        points = np.concatenate([vertices for vertices, _ in mesh.parts])
        axes = [np.linspace(points[:, k].min(), points[:, k].max(), 44) for k in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        full = np.zeros(grid.shape[:3], dtype=bool)
        for vertices, faces in mesh.parts:
            normal, offset = _planes(vertices, faces)
            full |= (grid @ normal.T <= offset + 1e-4).all(axis=-1)
        between = [
            np.logical_or.accumulate(full, axis=k)
            & np.flip(np.logical_or.accumulate(np.flip(full, k), axis=k), k)
            for k in range(3)
        ]
        surrounded = ~full & (np.sum(between, axis=0) >= 2)
        assert surrounded.sum() > 0.03 * full.size


def test_a_seed_draws_the_same_object_and_every_family_comes() -> None:
    first, again, other = (household_mesh(np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert first.family == again.family
    for (vertices, faces), (same_vertices, same_faces) in zip(
        first.parts, again.parts, strict=True
    ):
        np.testing.assert_array_equal(vertices, same_vertices)
        np.testing.assert_array_equal(faces, same_faces)
    assert first.parts[0][0].shape != other.parts[0][0].shape or not np.allclose(
        first.parts[0][0], other.parts[0][0]
    )
    rng = np.random.default_rng(0)
    assert {household_mesh(rng).family for _ in range(400)} == set(FAMILIES)
