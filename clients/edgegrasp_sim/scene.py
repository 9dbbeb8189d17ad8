"""Making packed and pile scenes, and bringing them to rest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from edgegrasp_sim.engine import TIME_STEP, Body, World
from edgegrasp_sim.objects import OBJECT_FRICTION, OBJECT_MASS, ObjectModel, ObjectSet

SIZE = 0.30  # metres, edge of the workspace cube
TABLE_HEIGHT = 0.05  # metres
TABLE_EXTENT = (1.2, 1.2, 0.2)  # metres; objects would sink through a thin one
TABLE_FRICTION = 0.5

PACKED_ATTEMPTS = 12
PACKED_RANGE = (0.08, 0.22)  # metres, for x and y
PACKED_SCALE = (0.7, 0.8)
PACKED_CLEARANCE = 0.002  # metres above the table

PILE_SCALE = (0.8, 1.0)
PILE_DROP_HEIGHT = 0.2  # metres above the table
PILE_BOX_CORNER = 0.02  # metres, x and y
PILE_BOX_EXTENT = (0.26, 0.26, 0.13)  # metres
PILE_BOX_WALL = 0.0039  # metres

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


def add_table(world: World) -> Body:
    """Add the table, its top at `TABLE_HEIGHT`."""
    centre = (SIZE / 2, SIZE / 2, TABLE_HEIGHT - TABLE_EXTENT[2] / 2)
    return world.add_box(TABLE_EXTENT, centre, friction=TABLE_FRICTION)


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
    body = world.load_urdf(model.urdf, position, quaternion_xyzw, scale * model.scale)
    body.set_dynamics(mass=OBJECT_MASS, friction=OBJECT_FRICTION)
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
        state = world.save_state()
        model = objects.sample(rng)
        x, y = rng.uniform(*PACKED_RANGE, size=2)
        half_turn = rng.uniform(0.0, 2.0 * np.pi) / 2
        quaternion = [0.0, 0.0, float(np.sin(half_turn)), float(np.cos(half_turn))]
        scale = float(rng.uniform(*scales))
        new = load_object(world, model, (x, y, 1.0), quaternion, scale)
        x, y, z = new.body.position
        lowest = new.body.bounds[0, 2]
        new.body.set_pose((x, y, z - lowest + TABLE_HEIGHT + PACKED_CLEARANCE), quaternion)
        world.step()
        if new.body.contacts():
            new.body.remove()
            world.restore_state(state)
        else:
            placed = settle(world, [*placed, new])
        world.remove_state(state)
    return placed


def make_pile(
    world: World,
    objects: ObjectSet,
    rng: np.random.Generator,
    num_objects: int,
    scales: tuple[float, float] = PILE_SCALE,
) -> list[SceneObject]:
    """Drop objects into an open box one after another, then take the box away."""
    walls = _add_box_walls(world)
    dropped: list[SceneObject] = []
    for _ in range(num_objects):
        model = objects.sample(rng)
        quaternion = Rotation.random(rng=rng).as_quat().tolist()
        x, y = rng.uniform(SIZE / 3, 2 * SIZE / 3, size=2)
        scale = float(rng.uniform(*scales))
        position = (x, y, TABLE_HEIGHT + PILE_DROP_HEIGHT)
        dropped.append(load_object(world, model, position, quaternion, scale))
        wait_for_rest(world, dropped, DROP_SECONDS)
    for wall in walls:
        wall.remove()
    return settle(world, dropped)


def wait_for_rest(world: World, objects: Sequence[SceneObject], seconds: float) -> None:
    """Simulate until all objects rest, for at most `seconds`."""
    elapsed = 0.0
    while elapsed < seconds:
        world.step(REST_CHECK_STEPS)
        elapsed += REST_CHECK_STEPS * TIME_STEP
        if all(item.body.speed <= REST_SPEED for item in objects):
            return


def settle(world: World, objects: Sequence[SceneObject]) -> list[SceneObject]:
    """Wait for rest and remove what left the workspace, until nothing more leaves.

    Returns:
        The objects that remain.
    """
    remaining = list(objects)
    while True:
        wait_for_rest(world, remaining, REST_SECONDS)
        outside = [item for item in remaining if _is_outside(item.body)]
        if not outside:
            return remaining
        for item in outside:
            item.body.remove()
        remaining = [item for item in remaining if item not in outside]


def _is_outside(body: Body) -> bool:
    position = body.position
    return bool((position < 0.0).any() or (position[:2] > SIZE).any())


def _add_box_walls(world: World) -> list[Body]:
    length, width, height = PILE_BOX_EXTENT
    low = PILE_BOX_CORNER
    half = PILE_BOX_WALL / 2
    z = TABLE_HEIGHT + height / 2
    middle = low + length / 2
    plan = (
        ((PILE_BOX_WALL, width, height), (low + half, middle, z)),
        ((PILE_BOX_WALL, width, height), (low + length - half, middle, z)),
        ((length, PILE_BOX_WALL, height), (middle, low + half, z)),
        ((length, PILE_BOX_WALL, height), (middle, low + width - half, z)),
    )
    return [world.add_box(extent, centre, friction=0.5) for extent, centre in plan]
