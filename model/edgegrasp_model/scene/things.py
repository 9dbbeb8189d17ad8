"""What stands on a plane: things, told from walls, rims, furniture and what is cut off."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

CELL = 0.015  # metres; things further apart than this are two
FINE_CELL = 0.006  # metres, where coarser ones leave nothing but furniture
TOP = 0.5  # metres over the plane from which height no longer tells things apart
MIN_POINTS = 15  # fewer are no thing
MEASURED = 2000  # points that tell a thing's size and place, at most
SUPPORT_CELL = 0.02  # metres
MIN_PATCH = 5  # cells of a piece of the support plane
SMALL_PATCH = 0.05  # share of the largest piece below which one is taken for something else's top
INSIDE = 0.8  # share of a thing that lies over the support
OVERHANG = 0.02  # metres beyond the support's outline that a thing may reach
CUT_OFF = 0.005  # share of a thing's points at the image's border from which it is cut off
CUT_OFF_POINTS = 3
STANDS_OUT = 0.004  # metres over what belongs to the plane that a thing rises at least
BESIDE_THING = 0.06  # metres around a thing within which the support's points are counted
SCATTERED = 0.3  # of their number in a cell, below which points are noise
# In place of a thing's number: furniture; what may belong to one; the floor of an open box.
FIXED, UNKNOWN, BOX_FLOOR = -1, -2, -3
SURE = 0.85  # share of a cluster that lies where the caller says that things are
AROUND = 3  # sides of a workspace beyond which a cluster goes on where its inside is a box's
BOX_SHARE = 0.75  # of points on the sides and the top of a box
HEAP_HEIGHT = 0.25  # of the greatest length of a heap
DEEP = 0.05  # share of what lies in an open box that is no part of its walls
MIN_BOX = 0.25  # metres, longest side of the smallest open box that is told from a thing

JUMP = 0.015  # share of the distance between neighbouring pixels that parts them
SPECK = 0.001  # of an image's pixels, below which a piece of it may be a speck
SPECK_SHARE = 0.05  # of a thing's points, below which a piece of it may be one

STRIP = 0.025  # metres inside a side of a rectangle where a wall is looked for
STEP = 0.02  # metres along a wall
FILLED = 0.6  # share of a side along which a wall is seen at one height
LEVEL = 0.02  # metres of height within which a rim is level
MIN_WIDTH = 0.2  # metres between the walls of an open box
WALL = 0.02  # metres inside the outline that belong to a wall whose rim is not seen
BARE = 30  # percent of a wall's length, at least, on which nothing leans
BESIDE = 0.006  # metres further in that noise takes a wall's points
FREE = 0.010  # metres further in still, where what is seen is no part of a wall
HOLLOW = 0.02  # metres that the inside is seen below the rim
SPARSE = 0.5  # of the usual number of points in a cell, below which they are noise beside a box
FLOOR, MIN_FLOOR = 0.012, 0.2  # metres over a box's floor; share of the box where it is seen
MOST_FLOOR = 0.5  # that share where the support, too, is seen in the box


class PlaneView(NamedTuple):
    """M points that stand out from a plane, as it sees them."""

    plan: Float64  # (M, 2) metres along the plane
    height: NDArray[np.floating]  # (M,) metres over it
    margin: NDArray[np.floating]  # (M,) metres over it that still belong to it
    on: Float64  # (K, 2) points that belong to it, metres along it
    at_border: Bools | None  # (M,) at the border of the camera's image; None: unknown
    on_each: int = 1  # points that each of `on` stands for
    beyond: Int64 | None = None  # (M,) side of the workspace that each is beyond; 0: in it


def plan_axes(normal: Float64, viewpoint: Float64 | None, points: NDArray[np.floating]) -> Float64:
    """Two unit axes (2, 3) along a plane, the first toward the camera, else the furthest point."""
    middle = np.array([axis.mean(dtype=np.float64) for axis in points.T])
    offsets = points[:: max(len(points) // 1000, 1)] - middle
    if viewpoint is not None:
        offsets = np.concatenate([[viewpoint - middle], offsets])
    level = offsets - (offsets @ normal)[:, None] * normal
    length = np.linalg.norm(level, axis=1)
    first = 0 if viewpoint is not None and length[0] > 1e-3 else int(length.argmax())
    x = level[first] / max(length[first], 1e-9)
    return np.stack([x, np.cross(normal, x)])


def find_things(view: PlaneView, max_size: float, cell: float = CELL, strict: bool = True) -> Int64:
    """The things that stand on a plane: clusters above it that are no furniture.

    A thing lies over the seen part of the plane, is not longer than `max_size`, or is a heap of
    things that is at most twice as long, and is not cut off by the image's border; or it lies in
    the caller's workspace. Of an open box, and of what goes on around the workspace, the inside is
    one thing or several, however large.

    Args:
        view: M points.
        max_size: Longest side of a thing, metres.
        cell: Metres between points that still hang together.
        strict: Otherwise things may be cut off.

    Returns:
        (M,) number of each point's thing, from 0; FIXED: of furniture; BOX_FLOOR; UNKNOWN.
    """
    number = np.full(len(view.height), UNKNOWN, dtype=np.int64)
    found = 0
    outline = support_outline(view.on)
    for mine in clusters(view.plan, view.height, cell):
        some = mine[:: len(mine) // MEASURED + 1]
        if np.percentile(view.height[some] - view.margin[some], 98) < STANDS_OUT:
            continue
        if _is_noise(mine, view):
            continue
        length = _length(view.plan[some], view.height[some])
        if view.beyond is not None and (view.beyond[mine] == 0).mean() > SURE:
            number[mine], found = found, found + 1
            continue
        contents = _around_workspace(mine, view)
        if contents is None and length > MIN_BOX:
            contents = box_contents(view.plan[mine], view.height[mine], view.on)
        if contents is not None:
            number[mine[contents.walls]] = FIXED
            number[mine[contents.floor]] = BOX_FLOOR
            deep, mine = contents.deep[contents.inside], mine[contents.inside]
            for part in clusters(view.plan[mine], view.height[mine]):
                if deep[part].mean() < DEEP:
                    number[mine[part]] = FIXED
                else:
                    number[mine[part]], found = found, found + 1
        elif (
            _over(outline, view.plan[some])
            and (_whole(mine, view) or not strict)
            and (length <= max_size or _is_heap(view.plan[some], view.height[some], 2 * max_size))
        ):
            number[mine], found = found, found + 1
        else:
            number[mine] = FIXED
    return number


def clusters(plan: Float64, height: NDArray[np.floating], size: float = CELL) -> list[Int64]:
    """Rows of points (M, 2), (M,) that hang together by cells of a size, the most first."""
    if len(plan) == 0:
        return []
    axes = *plan.T, np.minimum(height, TOP)
    cell = [((axis - axis.min()) / size).astype(np.int64) for axis in axes]
    shape = [int(axis.max()) + 1 for axis in cell]
    key = (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]
    held = np.zeros(math.prod(shape), dtype=bool)
    held[key] = True
    labels, _ = ndimage.label(held.reshape(shape), np.ones((3, 3, 3)))
    label = labels.reshape(-1)[key]
    count = np.bincount(label)
    order = np.argsort(label, kind="stable")
    start = np.cumsum(count) - count
    large = [int(one) for one in np.argsort(-count, kind="stable") if count[one] >= MIN_POINTS]
    return [order[start[one] : start[one] + count[one]] for one in large]


def without_speckles(
    number: Int64, row: Int64, image_size: tuple[int, int], distance: NDArray[np.floating]
) -> Int64:
    """The numbers of things, without the specks that depth cameras see before or behind them.

    A speck is a small piece of the image whose depths are not those of the pixels around it.

    Args:
        number: (M,) as from `find_things`.
        row: (M,) its pixel, row-major, ascending.
        image_size: (H, W).
        distance: (M,) metres from the camera.

    Returns:
        (M,) numbers; UNKNOWN for specks of things.
    """
    height, width = image_size
    place = np.full(height * width, -1, dtype=np.int64)
    place[row] = np.arange(len(row))
    ends = []
    for step, inside in ((1, row % width < width - 1), (width, row < (height - 1) * width)):
        start = np.flatnonzero(inside)
        end = place[row[start] + step]
        start, end = start[end >= 0], end[end >= 0]
        near = np.abs(distance[start] - distance[end]) < JUMP * distance[start]
        ends.append((start[near], end[near]))
    start, end = np.concatenate(ends, axis=1)
    links = coo_array((np.ones(len(start), dtype=bool), (start, end)), shape=(len(row), len(row)))
    _, piece = connected_components(links, directed=False)
    size = np.bincount(piece)[piece]
    of_thing = np.bincount(number - BOX_FLOOR)[number - BOX_FLOOR]
    speck = (size < SPECK * height * width) & (size < SPECK_SHARE * of_thing)
    return np.where(speck & (number >= 0), UNKNOWN, number)


def support_outline(plan: Float64) -> Float64 | None:
    """Half planes (H, 3) whose intersection is the outline of a plane's seen pieces."""
    if len(plan) < MIN_POINTS:
        return None
    axes = np.ascontiguousarray(plan.T)
    low = axes.min(axis=1)
    x, y = ((axes - low[:, None]) / SUPPORT_CELL).astype(np.int64)
    held = np.zeros((x.max() + 5, y.max() + 5), dtype=bool)
    held[x + 2, y + 2] = True
    labels, _ = ndimage.label(ndimage.binary_closing(held, iterations=2), np.ones((3, 3)))
    size = np.bincount(labels[held], minlength=labels.max() + 1)
    size[0] = 0
    held &= (size >= max(MIN_PATCH, SMALL_PATCH * size.max()))[labels]
    middles = (np.argwhere(held & ~ndimage.binary_erosion(held)) - 1.5) * SUPPORT_CELL + low
    try:
        return np.asarray(ConvexHull(middles).equations)
    except (QhullError, ValueError):  # too few cells, or all in a line
        return None


class Contents(NamedTuple):
    """Of M points of an open box."""

    inside: Bools  # (M,) but for its floor
    walls: Bools  # (M,)
    deep: Bools  # (M,) further in than noise takes a wall's points
    floor: Bools  # (M,)


def box_contents(plan: Float64, height: NDArray[np.floating], on: Float64) -> Contents | None:
    """What lies in an open box of points (M, 2), (M,); None where it is none.

    An open box has a level rim along at least three sides of the smallest rectangle around it, and
    is lower inside, or the support (K, 2) is seen there.
    """
    _, _, from_side, levels = _rims(plan, height, plan)
    if len(levels) < 3:
        return None
    # Stray points beside the walls lie lower than the rim: again, around the rim alone.
    level = np.median(levels)
    rim = (np.abs(height - level) < LEVEL) & (from_side.min(axis=0) < 2 * STRIP)
    around, place, from_side, levels = _rims(plan, height, plan[rim])
    if len(levels) < 3:
        return None
    rim = np.abs(height - level) < LEVEL / 2
    along, near = place[:, rim], from_side[:, rim]
    wall = np.array([_wall(along[1 - side // 2], near[side]) for side in range(4)])
    from_wall = (from_side - wall[:, None]).min(axis=0)
    between: Bools = from_wall > 0
    bare = (around.from_sides(around.place(on)) > wall[:, None]).all(axis=0)
    floor_seen = occupied_cells(on[bare]) * CELL**2 > MIN_FLOOR * around.size.prod()
    seen = between.sum() >= MIN_POINTS
    lowest, low = np.percentile(height[between], (3, 5)) if seen else (np.inf, np.inf)
    if not (floor_seen or low < level - HOLLOW):
        return None
    on_rim = (height > level + LEVEL) & (from_side.min(axis=0) > 0)
    inside = between | on_rim
    walls, deep = ~inside, from_wall > FREE
    floor = between & (height < lowest + FLOOR)
    least = MOST_FLOOR if floor_seen else MIN_FLOOR
    if occupied_cells(plan[floor]) * CELL**2 < least * around.size.prod():
        floor[:] = False
    return Contents(inside & ~floor, walls, deep, floor)


def _around_workspace(rows: Int64, view: PlaneView) -> Contents | None:
    """What of a cluster lies in the caller's workspace; None where it does not go on around it."""
    if view.beyond is None or np.count_nonzero(np.unique(view.beyond[rows])) < AROUND:
        return None
    inside = view.beyond[rows] == 0
    return Contents(inside, walls=~inside, deep=inside, floor=np.zeros(len(rows), dtype=bool))


def _dense(plan: Float64) -> Bools:
    """Which points (M, 2) have about as many around them as the others."""
    number = number_cells(plan)
    count = np.bincount(number)
    return np.asarray(count[number] >= SPARSE * np.median(count[count > 0]))


def occupied_cells(plan: Float64, size: float = CELL) -> int:
    """How many cells of a size points (M, 2) lie in."""
    return int(np.count_nonzero(np.bincount(number_cells(plan, size))))


def number_cells(plan: Float64, size: float = CELL) -> Int64:
    """The number (M,) of the cell that each point (M, 2) is in."""
    if len(plan) == 0:
        return np.zeros(0, dtype=np.int64)
    x, y = (((axis - axis.min()) / size).astype(np.int64) for axis in np.ascontiguousarray(plan.T))
    return np.asarray(x * (y.max() + 1) + y)


class Rectangle(NamedTuple):
    """A rectangle in a plane; metres."""

    axes: Float64  # (2, 2) unit, along its sides
    low: Float64  # (2,) its lowest corner, on them
    size: Float64  # (2,)

    def place(self, plan: Float64) -> Float64:
        """Places (2, M) of points (M, 2) on its axes, from its low corner."""
        return np.asarray((plan @ self.axes.T - self.low).T)

    def from_sides(self, place: Float64) -> Float64:
        """Distances (4, M) of places (2, M) from its sides, positive inside."""
        (x, y), (length, width) = place, self.size
        return np.stack([x, length - x, y, width - y])


def smallest_rectangle(plan: Float64) -> Rectangle:
    """The smallest rectangle around points (M, 2)."""
    try:
        corners = plan[ConvexHull(plan).vertices]
    except (QhullError, ValueError):  # too few points, or all in a line
        corners = plan
    edges = np.roll(corners, -1, axis=0) - corners
    edges = edges[np.linalg.norm(edges, axis=1) > 0] if len(corners) > 1 else edges[:0]
    edges = np.concatenate([edges, [[1.0, 0.0]]])
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    axes = np.stack([edges, np.stack([-edges[:, 1], edges[:, 0]], axis=1)], axis=1)  # (K, 2, 2)
    turned = np.einsum("kad,cd->kca", axes, corners)
    size = np.ptp(turned, axis=1)
    best = int(size.prod(axis=1).argmin())
    return Rectangle(axes[best], turned[best].min(axis=0), size[best])


def _rims(
    plan: Float64, height: NDArray[np.floating], around: Float64
) -> tuple[Rectangle, Float64, Float64, list[float]]:
    """The smallest rectangle around some points, and what of points (M, 2) lies at its sides.

    Returns:
        The rectangle, their places (2, M) on its axes and distances (4, M) from its sides, and the
        heights of the level rims along those; none of a small rectangle.
    """
    rectangle = smallest_rectangle(around[_dense(around)])
    place = rectangle.place(plan)
    from_side, levels = rectangle.from_sides(place), []
    for side in range(4 if rectangle.size.min() > MIN_WIDTH else 0):
        at, along = from_side[side] < STRIP, 1 - side // 2
        levels.append(_rim(place[along, at], height[at], float(rectangle.size[along])))
    return rectangle, place, from_side, [level for level in levels if level is not None]


def _wall(along: Float64, distance: Float64) -> float:
    """How far in a wall goes whose rim's points are at places (M,) and distances (M,); metres.

    What leans on it, as far as most of its length, does not count.
    """
    near = distance < 2 * STRIP
    step, distance = (along[near] / STEP).astype(np.int64), distance[near]
    ends = [np.percentile(distance[step == one], 90) for one in np.unique(step)]
    return float(np.percentile(ends, BARE)) + BESIDE if ends else WALL


def _rim(along: Float64, height: NDArray[np.floating], length: float) -> float | None:
    """The height of a level rim along a side; None where there is none."""
    steps = max(int(np.ceil(length / STEP)), 1)
    top = np.full(steps, -np.inf)
    np.maximum.at(top, np.clip((along / STEP).astype(np.int64), 0, steps - 1), height)
    seen = np.isfinite(top)
    if not seen.any():
        return None
    level = float(np.median(top[seen]))
    return level if (np.abs(top - level) < LEVEL).mean() > FILLED else None


def _is_heap(plan: Float64, height: NDArray[np.floating], most: float) -> bool:
    """Whether points (M, 2), (M,) are not longer than `most`, metres, lower, and no box.

    Of a box, most points are on the sides of a rectangle, and on a level top.
    """
    rectangle = smallest_rectangle(plan)
    side = rectangle.from_sides(rectangle.place(plan)).min(axis=0) < STRIP
    level = np.abs(height - np.percentile(height, 90)) < LEVEL
    flat = rectangle.size.max() <= most and np.ptp(height) <= HEAP_HEIGHT * most
    return bool(flat and (side | level).mean() < BOX_SHARE)


def _length(plan: Float64, height: NDArray[np.floating]) -> float:
    """The longest side of the box along the principal axes of points, or their height; metres."""
    axes = np.ascontiguousarray(plan.T)
    around = axes - axes.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(around @ around.T)
    return max(float(np.ptp(vectors.T @ around, axis=1).max()), float(np.ptp(height)))


def _is_noise(rows: Int64, view: PlaneView) -> bool:
    """Whether some points, not many, lie much further apart than the support's around them."""
    if len(rows) > MEASURED:
        return False
    plan = view.plan[rows]
    low, high = plan.min(axis=0) - BESIDE_THING, plan.max(axis=0) + BESIDE_THING
    near = view.on[((view.on > low) & (view.on < high)).all(axis=1)]
    if len(near) < MIN_POINTS:
        return False
    around = len(near) * view.on_each / occupied_cells(near)
    return len(rows) / occupied_cells(plan) < SCATTERED * around


def _whole(rows: Int64, view: PlaneView) -> bool:
    if view.at_border is None:
        return True
    return int(view.at_border[rows].sum()) <= max(CUT_OFF_POINTS, CUT_OFF * len(rows))


def _over(outline: Float64 | None, plan: Float64) -> bool:
    if outline is None:
        return True
    inside = (plan @ outline[:, :2].T + outline[:, 2] < OVERHANG).all(axis=1)
    return bool(inside.mean() >= INSIDE)
