"""The surroundings of a scene's objects: a table, an open bin, a crowded table, or a shelf.

Nothing of it ever moves. The plane that the objects rest on lies at `TABLE_HEIGHT` in every scene.
"""

from dataclasses import dataclass

import numpy as np

from edgegrasp_sim.engine import Body, World
from edgegrasp_sim.poses import Matrix

SIZE = 0.30  # metres, edge of the workspace cube
TABLE_HEIGHT = 0.05  # metres
OPEN_EXTENT = 1.2  # metres along both sides of an open table
OPEN_THICKNESS = 0.2  # metres; objects sink into a thin table, as into the reference's of 12 mm
TABLE_FRICTION = 0.5
WALL_FRICTION = 0.5
SUPPORT_CLEARANCE = 0.005  # metres over the table at which the workspace begins
# Lowest and highest corner of where grasps are looked for on an open table.
WORKSPACE = (
    (0.02, 0.02, TABLE_HEIGHT + SUPPORT_CLEARANCE),
    (SIZE - 0.02, SIZE - 0.02, SIZE),
)
MIDDLE = SIZE / 2  # metres, x and y of the middle of every scene

Span = tuple[float, float]  # least and greatest, metres
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]  # lowest, highest; metres


@dataclass(frozen=True, slots=True)
class Bins:
    """Ranges of random bins; lengths in metres."""

    # Length, width and height inside. The palm of the Panda's hand is 20 cm wide and 5 cm above
    # its fingertips: along a higher wall it holds little.
    inside: tuple[Span, Span, Span] = ((0.40, 0.60), (0.30, 0.42), (0.03, 0.08))
    small: tuple[Span, Span, Span] = ((0.30, 0.40), (0.24, 0.30), (0.03, 0.08))
    wall: Span = (0.008, 0.015)  # its floor is as thick; objects are pressed through thinner ones
    ground: float = 0.2  # depth of the floor into what it stands on, for the same reason
    stand_share: float = 0.3  # of the bins, which stand off the table: on a stand, a conveyor
    stand: Span = (0.1, 0.4)
    heap: float = 0.10  # that a heap may rise over the walls


@dataclass(frozen=True, slots=True)
class Tables:
    """Ranges of random crowded tables; lengths in metres."""

    reach: float = 0.16  # from the middle, along x and y, where objects are put
    length: Span = (0.5, 1.2)
    over_floor: Span = (0.4, 0.8)
    large: tuple[int, int] = (1, 3)  # objects too large to grasp
    distance: Span = (0.05, 0.30)  # from the middle to the nearest side of a large object
    # Length, width and height. No hand would grasp a longer object.
    carton: tuple[Span, Span, Span] = ((0.42, 0.60), (0.10, 0.35), (0.05, 0.40))
    panel: tuple[Span, Span, Span] = ((0.42, 0.60), (0.02, 0.05), (0.42, 0.55))  # monitors, walls
    kerb: tuple[Span, Span, Span] = ((0.42, 0.60), (0.04, 0.12), (0.02, 0.06))  # books, keyboards


@dataclass(frozen=True, slots=True)
class Shelves:
    """Ranges of random shelves; lengths in metres."""

    # Width, depth and height inside a compartment, in which a hand has room.
    inside: tuple[Span, Span, Span] = ((0.45, 0.90), (0.26, 0.40), (0.34, 0.48))
    board: Span = (0.015, 0.030)
    margin: float = 0.06  # from its sides and edges where no object is put
    over_floor: Span = (0.4, 1.2)


BINS, TABLES, SHELVES = Bins(), Tables(), Shelves()


@dataclass(frozen=True, slots=True)
class Box:
    """A box that never moves; metres, world frame."""

    size: tuple[float, float, float]  # full extent along its own axes
    centre: tuple[float, float, float]  # of the box
    yaw: float = 0.0  # radians about world z
    friction: float = WALL_FRICTION  # lateral
    obstacle: bool = True  # a hand that hits it has failed; the table is none

    def add_to(self, world: World) -> Body:
        """Add it to a world."""
        return world.add_box(self.size, self.centre, friction=self.friction, yaw=self.yaw)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The fixed parts of a scene, and the region of its objects."""

    boxes: tuple[Box, ...]  # all that never moves
    workspace: Corners  # of where grasps are looked for
    bounds: Corners  # of where an object's centre may be; one that leaves it is taken away
    # Metres from the middle, along x and y, where objects are put down.
    reach: tuple[float, float] = (TABLES.reach, TABLES.reach)

    def add_to(self, world: World) -> frozenset[int]:
        """Add everything to a world; returns the ids of the obstacles' bodies."""
        bodies = [box.add_to(world).uid for box in self.boxes]
        pairs = zip(bodies, self.boxes, strict=True)
        return frozenset(uid for uid, box in pairs if box.obstacle)

    def contain(self, body: Body) -> bool:
        """Whether an object is within the bounds."""
        low, high = np.asarray(self.bounds)
        position = body.position
        return bool((position >= low).all() and (position <= high).all())


def _slab(size: Matrix, top: float, x: float = MIDDLE, y: float = MIDDLE) -> Box:
    length, width, height = map(float, size)
    centre = (x, y, top - height / 2)
    return Box((length, width, height), centre, friction=TABLE_FRICTION, obstacle=False)


def open_table(thickness: float = OPEN_THICKNESS) -> Surroundings:
    """A table alone, of a thickness in metres."""
    table = _slab(np.array([OPEN_EXTENT, OPEN_EXTENT, thickness]), TABLE_HEIGHT)
    return Surroundings((table,), WORKSPACE, ((0.0, 0.0, 0.0), (SIZE, SIZE, np.inf)))


OPEN_TABLE = open_table()


def random_bin(rng: np.random.Generator, *, small: bool = False) -> Surroundings:
    """An open box on a table or over it, its floor at `TABLE_HEIGHT`; a small one gets full."""
    extents = BINS.small if small else BINS.inside
    length, width, height = (rng.uniform(*extent) for extent in extents)
    wall = rng.uniform(*BINS.wall)
    stand = rng.uniform(*BINS.stand) if rng.random() < BINS.stand_share else 0.0
    half = np.array([length, width]) / 2
    outer = half + wall
    depth = wall + stand + BINS.ground
    floor = _slab(np.array([*(2 * outer), depth]), TABLE_HEIGHT)
    size = np.array([OPEN_EXTENT, OPEN_EXTENT, OPEN_THICKNESS])
    boxes = [_slab(size, TABLE_HEIGHT - wall - stand), floor]
    z = TABLE_HEIGHT + height / 2
    for side in (-1.0, 1.0):
        x, y = MIDDLE + side * (half + wall / 2)
        boxes.append(Box((wall, 2 * float(outer[1]), height), (float(x), MIDDLE, z)))
        boxes.append(Box((length, wall, height), (MIDDLE, float(y), z)))
    low, high = MIDDLE - half, MIDDLE + half
    top = TABLE_HEIGHT + height + BINS.heap
    return Surroundings(
        tuple(boxes),
        _corners(low, high, TABLE_HEIGHT + SUPPORT_CLEARANCE, top),
        _corners(low, high, 0.0, top),
    )


def random_table(rng: np.random.Generator) -> Surroundings:
    """A table with an edge near the objects, a floor below, and one to three large objects."""
    reach = np.full(2, TABLES.reach)
    low, high = MIDDLE - reach, MIDDLE + reach
    over = float(rng.uniform(*TABLES.over_floor))
    size = np.array([*rng.uniform(*TABLES.length, size=2), over])
    # All the objects' places are on it; an edge may be close to them.
    aside = rng.uniform(-1.0, 1.0, size=2) * (size[:2] / 2 - reach - 0.02)
    table = _slab(size, TABLE_HEIGHT, *(MIDDLE + aside))
    floor = _slab(np.array([6.0, 6.0, 0.2]), TABLE_HEIGHT - over)
    boxes = [floor, table]
    large = int(rng.integers(TABLES.large[0], TABLES.large[1] + 1))
    boxes += [_large_object(rng) for _ in range(large)]
    bottom = TABLE_HEIGHT + SUPPORT_CLEARANCE
    return Surroundings(
        tuple(boxes),
        _corners(low - 0.05, high + 0.05, bottom, TABLE_HEIGHT + 0.30),
        _corners(low - 0.05, high + 0.05, 0.0, np.inf),
    )


def random_shelf(rng: np.random.Generator) -> Surroundings:
    """A compartment of a shelf, open toward -y, its floor at `TABLE_HEIGHT`, another one above."""
    width, depth, height = (float(rng.uniform(*extent)) for extent in SHELVES.inside)
    board, over = float(rng.uniform(*SHELVES.board)), float(rng.uniform(*SHELVES.over_floor))
    floor = _slab(np.array([6.0, 6.0, 0.2]), TABLE_HEIGHT - over)
    bottom = _slab(np.array([width, depth, BINS.ground]), TABLE_HEIGHT)
    tall = BINS.ground + 2 * height
    middle = TABLE_HEIGHT - BINS.ground + tall / 2
    boxes = [floor, bottom]
    for side in (-1.0, 1.0):
        x = MIDDLE + side * (width + board) / 2
        boxes.append(Box((board, depth, tall), (x, MIDDLE, middle)))
    back = Box((width + 2 * board, board, tall), (MIDDLE, MIDDLE + (depth + board) / 2, middle))
    ceiling = Box((width, depth, board), (MIDDLE, MIDDLE, TABLE_HEIGHT + height + board / 2))
    half = np.array([width, depth]) / 2
    low, high, top = MIDDLE - half, MIDDLE + half, TABLE_HEIGHT + height
    return Surroundings(
        (*boxes, back, ceiling),
        _corners(low, high, TABLE_HEIGHT + SUPPORT_CLEARANCE, top),
        _corners(low, high, TABLE_HEIGHT, top),
        (width / 2 - SHELVES.margin, depth / 2 - SHELVES.margin),
    )


def _large_object(rng: np.random.Generator) -> Box:
    """An object too large to grasp that stands beside the others, turned any way."""
    kind = (TABLES.carton, TABLES.carton, TABLES.panel, TABLES.kerb)[int(rng.integers(4))]
    length, width, height = (float(rng.uniform(*extent)) for extent in kind)
    yaw, around = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, np.pi)
    away = np.array([np.cos(around), np.sin(around)])
    along = np.array([np.cos(yaw), np.sin(yaw)])
    across = np.array([-along[1], along[0]])
    reach = abs(away @ along) * length / 2 + abs(away @ across) * width / 2
    x, y = MIDDLE + (reach + rng.uniform(*TABLES.distance)) * away
    centre = (float(x), float(y), TABLE_HEIGHT + height / 2)
    return Box((length, width, height), centre, yaw=float(yaw))


def _corners(low: Matrix, high: Matrix, bottom: float, top: float) -> Corners:
    return (float(low[0]), float(low[1]), bottom), (float(high[0]), float(high[1]), top)
