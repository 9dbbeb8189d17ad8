"""The fixed parts of a scene: a table, an open bin, a crowded table, or a shelf.

They never move. The plane that the objects rest on is at `TABLE_HEIGHT` in every scene.
"""

from dataclasses import dataclass

import numpy as np

from edgegrasp_camera.arrays import Float64
from edgegrasp_sim.engine import Body, Vector, World

SIZE = 0.30  # metres, edge of the workspace cube
TABLE_HEIGHT = 0.05  # metres
OPEN_EXTENT = 1.2  # metres along both sides of an open table
OPEN_THICKNESS = 0.2  # metres; objects sink into a thin table like the reference's, 12 mm
TABLE_FRICTION = 0.5  # of tables and walls
BOTTOM = TABLE_HEIGHT + 0.005  # metres, lowest z of the workspace
# Lowest and highest corner of the region for grasps on an open table.
WORKSPACE = ((0.02, 0.02, BOTTOM), (SIZE - 0.02, SIZE - 0.02, SIZE))
MIDDLE = SIZE / 2  # metres, x and y of the middle of every scene

Span = tuple[float, float]  # minimum and maximum, metres
Spans = tuple[Span, Span, Span]  # of length, width and height
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]  # lowest, highest; metres

# Random bins. Inner length, width and height: the palm of the Panda's hand is 20 cm wide and 5 cm
# above its fingertips, so that it can grasp little along a higher wall.
BIN_INSIDE: Spans = ((0.40, 0.60), (0.30, 0.42), (0.03, 0.08))
SMALL_BIN_INSIDE: Spans = ((0.30, 0.40), (0.24, 0.30), (0.03, 0.08))
DEEP_BIN_INSIDE: Spans = ((0.36, 0.60), (0.26, 0.42), (0.08, 0.22))
BIN_WALL: Span = (0.008, 0.015)  # also the floor's; objects are pressed through thinner walls
GROUND = 0.2  # metres, thickness of a floor, for the same reason
STAND_SHARE = 0.3  # share of the bins that are above the table: on a stand, a conveyor
STAND: Span = (0.1, 0.4)
HEAP = 0.10  # metres that a heap may rise above the walls
FLOOR = (6.0, 6.0, 0.2)  # metres, size of the floor below tables and shelves

# Random crowded tables.
REACH = 0.16  # greatest distance of objects from the middle, along x and y, metres
TABLE_LENGTH: Span = (0.5, 1.2)
TABLE_OVER_FLOOR: Span = (0.4, 0.8)
LARGE_OBJECTS = (1, 3)  # minimum and maximum number of objects too large to grasp
LARGE_DISTANCE: Span = (0.05, 0.30)  # from the middle to the nearest side of a large object
# Length, width and height of large objects, which are too long for any grasp.
CARTON: Spans = ((0.42, 0.60), (0.10, 0.35), (0.05, 0.40))
PANEL: Spans = ((0.42, 0.60), (0.02, 0.05), (0.42, 0.55))  # monitors, walls
KERB: Spans = ((0.42, 0.60), (0.04, 0.12), (0.02, 0.06))  # books, keyboards

# Random shelves. Width, depth and height inside a compartment, with room for a hand.
SHELF_INSIDE: Spans = ((0.45, 0.90), (0.26, 0.40), (0.34, 0.48))
SHELF_BOARD: Span = (0.015, 0.030)
SHELF_MARGIN = 0.06  # metres from its sides and edges without objects
SHELF_OVER_FLOOR: Span = (0.4, 1.2)


@dataclass(frozen=True, slots=True)
class Box:
    """A box that never moves; metres, world frame."""

    size: tuple[float, float, float]  # full extent along its own axes
    centre: tuple[float, float, float]  # of the box
    yaw: float = 0.0  # radians about world z
    obstacle: bool = True  # whether a collision with it fails the grasp; not with the table

    def add_to(self, world: World) -> Body:
        """Add it to a world."""
        return world.add_box(self.size, self.centre, friction=TABLE_FRICTION, yaw=self.yaw)


@dataclass(frozen=True, slots=True)
class FixedParts:
    """The fixed parts of a scene, and the region of its objects."""

    boxes: tuple[Box, ...]  # all fixed parts
    workspace: Corners  # of the region for grasps
    bounds: Corners  # of the region for objects' centres; objects that leave it are removed
    # Greatest distance of placed objects from the middle, along x and y, metres.
    reach: tuple[float, float] = (REACH, REACH)

    def add_to(self, world: World) -> frozenset[int]:
        """Add everything to a world; returns the ids of the obstacles' bodies."""
        added = [(box.add_to(world).uid, box) for box in self.boxes]
        return frozenset(uid for uid, box in added if box.obstacle)

    def contains(self, body: Body) -> bool:
        """Whether an object is within the bounds."""
        low, high = np.asarray(self.bounds)
        return bool(((low <= body.position) & (body.position <= high)).all())


def _slab(size: Vector, top: float, x: float = MIDDLE, y: float = MIDDLE) -> Box:
    length, width, height = map(float, size)
    return Box((length, width, height), (x, y, top - height / 2), obstacle=False)


def open_table(thickness: float = OPEN_THICKNESS) -> FixedParts:
    """A table without other parts, of a thickness in metres."""
    table = _slab((OPEN_EXTENT, OPEN_EXTENT, thickness), TABLE_HEIGHT)
    return FixedParts((table,), WORKSPACE, ((0.0, 0.0, 0.0), (SIZE, SIZE, np.inf)))


OPEN_TABLE = open_table()


def random_bin(rng: np.random.Generator, extents: Spans = BIN_INSIDE) -> FixedParts:
    """An open box of inner `extents` on or above a table, with its floor at `TABLE_HEIGHT`."""
    length, width, height = (rng.uniform(*extent) for extent in extents)
    wall = rng.uniform(*BIN_WALL)
    stand = rng.uniform(*STAND) if rng.random() < STAND_SHARE else 0.0
    half = np.array([length, width]) / 2
    outer = half + wall
    floor = _slab((*(2 * outer), wall + stand + GROUND), TABLE_HEIGHT)
    boxes = [_slab((OPEN_EXTENT, OPEN_EXTENT, OPEN_THICKNESS), TABLE_HEIGHT - wall - stand), floor]
    z = TABLE_HEIGHT + height / 2
    for side in (-1.0, 1.0):
        x, y = MIDDLE + side * (half + wall / 2)
        boxes.append(Box((wall, 2 * float(outer[1]), height), (float(x), MIDDLE, z)))
        boxes.append(Box((length, wall, height), (MIDDLE, float(y), z)))
    top = TABLE_HEIGHT + height + HEAP
    return FixedParts(tuple(boxes), _corners(half, BOTTOM, top), _corners(half, 0.0, top))


def random_table(rng: np.random.Generator) -> FixedParts:
    """A table with an edge near the objects, a floor below, and one to three large objects."""
    over = float(rng.uniform(*TABLE_OVER_FLOOR))
    size = rng.uniform(*TABLE_LENGTH, size=2)
    # All objects are placed on it; an edge may be close to them.
    aside = rng.uniform(-1.0, 1.0, size=2) * (size / 2 - REACH - 0.02)
    table = _slab((*size, over), TABLE_HEIGHT, *(MIDDLE + aside))
    boxes = [_slab(FLOOR, TABLE_HEIGHT - over), table]
    large = int(rng.integers(*LARGE_OBJECTS, endpoint=True))
    boxes += [_large_object(rng) for _ in range(large)]
    half = np.full(2, REACH + 0.05)
    workspace = _corners(half, BOTTOM, TABLE_HEIGHT + 0.30)
    return FixedParts(tuple(boxes), workspace, _corners(half, 0.0, np.inf))


def random_shelf(rng: np.random.Generator) -> FixedParts:
    """A shelf's compartment, open toward -y, with its floor at `TABLE_HEIGHT`; another is above."""
    width, depth, height = (float(rng.uniform(*extent)) for extent in SHELF_INSIDE)
    board, over = float(rng.uniform(*SHELF_BOARD)), float(rng.uniform(*SHELF_OVER_FLOOR))
    tall = GROUND + 2 * height
    middle = TABLE_HEIGHT - GROUND + tall / 2
    boxes = [_slab(FLOOR, TABLE_HEIGHT - over), _slab((width, depth, GROUND), TABLE_HEIGHT)]
    for side in (-1.0, 1.0):
        x = MIDDLE + side * (width + board) / 2
        boxes.append(Box((board, depth, tall), (x, MIDDLE, middle)))
    back = Box((width + 2 * board, board, tall), (MIDDLE, MIDDLE + (depth + board) / 2, middle))
    ceiling = Box((width, depth, board), (MIDDLE, MIDDLE, TABLE_HEIGHT + height + board / 2))
    half, top = np.array([width, depth]) / 2, TABLE_HEIGHT + height
    return FixedParts(
        (*boxes, back, ceiling),
        _corners(half, BOTTOM, top),
        _corners(half, TABLE_HEIGHT, top),
        (width / 2 - SHELF_MARGIN, depth / 2 - SHELF_MARGIN),
    )


def _large_object(rng: np.random.Generator) -> Box:
    """An object too large to grasp, next to the others, with any yaw."""
    kind = (CARTON, CARTON, PANEL, KERB)[int(rng.integers(4))]
    length, width, height = (float(rng.uniform(*extent)) for extent in kind)
    yaw, around = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, np.pi)
    away = np.array([np.cos(around), np.sin(around)])
    along = np.array([np.cos(yaw), np.sin(yaw)])
    across = np.array([-along[1], along[0]])
    reach = abs(away @ along) * length / 2 + abs(away @ across) * width / 2
    x, y = MIDDLE + (reach + rng.uniform(*LARGE_DISTANCE)) * away
    centre = (float(x), float(y), TABLE_HEIGHT + height / 2)
    return Box((length, width, height), centre, yaw=float(yaw))


def _corners(half: Float64, bottom: float, top: float) -> Corners:
    """Corners of a box that extends `half` (2,) from the middle, along x and y."""
    (left, front), (right, back) = (MIDDLE - half).tolist(), (MIDDLE + half).tolist()
    return (left, front, bottom), (right, back, top)
