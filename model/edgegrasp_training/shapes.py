"""Training objects of many shapes: stretched objects of a set, computed and household objects.

The engine uses the convex hull of a computed object (`drawn_shape`), as of scanned objects: many
have hollows that a camera sees into but nothing can enter. Household objects are truly hollow.
"""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial import ConvexHull

from edgegrasp_camera.arrays import Float64
from edgegrasp_sim.engine.urdf import TriangleMesh
from edgegrasp_sim.objects import ObjectModel, ObjectSet, as_obj, blob, write_object, write_parts
from edgegrasp_training.household import household_mesh, lofted, oval, swept

STRETCH = 1.35  # greatest factor along an axis; its inverse is the least
MADE_SHARE = 0.5  # share of a scene's objects that are computed
BLOB_SHARE = 0.15  # share of a scene's objects that are convex blobs
TRAINING_BLOBS = (100, 1000)  # numbers of blobs; the built-in object sets have lower numbers
BLOB_SCALE = (0.6, 1.1)
SYMMETRIC_SHARE = 0.5  # share of the objects that are stretched equally along x and y
NUM_VARIED = 16  # objects that a scene is drawn from

NUM_FREE, NUM_PLAIN = 320, 160
NUM_DRAWN = NUM_FREE + NUM_PLAIN  # different shapes, before a scene stretches them
CIRCLE, FINE_CIRCLE = 20, 32  # corners of a ring that approximates a circle
LONGEST = 0.045, 0.12  # metres, range of the greatest extent
THINNEST = 0.009  # metres, minimum extent
PLAIN_WIDTH, PLAIN_HEIGHT = (0.03, 0.115), (0.03, 0.17)  # metres: some wider than a hand opens

Rings = Float64  # (R, S, 3) corners of each ring along a part, any unit


def varied_objects(objects: ObjectSet, folder: Path, rng: np.random.Generator) -> ObjectSet:
    """Draw up to `NUM_VARIED` objects from a set and computed objects, each randomly stretched."""
    drawn: dict[str, ObjectModel] = {}
    for _ in range(NUM_VARIED):
        draw = rng.random()
        if draw < MADE_SHARE:
            number = int(rng.integers(NUM_DRAWN))
            name = f"made-drawn-{number:03d}"
            model = ObjectModel(name, write_object(name, drawn_shape(number), folder / "made"))
        elif draw < MADE_SHARE + BLOB_SHARE:
            number, scale = int(rng.integers(*TRAINING_BLOBS)), float(rng.uniform(*BLOB_SCALE))
            model = blob(number, folder / "made", scale)
        else:
            model = objects.sample(rng)
        factors = np.exp(rng.uniform(-np.log(STRETCH), np.log(STRETCH), size=3))
        if rng.random() < SYMMETRIC_SHARE:
            factors[1] = factors[0]
        drawn[model.name] = stretched(model, factors, folder)
    return ObjectSet(f"{objects.name} varied", tuple(drawn.values()))


def household_objects(folder: Path, count: int, rng: np.random.Generator) -> ObjectSet:
    """Write random household objects, which are truly hollow, into a folder."""
    models = []
    for number in range(count):
        family, parts = household_mesh(rng)
        name = f"{family}-{number:03d}"
        points = [part.points for part in parts]
        volume = [ConvexHull(each).volume for each in points]
        centre = np.average([each.mean(0) for each in points], axis=0, weights=volume)
        models.append(ObjectModel(name, write_parts(name, parts, parts, centre, folder)))
    return ObjectSet("household", tuple(models))


def stretched(model: ObjectModel, factors: Float64, folder: Path) -> ObjectModel:
    """Write an object of meshes stretched by factors (3,) along x, y, z; ValueError for others."""
    tree = ElementTree.parse(model.urdf)
    for shape in (*tree.iter("visual"), *tree.iter("collision")):
        mesh, origin = shape.find("geometry/mesh"), shape.find("origin")
        shift = "" if origin is None else " ".join(origin.attrib.values())
        if mesh is None or any(float(each) for each in shift.split()):
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
    return replace(model, urdf=path, unstretched=model)


def drawn_shape(index: int) -> str:
    """A shape as an OBJ file in metres, determined by an index below NUM_DRAWN."""
    rng = np.random.default_rng([NUM_FREE, index])
    return as_obj([_surface(_plain(rng))]) if index >= NUM_FREE else free_shape(rng, index)


def free_shape(rng: np.random.Generator, index: int) -> str:
    """A shape as an OBJ file in metres, of one of eight kinds in turn."""
    parts = _KINDS[index % len(_KINDS)](rng)
    extents = np.ptp(np.concatenate([part.reshape(-1, 3) for part in parts]), axis=0)
    scale = rng.uniform(*LONGEST) / extents.max()
    return as_obj(_surface(part * np.maximum(scale, THINNEST / extents)) for part in parts)


def joined(rings: Rings, *, closed: bool = True) -> TriangleMesh:
    """The surface between neighbouring rings or open rows of corners, two triangles per side."""
    number = np.arange(rings.size // 3).reshape(rings.shape[:2])
    if closed:
        number = np.hstack([number, number[:, :1]])
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    triangles = np.array([[a, b, c], [a, c, d]]).transpose(2, 0, 3, 1)
    return TriangleMesh(rings.reshape(-1, 3), triangles.reshape(-1, 3))


def _surface(rings: Rings) -> TriangleMesh:
    """Join neighbouring rings, and close the ends with triangle fans."""
    (points, sides), (count, corners, _) = joined(rings), rings.shape
    points = np.concatenate([points, rings[[0, -1]].mean(axis=1)])
    ring, last = np.arange(corners), (count - 1) * corners
    bottom = np.stack([np.full(corners, count * corners), np.roll(ring, -1), ring], axis=1)
    top = bottom[:, [0, 2, 1]] + (1, last, last)
    triangles = np.concatenate([sides, bottom, top])
    a, b, c = points[triangles].transpose(1, 0, 2)
    outwards = (np.cross(a, b) * c).sum() > 0.0
    return TriangleMesh(points, triangles if outwards else triangles[:, ::-1])


def _plain(rng: np.random.Generator) -> Rings:
    """A box, a prism or a can, in metres, like goods on a shelf."""
    corners = int(rng.choice([4, 4, 6, FINE_CIRCLE, FINE_CIRCLE, FINE_CIRCLE]))
    width, depth = rng.uniform(*PLAIN_WIDTH, size=2)
    half_height = rng.uniform(*PLAIN_HEIGHT) / 2.0
    ring = oval(1.0, corners) * (np.sqrt(2.0) if corners == 4 else 1.0)
    ring = ring * (width / 2.0, (depth if corners == 4 else width) / 2.0)
    top = rng.uniform(0.7, 1.0) if rng.random() < 0.3 else 1.0
    return lofted(ring, [1.0, top], [-half_height, half_height])


def _bodies(rng: np.random.Generator) -> list[Rings]:
    """Two to four bodies, each attached to an earlier one: L, T, steps, hammers, handles."""
    half = rng.uniform(0.25, 1.0, size=3)
    parts, boxes = [_body(rng) * half], [(np.zeros(3), half)]
    for _ in range(int(rng.integers(1, 4))):
        centre, size = boxes[int(rng.integers(len(boxes)))]
        half = rng.uniform(0.12, 0.8, size=3)
        axis, side = int(rng.integers(3)), float(rng.choice([-1.0, 1.0]))
        place = centre + rng.uniform(-0.6, 0.6, size=3) * size
        place[axis] = centre[axis] + side * (size[axis] + 0.85 * half[axis])
        turned = np.roll(_body(rng), int(rng.integers(3)), axis=2)
        parts.append(turned * half + place)
        boxes.append((place, half))
    return parts


def _body(rng: np.random.Generator) -> Rings:
    """A box, a prism, a cylinder, a frustum or an ellipsoid within two units."""
    corners = int(rng.choice([4, 4, 6, CIRCLE, CIRCLE]))
    ring = oval(1.0, corners) * (np.sqrt(2.0) if corners == 4 else 1.0)
    if corners == CIRCLE and rng.random() < 0.3:
        angle = np.linspace(-0.49 * np.pi, 0.49 * np.pi, 9)
        return lofted(ring, np.cos(angle), np.sin(angle))
    taper = rng.uniform(0.4, 1.0) if rng.random() < 0.3 else 1.0
    return lofted(ring, [1.0, taper], [-1.0, 1.0])


def _bottle(rng: np.random.Generator) -> list[Rings]:
    """A body with a random profile: bottles, vases, spindles, dumb-bells."""
    rows = int(rng.integers(4, 9))
    widths = np.clip(0.5 + np.cumsum(rng.normal(0.0, 0.22, rows)), 0.15, 1.1)
    heights = np.sort(rng.uniform(-1.0, 1.0, rows)) * rng.uniform(0.6, 2.0)
    heights += 0.05 * np.arange(rows)  # no two at one height
    ring = oval(1.0, int(rng.choice([4, 8, CIRCLE, CIRCLE]))) * (1.0, rng.uniform(0.5, 1.0))
    return [lofted(ring, widths, heights)]


def _plate(rng: np.random.Generator) -> list[Rings]:
    """A flat part with a star-shaped or irregular outline."""
    corners = int(rng.choice([5, 8, 10, 16, 24]))
    if rng.random() < 0.5:
        radii = np.where(np.arange(corners) % 2, 1.0, rng.uniform(0.35, 0.9))
    else:
        radii = rng.uniform(0.4, 1.0, corners)
    ring = oval(1.0, corners) * radii[:, None] * (1.0, rng.uniform(0.4, 1.0))
    height = rng.uniform(0.08, 0.45)
    return [lofted(ring, [1.0, rng.uniform(0.85, 1.0)], [0.0, height])]


def _bow(rng: np.random.Generator) -> list[Rings]:
    """A bent rod: bananas, horseshoes, handles."""
    turn = np.linspace(0.0, rng.uniform(np.pi / 3, 1.8 * np.pi), 16)
    taper = 1.0 - rng.uniform(0.0, 0.7) * np.abs(turn / turn[-1] - 0.5)
    ring = oval(1.0, int(rng.choice([4, 8, 12]))) * (1.0, rng.uniform(0.5, 1.6))
    thick = rng.uniform(0.12, 0.45) * taper
    return [swept(thick[:, None, None] * ring + (1.0, 0.0), turn)]


def _hoop(rng: np.random.Generator) -> list[Rings]:
    """A bent rod that closes: rings, tapes, nuts, sleeves."""
    corners = int(rng.choice([4, 8, 12]))
    ring = oval(1.0, corners) * (np.sqrt(2.0) if corners == 4 else 1.0)
    thick = rng.uniform(0.08, 0.48)
    height = np.exp(rng.uniform(np.log(0.4), np.log(4.0)))
    turn = np.linspace(0.0, 2.0 * np.pi, int(rng.choice([7, 9, 25, 25, 25])))
    return [swept(thick * (ring * (1.0, height)) + (1.0, 0.0), turn)]


def _pot(rng: np.random.Generator) -> list[Rings]:
    """Walls and a floor: cups, bowls, boxes without a lid."""
    corners = int(rng.choice([4, 6, CIRCLE, CIRCLE]))
    bottom, wall, floor = rng.uniform(0.5, 1.1), rng.uniform(0.06, 0.3), rng.uniform(0.08, 0.5)
    ring = oval(1.0, corners) * (1.0, rng.uniform(0.5, 1.0))
    height = rng.uniform(0.5, 2.5)
    inside = 1.0 - wall, max(bottom - wall, 0.1)
    return [lofted(ring, [bottom, 1.0, *inside], [0.0, height, height, floor * height])]


_KINDS = (_bodies, _hoop, _bottle, _plate, _bodies, _pot, _bow, _hoop)
