"""Write objects that are awkward to grasp: curved, knobbly, with few sides alike.

Each is where a small random network of a place's coordinates (a compositional pattern-producing
network, as the shapes of EGAD are) comes out positive, which is no way training objects are drawn.
Odd numbers are more knobbly than even ones.

    python scripts/adversarial_objects.py DIR
    edgegrasp benchmark --objects DIR --scene pile
"""

import argparse
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

COUNT = 48
CELLS = 40  # of the grid along each side
TRIANGLES = 2000  # of a surface, at most
UNITS, LAYERS = 8, 2
CALM, WILD = (0.8, 1.3), (1.3, 2.2)  # spread of the weights: more bends the surface more often
LEAST_FILL, MOST_FILL = 0.06, 0.6  # of the box around an object
LEAST_SIDE = 0.3  # of an object's longest one


def main() -> None:
    """Write `COUNT` meshes into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(COUNT):
        adversarial_object(number).export(folder / f"adversarial-{number:02d}.obj")


def adversarial_object(number: int) -> trimesh.Trimesh:
    """A closed surface, always the same for its number; its unit means nothing."""
    rng = np.random.default_rng([COUNT, number])
    while True:
        surface = _surface(_field(rng, WILD if number % 2 else CALM))
        if surface is not None:
            return surface


def _field(rng: np.random.Generator, spread: tuple[float, float]) -> NDArray[np.float32]:
    """A random function on a grid, (CELLS, CELLS, CELLS), negative on its border."""
    side = np.linspace(-1.0, 1.0, CELLS)
    place = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1)
    radius = np.linalg.norm(place * rng.uniform(0.8, 1.6, 3), axis=-1, keepdims=True)
    values = np.concatenate([place, radius], axis=-1)
    sigma = rng.uniform(*spread)
    for _ in range(LAYERS):
        weights = rng.normal(0.0, sigma, (values.shape[-1], UNITS))
        values = values @ weights + rng.normal(0.0, sigma, UNITS)
        bends = np.sin, np.tanh, np.abs, lambda x: np.exp(-(x**2))
        for unit, kind in enumerate(rng.integers(len(bends), size=UNITS)):
            values[..., unit] = bends[kind](values[..., unit])
    field = np.tanh(values @ rng.normal(0.0, 1.0, UNITS)) + 1.0 - 1.6 * radius[..., 0]
    field[np.abs(place).max(axis=-1) > 0.97] = -1.0
    return field.astype(np.float32)


def _surface(field: NDArray[np.float32]) -> trimesh.Trimesh | None:
    """The largest connected surface of a field; None where it is a crumb, a ball or a needle."""
    mesh = o3d.t.geometry.TriangleMesh.create_isosurfaces(o3d.core.Tensor(field), [0.0])
    if not len(mesh.triangle.indices):
        return None
    whole = trimesh.Trimesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy())
    surface = max(
        whole.split(only_watertight=True), key=lambda part: abs(part.volume), default=None
    )
    if surface is None:
        return None
    surface.fix_normals()
    sides = surface.extents
    filled = surface.volume / sides.prod()
    plain = surface.volume / surface.convex_hull.volume > 0.93
    fits = LEAST_FILL < filled < MOST_FILL and sides.min() > LEAST_SIDE * sides.max()
    return _coarser(surface) if fits and not plain else None


def _coarser(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(surface.vertices.astype(np.float32)), o3d.core.Tensor(surface.faces)
    )
    share = max(0.0, 1.0 - TRIANGLES / len(surface.faces))
    mesh = mesh.simplify_quadric_decimation(share)
    return trimesh.Trimesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy())


if __name__ == "__main__":
    main()
