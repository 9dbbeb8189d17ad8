"""Making packed and pile scenes, bins, crowded tables and shelves, and bringing them to rest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from edgegrasp_sim.engine import TIME_STEP, Body, World
from edgegrasp_sim.objects import OBJECT_FRICTION, OBJECT_MASS, ObjectModel, ObjectSet
from edgegrasp_sim.poses import Matrix
from edgegrasp_sim.surroundings import (
    MIDDLE,
    OPEN_TABLE,
    SIZE,
    TABLE_HEIGHT,
    Box,
    Surroundings,
)

PACKED_ATTEMPTS = 12
PACKED_RANGE = (0.08, 0.22)  # metres, for x and y
PACKED_SCALE = (0.7, 0.8)
PACKED_CLEARANCE = 0.002  # metres above the table

PILE_SCALE = (0.8, 1.0)
PILE_DROP_HEIGHT = 0.2  # metres above the table
PILE_BOX_CORNER = 0.02  # metres, x and y
PILE_BOX_EXTENT = (0.26, 0.26, 0.13)  # metres
PILE_BOX_WALL = 0.0039  # metres

BIN_DROP_HEIGHT = 0.08  # metres above the walls
BIN_DROP_SHARE = 0.25  # of a bin's length and width, beside which nothing is dropped: as poured in
FULL_DROP_SHARE = 0.12  # the same of a bin that gets full
BIN_DROP_SECONDS = 0.5

POUR = 4  # objects at a time into a bin that gets full
COVERED = 0.85  # of a bin's floor that objects hide from above, where it is full
RAYS = 24  # along each side of it, that tell

TABLE_ATTEMPTS = 4  # for each object
LYING_SHARE = 0.4  # of the objects on a table, which are dropped in any pose

REST_SPEED = 0.01
REST_CHECK_STEPS = 60
REST_SECONDS = 2.0
DROP_SECONDS = 1.0


@dataclass(frozen=True, slots=True)
class SceneObject:
    """An object that stands in a scene."""

    model: ObjectModel
    scale: float
    body: Body


def load_object(
    world: World,
    model: ObjectModel,
    position: Sequence[float],
    quaternion_xyzw: Sequence[float],
    scale: float,
) -> SceneObject:
    """Load an object with its link frame there; `scale` comes on top of the model's own.

    Raises:
        FileNotFoundError: the model's file is missing.
        ValueError: the engine cannot read it.
    """
    body = world.load_urdf(
        model.urdf,
        position,
        quaternion_xyzw,
        scale * model.scale,
        mass=OBJECT_MASS,
        friction=OBJECT_FRICTION,
    )
    return SceneObject(model, scale, body)


def make_packed(
    world: World,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float] = PACKED_SCALE,
) -> list[SceneObject]:
    """Stand objects upright on the table, each where it touches no other.

    Up to `PACKED_ATTEMPTS` objects are drawn, so that a scene may hold fewer than asked for.
    """
    placed: list[SceneObject] = []
    for _ in range(PACKED_ATTEMPTS):
        if len(placed) >= num_objects:
            break
        model = objects.sample(rng)
        x, y = rng.uniform(*PACKED_RANGE, size=2)
        quaternion = _upright(rng)
        scale = float(rng.uniform(*scales))
        placed = _place(world, OPEN_TABLE, placed, model, (x, y), quaternion, scale)
    return placed


def make_table(
    world: World,
    surroundings: Surroundings,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float] = PACKED_SCALE,
) -> list[SceneObject]:
    """Put objects on a table or a shelf beside what is there: most upright, some as they fall.

    Up to `TABLE_ATTEMPTS` objects are drawn for each, so that there may be fewer than asked for.
    """
    placed: list[SceneObject] = []
    for _ in range(TABLE_ATTEMPTS * num_objects):
        if len(placed) >= num_objects:
            break
        model = objects.sample(rng)
        reach = np.array(surroundings.reach)
        x, y = MIDDLE + rng.uniform(-reach, reach, size=2)
        lying = rng.random() < LYING_SHARE
        quaternion = Rotation.random(rng=rng).as_quat().tolist() if lying else _upright(rng)
        scale = float(rng.uniform(*scales))
        placed = _place(world, surroundings, placed, model, (x, y), quaternion, scale)
    return placed


def make_bin(
    world: World,
    surroundings: Surroundings,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float] = PILE_SCALE,
) -> list[SceneObject]:
    """Drop objects into a bin one after another; those that do not fit in it are taken away."""
    dropped = _pour(world, surroundings, objects, rng, num_objects, scales, BIN_DROP_SHARE)
    return settle(world, dropped, surroundings)


def make_full_bin(
    world: World,
    surroundings: Surroundings,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float] = PILE_SCALE,
) -> list[SceneObject]:
    """Pour objects into a bin, all over it, until they hide its floor, or are as many as asked."""
    placed: list[SceneObject] = []
    while len(placed) < num_objects and _covered(world, surroundings, placed) < COVERED:
        number = min(POUR, num_objects - len(placed))
        new = _pour(world, surroundings, objects, rng, number, scales, FULL_DROP_SHARE)
        placed = settle(world, [*placed, *new], surroundings)
    return placed


def _pour(
    world: World,
    surroundings: Surroundings,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float],
    share: float,
) -> list[SceneObject]:
    """Drop objects into a bin, but for a share of its length and width along each side."""
    low, high = np.asarray(surroundings.bounds)[:, :2]
    margin = share * (high - low)
    walls = max(box.centre[2] + box.size[2] / 2 for box in surroundings.boxes)
    where = low + margin, high - margin
    height = walls + BIN_DROP_HEIGHT
    return _drop(world, objects, rng, num_objects, scales, where, height, BIN_DROP_SECONDS)


def _covered(world: World, surroundings: Surroundings, placed: Sequence[SceneObject]) -> float:
    """The share of a bin's floor that objects hide from above."""
    low, high = np.asarray(surroundings.bounds)[:, :2]
    steps = (np.arange(RAYS) + 0.5) / RAYS
    place = low + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * (high - low)
    starts, ends = (np.insert(place, 2, z, axis=1) for z in (1.0, TABLE_HEIGHT - 0.01))
    hits = world.first_hits(starts, ends)
    return float(np.isin(hits, [item.body.uid for item in placed]).mean())


def make_pile(
    world: World,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float] = PILE_SCALE,
) -> list[SceneObject]:
    """Drop objects into an open box one after another, then take the box away."""
    walls = [box.add_to(world) for box in _pile_box()]
    middle = np.full(2, SIZE / 3), np.full(2, 2 * SIZE / 3)
    height = TABLE_HEIGHT + PILE_DROP_HEIGHT
    dropped = _drop(world, objects, rng, num_objects, scales, middle, height, DROP_SECONDS)
    for wall in walls:
        wall.remove()
    return settle(world, dropped, OPEN_TABLE)


def wait_for_rest(world: World, objects: Sequence[SceneObject], seconds: float) -> None:
    """Simulate until all objects rest, for at most `seconds`."""
    elapsed = 0.0
    while elapsed < seconds:
        world.step(REST_CHECK_STEPS)
        elapsed += REST_CHECK_STEPS * TIME_STEP
        if all(item.body.speed <= REST_SPEED for item in objects):
            return


def settle(
    world: World, objects: Sequence[SceneObject], surroundings: Surroundings
) -> list[SceneObject]:
    """Wait for rest and remove what is no longer where objects are, until nothing more leaves.

    Returns:
        The objects that remain.
    """
    remaining = list(objects)
    while True:
        wait_for_rest(world, remaining, REST_SECONDS)
        outside = [item for item in remaining if not surroundings.contain(item.body)]
        if not outside:
            return remaining
        for item in outside:
            item.body.remove()
        remaining = [item for item in remaining if item not in outside]


def _drop(
    world: World,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float],
    where: tuple[Matrix, Matrix],
    height: float,
    seconds: float,
) -> list[SceneObject]:
    """Drop objects, turned any way, one after another.

    Args:
        world: gets them.
        objects: to draw from.
        rng: source of the draws.
        num_objects: how many.
        scales: range of the factor on their size.
        where: lowest and highest x and y, (2,) each, metres.
        height: z that they are dropped from, metres.
        seconds: given to each to come to rest.
    """
    dropped: list[SceneObject] = []
    for _ in range(num_objects):
        model = objects.sample(rng)
        quaternion = Rotation.random(rng=rng).as_quat().tolist()
        x, y = rng.uniform(*where)
        scale = float(rng.uniform(*scales))
        dropped.append(load_object(world, model, (x, y, height), quaternion, scale))
        wait_for_rest(world, dropped, seconds)
    return dropped


def _upright(rng: np.random.Generator) -> list[float]:
    """A random turn about z, as a quaternion xyzw."""
    half_turn = rng.uniform(0.0, 2.0 * np.pi) / 2
    return [0.0, 0.0, float(np.sin(half_turn)), float(np.cos(half_turn))]


def _place(
    world: World,
    surroundings: Surroundings,
    placed: list[SceneObject],
    model: ObjectModel,
    place: tuple[float, float],
    quaternion_xyzw: Sequence[float],
    scale: float,
) -> list[SceneObject]:
    """Put an object down where it touches nothing, or nowhere; returns all that are there."""
    state = world.save_state()
    new = load_object(world, model, (*place, 1.0), quaternion_xyzw, scale)
    x, y, z = new.body.position
    lowest = new.body.bounds[0, 2]
    new.body.set_pose((x, y, z - lowest + TABLE_HEIGHT + PACKED_CLEARANCE), quaternion_xyzw)
    world.step()
    if new.body.contacts():
        new.body.remove()
        world.restore_state(state)
    else:
        placed = settle(world, [*placed, new], surroundings)
    world.remove_state(state)
    return placed


def _pile_box() -> list[Box]:
    """The walls that a pile is dropped into."""
    length, width, height = PILE_BOX_EXTENT
    low = PILE_BOX_CORNER
    half = PILE_BOX_WALL / 2
    z = TABLE_HEIGHT + height / 2
    middle = low + length / 2
    return [
        Box((PILE_BOX_WALL, width, height), (low + half, middle, z)),
        Box((PILE_BOX_WALL, width, height), (low + length - half, middle, z)),
        Box((length, PILE_BOX_WALL, height), (middle, low + half, z)),
        Box((length, PILE_BOX_WALL, height), (middle, low + width - half, z)),
    ]
