"""Make packed and pile scenes, bins, crowded tables and shelves, and let them come to rest."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64
from edgegrasp_sim import fixed_parts as parts
from edgegrasp_sim.engine import TIME_STEP, Body, Vector, World
from edgegrasp_sim.fixed_parts import MIDDLE, SIZE, TABLE_HEIGHT, Box, FixedParts
from edgegrasp_sim.objects import ObjectModel, ObjectSet, SceneKind
from edgegrasp_sim.poses import about_z

# The default range of the objects' scale, by the kind that the objects belong to.
SCALES = {SceneKind.PACKED: (0.7, 0.8), SceneKind.PILE: (0.8, 1.0)}

PACKED_ATTEMPTS = 12  # maximum number of objects drawn to stand upright on a table
PACKED_RANGE = (0.08, 0.22)  # metres, of x and y
CLEARANCE = 0.002  # metres above the table at which objects are put down

# The open box that a pile is dropped into, which is removed afterwards.
PILE_DROP_HEIGHT = 0.2  # metres above the table
PILE_CORNER = 0.02  # metres, x and y
PILE_SIDE, PILE_HEIGHT = 0.26, 0.13  # metres
PILE_WALL = 0.0039  # metres
PILE_SECONDS = 1.0  # for each object to come to rest

# How objects are poured into a bin.
POUR_HEIGHT = 0.08  # metres above the walls
POUR_MARGIN = 0.25  # share of its length and width, on each side, where nothing is dropped
FULL_MARGIN = 0.12  # the same for a bin to be filled
POUR_SECONDS = 0.5  # for each object to come to rest
AT_ONCE = 4  # objects poured between two checks whether a bin is full
MAX_POURS = 100  # into a full bin, in which objects that are too large never stay
COVERED = 0.85  # share of the floor of a full bin that objects hide from above
RAYS = 24  # rays along each side of the floor, to measure this share

# How objects are put on a table or a shelf.
CROWD_ATTEMPTS = 4  # for each object
LYING_SHARE = 0.4  # share of the objects that are dropped in any pose

REST_SPEED = 0.01  # m/s and rad/s together; slower objects are at rest
REST_STEPS = 60  # time steps between two checks for rest
REST_SECONDS = 2.0  # maximum time to wait for rest


@dataclass(frozen=True, slots=True)
class SceneObject:
    """An object in a scene."""

    model: ObjectModel
    scale: float  # factor on the size in the model's file
    body: Body


def load_object(
    world: World, model: ObjectModel, position: Vector, quaternion_xyzw: Vector, scale: float
) -> SceneObject:
    """Load an object with its link frame at a pose; `scale` multiplies the model's own scale."""
    if not model.urdf.is_file():
        raise FileNotFoundError(f"no object file at {model.urdf}; check the object folder")
    whole = scale * model.scale
    return SceneObject(model, whole, world.load_urdf(model.urdf, position, quaternion_xyzw, whole))


class Layout(NamedTuple):
    """The parts of a scene."""

    world: World  # gets the objects; contains the fixed parts already
    fixed_parts: FixedParts
    objects: ObjectSet  # to draw from
    rng: np.random.Generator  # source of the draws
    num_objects: int  # how many to try to place
    scales: tuple[float, float]  # range of their scale


MakeSurroundings: TypeAlias = Callable[[np.random.Generator], FixedParts]
MakeObjects: TypeAlias = Callable[[Layout], list[SceneObject]]


def make_packed(layout: Layout) -> list[SceneObject]:
    """Stand at most `PACKED_ATTEMPTS` objects upright, each where it touches no other."""
    return _put_down(layout, PACKED_ATTEMPTS, lambda: layout.rng.uniform(*PACKED_RANGE, size=2))


def make_table(layout: Layout) -> list[SceneObject]:
    """Put objects on a table or a shelf, next to its fixed parts: most upright, some dropped."""
    rng, reach = layout.rng, np.array(layout.fixed_parts.reach)
    attempts = CROWD_ATTEMPTS * layout.num_objects
    return _put_down(
        layout, attempts, lambda: MIDDLE + rng.uniform(-reach, reach, size=2), LYING_SHARE
    )


def make_bin(layout: Layout) -> list[SceneObject]:
    """Drop objects into a bin one by one; objects that do not fit are removed."""
    return settle(layout.world, _pour(layout, layout.num_objects, POUR_MARGIN), layout.fixed_parts)


def make_full_bin(layout: Layout) -> list[SceneObject]:
    """Pour objects all over a bin until they hide its floor or reach the requested number."""
    placed: list[SceneObject] = []
    for _ in range(MAX_POURS):
        if len(placed) == layout.num_objects or _covered(layout, placed) >= COVERED:
            break
        new = _pour(layout, min(AT_ONCE, layout.num_objects - len(placed)), FULL_MARGIN)
        placed = settle(layout.world, [*placed, *new], layout.fixed_parts)
    return placed


def make_pile(layout: Layout) -> list[SceneObject]:
    """Drop objects into an open box one by one, then remove the box."""
    half, z, middle = PILE_WALL / 2, TABLE_HEIGHT + PILE_HEIGHT / 2, PILE_CORNER + PILE_SIDE / 2
    ends = PILE_CORNER + half, PILE_CORNER + PILE_SIDE - half
    box = [Box((PILE_WALL, PILE_SIDE, PILE_HEIGHT), (x, middle, z)) for x in ends]
    box += [Box((PILE_SIDE, PILE_WALL, PILE_HEIGHT), (middle, y, z)) for y in ends]
    walls = [side.add_to(layout.world) for side in box]
    where = np.full(2, SIZE / 3), np.full(2, 2 * SIZE / 3)
    top = TABLE_HEIGHT + PILE_DROP_HEIGHT
    dropped = _drop(layout, layout.num_objects, where, top, PILE_SECONDS)
    for wall in walls:
        wall.remove()
    return settle(layout.world, dropped, layout.fixed_parts)


def wait_for_rest(world: World, objects: Sequence[SceneObject], seconds: float) -> None:
    """Simulate until all objects rest, for at most `seconds`."""
    for _ in range(ceil(seconds / (REST_STEPS * TIME_STEP))):
        world.step(REST_STEPS)
        if all(item.body.speed <= REST_SPEED for item in objects):
            return


def settle(
    world: World, objects: Sequence[SceneObject], fixed_parts: FixedParts
) -> list[SceneObject]:
    """Wait for rest and remove objects outside the workspace, until none leaves it."""
    remaining = list(objects)
    while True:
        wait_for_rest(world, remaining, REST_SECONDS)
        outside = [item for item in remaining if not fixed_parts.contains(item.body)]
        if not outside:
            return remaining
        for item in outside:
            item.body.remove()
        remaining = [item for item in remaining if item not in outside]


def _pour(layout: Layout, number: int, share: float) -> list[SceneObject]:
    """Drop objects into a bin, except for a share of its length and width along each side."""
    low, high = np.asarray(layout.fixed_parts.bounds)[:, :2]
    margin = share * (high - low)
    walls = max(box.centre[2] + box.size[2] / 2 for box in layout.fixed_parts.boxes)
    return _drop(layout, number, (low + margin, high - margin), walls + POUR_HEIGHT, POUR_SECONDS)


def _covered(layout: Layout, placed: Sequence[SceneObject]) -> float:
    """The share of a bin's floor that objects hide from above."""
    low, high = np.asarray(layout.fixed_parts.bounds)[:, :2]
    steps = (np.arange(RAYS) + 0.5) / RAYS
    place = low + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * (high - low)
    starts, ends = (np.insert(place, 2, z, axis=1) for z in (1.0, TABLE_HEIGHT - 0.01))
    hits = layout.world.first_hits(starts, ends)
    return float(np.isin(hits, [item.body.uid for item in placed]).mean())


def _drop(
    layout: Layout, number: int, where: tuple[Float64, Float64], height: float, seconds: float
) -> list[SceneObject]:
    """Drop objects one by one, in any orientation, between two corners `where`, (2,), metres."""
    rng = layout.rng
    dropped: list[SceneObject] = []
    for _ in range(number):
        model = layout.objects.sample(rng)
        quaternion = Rotation.random(rng=rng).as_quat().tolist()
        x, y = rng.uniform(*where)
        scale = float(rng.uniform(*layout.scales))
        dropped.append(load_object(layout.world, model, (x, y, height), quaternion, scale))
        wait_for_rest(layout.world, dropped, seconds)
    return dropped


def _put_down(
    layout: Layout,
    attempts: int,  # objects drawn at most
    draw_place: Callable[[], Float64],  # gives x and y, metres
    lying_share: float = 0.0,  # share of the objects in any orientation
) -> list[SceneObject]:
    """Put objects down one by one, each where it touches nothing."""
    world, rng = layout.world, layout.rng
    placed: list[SceneObject] = []
    for _ in range(attempts):
        if len(placed) >= layout.num_objects:
            break
        model, (x, y) = layout.objects.sample(rng), draw_place()
        lying = lying_share > 0.0 and rng.random() < lying_share
        upright = None if lying else about_z(rng.uniform(0.0, 2.0 * np.pi))
        turn = upright or Rotation.random(rng=rng).as_quat().tolist()
        scale = float(rng.uniform(*layout.scales))
        state = world.save_state()
        new = load_object(world, model, (x, y, 1.0), turn, scale)
        x, y, z = new.body.position
        lowest = new.body.bounds[0, 2]
        new.body.set_pose((x, y, z - lowest + TABLE_HEIGHT + CLEARANCE), turn)
        world.step()
        if new.body.contacts():
            new.body.remove()
            world.restore_state(state)
        else:
            placed = settle(world, [*placed, new], layout.fixed_parts)
    return placed


# The fixed parts (None: an open table), and how objects are placed.
SCENE_MAKERS: dict[SceneKind, tuple[MakeSurroundings | None, MakeObjects]] = {
    SceneKind.PACKED: (None, make_packed),
    SceneKind.PILE: (None, make_pile),
    SceneKind.BIN: (parts.random_bin, make_bin),
    SceneKind.FULL_BIN: (
        partial(parts.random_bin, extents=parts.SMALL_BIN_INSIDE),
        make_full_bin,
    ),
    SceneKind.DEEP_BIN: (partial(parts.random_bin, extents=parts.DEEP_BIN_INSIDE), make_bin),
    SceneKind.TABLE: (parts.random_table, make_table),
    SceneKind.SHELF: (parts.random_shelf, make_table),
}
