"""More shapes from the same training objects: stretched along their axes, made ones among them."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from edgegrasp_sim.objects import ObjectModel, ObjectSet
from edgegrasp_training.made_shapes import any_made_object

STRETCH = 1.35  # greatest factor along an axis; its inverse is the least
MADE_SHARE = 0.6  # of the objects that a scene is drawn from
ROUND_SHARE = 0.5  # of the objects, stretched alike along x and y: what is round stays so
DRAWN = 16  # objects that a scene is drawn from


def varied_objects(objects: ObjectSet, folder: Path, rng: np.random.Generator) -> ObjectSet:
    """Some objects of a set and some made ones, each stretched at random.

    Args:
        objects: To draw from.
        folder: Gets descriptions and made objects; the meshes of others stay where they are.
        rng: Draws objects and factors.

    Returns:
        Up to `DRAWN` objects under the names that they had.
    """
    drawn: dict[str, ObjectModel] = {}
    for _ in range(DRAWN):
        made = rng.random() < MADE_SHARE
        model = any_made_object(folder / "made", rng) if made else objects.sample(rng)
        factors = np.exp(rng.uniform(-np.log(STRETCH), np.log(STRETCH), size=3))
        if rng.random() < ROUND_SHARE:
            factors[1] = factors[0]
        drawn[model.name] = stretched(model, (factors[0], factors[1], factors[2]), folder)
    return ObjectSet(f"{objects.name} varied", tuple(drawn.values()))


def stretched(model: ObjectModel, factors: tuple[float, float, float], folder: Path) -> ObjectModel:
    """A description of the object with its meshes stretched along x, y and z.

    Args:
        model: An object whose shapes are meshes.
        factors: Along the axes of its link frame.
        folder: Gets the description.

    Raises:
        ValueError: The object has a shape that is not a mesh, or one with a frame of its own.
    """
    tree = ElementTree.parse(model.urdf)
    for shape in (*tree.iter("visual"), *tree.iter("collision")):
        mesh = shape.find("geometry/mesh")
        if mesh is None or shape.find("origin") is not None:
            raise ValueError(f"{model.urdf}: has shapes that cannot be stretched; use plain meshes")
        own = np.array([float(each) for each in mesh.get("scale", "1 1 1").split()])
        mesh.set("scale", " ".join(f"{each:.5f}" for each in own * factors))
        mesh.set("filename", str((model.urdf.parent / mesh.get("filename", "")).resolve()))
    for origin in tree.iterfind("link/inertial/origin"):
        place = np.array([float(each) for each in origin.get("xyz", "0 0 0").split()])
        origin.set("xyz", " ".join(f"{each:.6f}" for each in place * factors))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{model.name}.urdf"
    tree.write(path)
    return replace(model, urdf=path, origin=model)
