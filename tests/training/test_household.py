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
