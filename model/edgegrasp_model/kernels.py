"""Loops over the points near each hand, compiled to machine code by Numba.

NumPy would need many passes over large arrays; these loops take one point at a time and stay in the
processor's cache.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats, Int64

Loop = TypeVar("Loop", bound=Callable[..., Any])

BLOCK_SIZE = 64  # points per block; blocks out of reach are skipped
SLACK = 1e-5  # metres; a generous bound on float32 errors


def compiled(*freedom: str) -> Callable[[Loop], Loop]:
    """Compile on the first call, cached on disk; `freedom` is LLVM's fast-math flags."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": set(freedom)}

    def decorate(function: Loop) -> Loop:
        try:
            loop: Loop = numba.njit(cache=True, **options)(function)
        except RuntimeError:  # no folder is writable, neither beside the file nor the user's own
            loop = numba.njit(**options)(function)
        return loop

    return decorate


class InHands(NamedTuple):  # Numba's cached loops refer to it by this name
    """N points, and the transforms from their frame to those of E hands."""

    columns: Float32  # (3, N) x, y and z, metres
    R_hand_cloud: Float32  # (E, 3, 3)
    t_hand_cloud: Float32  # (E, 3) metres


def in_hands(points: Float32, T_cloud_hand: Float32) -> InHands:
    """Points (N, 3) and hands (E, 4, 4), arranged for the loops below."""
    columns = np.ascontiguousarray(points.T, dtype=np.float32)
    R = np.ascontiguousarray(T_cloud_hand[:, :3, :3].transpose(0, 2, 1))
    return InHands(columns, R, -(R @ T_cloud_hand[:, :3, 3:])[:, :, 0])


@compiled("contract")
def points_in_hand_boxes(
    hands: InHands, low: Float32, high: Float32
) -> tuple[Int64, Int64, Float32]:
    """The points between two corners (3,) of each hand's frame.

    Returns hand (P,), ascending; row (P,), ascending for each hand; position (3, P) in its frame.
    """
    columns, R, t = hands
    sphere = _blocks(columns)
    xs, ys, zs = columns[0], columns[1], columns[2]
    count = 0
    for e in range(len(R)):
        for k in range(len(sphere)):
            if _may_reach(sphere[k], R[e], t[e], low, high):
                count += _count_between(columns, k, R[e], t[e], low, high)
    hand, row = np.empty(count, np.int64), np.empty(count, np.int64)
    position, place = np.empty((3, count), np.float32), 0
    for e in range(len(R)):
        for k in range(len(sphere)):
            if _may_reach(sphere[k], R[e], t[e], low, high):
                for i in range(k * BLOCK_SIZE, min((k + 1) * BLOCK_SIZE, len(xs))):
                    x, y, z = _position(xs[i], ys[i], zs[i], R[e], t[e])
                    if _between(x, y, z, low, high):
                        hand[place], row[place] = e, i
                        position[0, place], position[1, place], position[2, place] = x, y, z
                        place += 1
    return hand, row, position


@compiled("contract")
def any_point_in_boxes(hands: InHands, boxes: Float64) -> Bools:
    """Which hands (E,) have a point in one of their boxes (B, 2, 3), hand frame."""
    columns, R, t = hands
    sphere, hit, solid = _blocks(columns), np.zeros(len(R), np.bool_), boxes.astype(np.float32)
    least, most = solid[0]
    for low, high in solid:
        least, most = np.minimum(least, low), np.maximum(most, high)
    for e in range(len(R)):
        for k in range(len(sphere)):
            if not _may_reach(sphere[k], R[e], t[e], least, most):
                continue
            inside = 0
            for b in range(len(solid)):
                low, high = solid[b, 0], solid[b, 1]
                if _may_reach(sphere[k], R[e], t[e], low, high):
                    inside += _count_between(columns, k, R[e], t[e], low, high)
            if inside:
                hit[e] = True
                break
    return hit


@compiled("contract")
def any_point_swept(hands: InHands, boxes: Float64, lift: Float32) -> Bools:
    """Like `any_point_in_boxes`, for hands that move along `lift` (E, 3), in their own frames."""
    columns, R, t = hands
    sphere, hit, solid = _blocks(columns), np.zeros(len(R), np.bool_), boxes.astype(np.float32)
    none = np.float32(0.0)
    for e in range(len(R)):
        below, above = np.minimum(lift[e], none), np.maximum(lift[e], none)
        per_way = np.float32(1.0) / np.where(np.abs(lift[e]) < SLACK, np.float32(SLACK), lift[e])
        for b in range(len(solid)):
            low, high = solid[b]
            for k in range(len(sphere)):
                near = _may_reach(sphere[k], R[e], t[e], low + below, high + above)
                if near and _count_on_way(columns, k, R[e], t[e], solid[b], per_way):
                    hit[e] = True
                    break
            if hit[e]:
                break
    return hit


@compiled("contract", "nnan", "nsz", "reassoc")
def signed_distance_to_boxes(hands: InHands, boxes: Float64) -> Float32:
    """Least signed distance (E,) of the points to the boxes (B, 2, 3) of each hand."""
    columns, R, t = hands
    extents = np.empty(boxes.shape, np.float32)  # middles and halves
    extents[:, 0], extents[:, 1] = (boxes[:, 0] + boxes[:, 1]) / 2, (boxes[:, 1] - boxes[:, 0]) / 2
    sphere, nearest = _blocks(columns), np.full(len(R), np.inf, np.float32)
    for e in range(len(R)):
        for k in range(len(sphere)):
            block = columns[:, k * BLOCK_SIZE : (k + 1) * BLOCK_SIZE]
            for b in range(len(extents)):
                middle = sphere[k : k + 1, :3].T
                least = _nearest_to_box(middle, R[e], t[e], extents[b]) - sphere[k, 3]
                if least < nearest[e]:
                    here = _nearest_to_box(block, R[e], t[e], extents[b])
                    nearest[e] = min(nearest[e], here)
    return nearest


@compiled("contract")
def free_reach(hands: InHands, boxes: Float64, behind: float, least: float, most: float) -> Float32:
    """How far (E,) hands can move along their z until a box has a point right ahead, metres.

    The hand's boxes are (B, 2, 3); points up to `behind` metres behind a box are in its way too.
    Negative where a hand would have to move back; at most `most`, where nothing nearer is ahead.
    A value below `least` is only an upper bound.
    """
    columns, R, t = hands
    sphere, way, solid = _blocks(columns), np.empty(len(R), np.float32), boxes.astype(np.float32)
    ahead = np.empty(BLOCK_SIZE, np.float32)
    for e in range(len(R)):
        nearest = np.float32(most)
        for b in range(len(solid)):
            if nearest < least:
                break
            box = solid[b].copy()
            low, high = box
            front = high[2]
            low[2] -= np.float32(behind)
            for k in range(len(sphere)):
                high[2] = front + nearest  # farther boxes change nothing
                if _may_reach(sphere[k], R[e], t[e], low, high):
                    found = _least_between(columns, k, R[e], t[e], box, ahead)
                    nearest = min(nearest, found - front)
                    if nearest < least:
                        break
        way[e] = nearest
    return way


@compiled("contract")
def extents_between(hands: InHands, first: Int64, last: Int64, pads: Float32) -> Float32:
    """Least and greatest y (E, 2) of the points between the pads of hands; (inf, -inf) without one.

    Hand e has points first[e] to last[e]; `pads` are least and greatest x and z, hand frame.
    """
    columns, R, t = hands
    (low, high), extent = pads, np.empty((len(R), 2), np.float32)
    for e in range(len(R)):
        xs, ys, zs = columns[:, first[e] : last[e]]
        least, most = np.float32(np.inf), np.float32(-np.inf)
        for i in range(len(xs)):
            x, y, z = _position(xs[i], ys[i], zs[i], R[e], t[e])
            between = (x > low[0]) & (x < high[0]) & (z > low[1]) & (z < high[1])
            least = min(least, y if between else np.float32(np.inf))
            most = max(most, y if between else np.float32(-np.inf))
        extent[e, 0], extent[e, 1] = least, most
    return extent


@compiled("contract")
def non_max_suppression(
    T_cloud_tcp: Float32, order: Int64, near: float, angle: float
) -> tuple[Int64, Int64]:
    """Keep the first of each group of near duplicates in `order` (M,).

    Near duplicates are poses of T_cloud_tcp (E, 4, 4) within `near` metres and `angle` radians of
    each other; a turn by 180 degrees about the approach is ignored. Returns the rows kept, in
    order, and the duplicates dropped.
    """
    kept, dropped = np.zeros((2, len(order)), np.bool_)
    rows, found = np.empty(len(order), np.int64), 0
    xs, ys, zs = np.empty((3, len(order)), np.float32)
    squared, least = np.float32(near**2), _least_likeness(angle)
    for m in range(len(order)):
        row = order[m]
        px, py, pz = T_cloud_tcp[row, :3, 3]
        for k in range(found):
            x, y, z = xs[k] - px, ys[k] - py, zs[k] - pz
            close = x * x + y * y + z * z < squared
            if close and _likeness(T_cloud_tcp[row], T_cloud_tcp[rows[k]]) > least:
                dropped[m] = True
                break
        if not dropped[m]:
            kept[m] = True
            xs[found], ys[found], zs[found], rows[found] = px, py, pz, row
            found += 1
    return order[kept], order[dropped]


@compiled("contract")
def mean_over_similar(
    values: Float32, T_cloud_tcp: Float32, number: Int64, near: float, angle: float
) -> Float32:
    """The mean value (E,), for each hand, of the other similar hands on the same object.

    Similar poses of T_cloud_tcp (E, 4, 4) are within `near` metres and `angle` radians; a turn by
    180 degrees about the approach is ignored. `number` (E,) are the objects. NaN: there is none.
    """
    total, count = np.zeros(len(values)), np.zeros(len(values), np.int64)
    place, mean = T_cloud_tcp[:, :3, 3].copy(), np.empty_like(values)
    squared, least = np.float32(near**2), _least_likeness(angle)
    for i in range(len(values)):
        px, py, pz = place[i]
        for j in range(i):
            x, y, z = place[j, 0] - px, place[j, 1] - py, place[j, 2] - pz
            close = number[i] == number[j] and x * x + y * y + z * z < squared
            if close and _likeness(T_cloud_tcp[i], T_cloud_tcp[j]) > least:
                total[i] += values[j]
                total[j] += values[i]
                count[i] += 1
                count[j] += 1
    for i in range(len(values)):
        mean[i] = total[i] / count[i] if count[i] else np.nan
    return mean


@compiled("contract")
def distance_behind(
    # (2 H + 1, 2 H + 1) metres from the camera in each cell, the middle cell straight ahead; inf
    # where nothing was seen.
    surface: Float32,
    R: Float32,  # (E, 3, 3) from each hand's frame to the camera's: across, down, ahead
    t: Float32,  # (E, 3) of each hand in the camera's frame
    places: Float32,  # (S, 3) hand frame
    cells: np.float32,  # per unit of the tangent
) -> Float32:
    """Metres (E, S) that places of hands lie behind the first surface a camera saw, or 0."""
    behind, half = np.zeros((len(R), len(places)), np.float32), len(surface) // 2
    for e in range(len(R)):
        for s in range(len(places)):
            x, y, z = _position(places[s, 0], places[s, 1], places[s, 2], R[e], t[e])
            ahead = max(z, np.float32(1e-6))
            i, j = np.floor(x / ahead * cells), np.floor(y / ahead * cells)
            if (abs(i) <= half) & (abs(j) <= half):
                first = surface[int(i) + half, int(j) + half]
                behind[e, s] = max(np.sqrt(x * x + y * y + z * z) - first, np.float32(0.0))
    return behind


@compiled("contract")
def _blocks(columns: Float32) -> Float32:
    """Bounding spheres (K, 4) of BLOCK_SIZE points at a time: middle and radius."""
    count = columns.shape[1]
    sphere = np.zeros(((count + BLOCK_SIZE - 1) // BLOCK_SIZE, 4), np.float32)
    for k in range(len(sphere)):
        block = columns[:, k * BLOCK_SIZE : (k + 1) * BLOCK_SIZE]
        furthest = np.float32(0.0)
        for d in range(3):
            sphere[k, d] = (block[d].min() + block[d].max()) / np.float32(2.0)
        for i in range(block.shape[1]):
            x, y = block[0, i] - sphere[k, 0], block[1, i] - sphere[k, 1]
            z = block[2, i] - sphere[k, 2]
            furthest = max(furthest, x * x + y * y + z * z)
        sphere[k, 3] = np.sqrt(furthest) + np.float32(SLACK)
    return sphere


@compiled("contract")
def _may_reach(sphere: Float32, R: Float32, t: Float32, low: Float32, high: Float32) -> bool:
    """Whether a point of a block may lie in a box of the hand frame, given by two corners."""
    x, y, z = _position(sphere[0], sphere[1], sphere[2], R, t)
    r = sphere[3]
    inside: bool = (
        (x + r > low[0])
        & (x - r < high[0])
        & (y + r > low[1])
        & (y - r < high[1])
        & (z + r > low[2])
        & (z - r < high[2])
    )
    return inside


@compiled("contract")
def _position(
    px: np.float32, py: np.float32, pz: np.float32, R: Float32, t: Float32
) -> tuple[np.float32, np.float32, np.float32]:
    return (
        R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0],
        R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1],
        R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2],
    )


@compiled("contract")
def _between(x: np.float32, y: np.float32, z: np.float32, low: Float32, high: Float32) -> bool:
    inside: bool = (
        (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])
    )
    return inside


@compiled("contract")
def _count_between(
    columns: Float32, k: int, R: Float32, t: Float32, low: Float32, high: Float32
) -> int:
    """How many points of block k lie between two corners of a hand's frame."""
    # Loops in separate functions on contiguous arrays are vectorised to 16 points at a time.
    start, stop = k * BLOCK_SIZE, (k + 1) * BLOCK_SIZE
    xs, ys, zs = columns[0, start:stop], columns[1, start:stop], columns[2, start:stop]
    found = 0
    for i in range(len(xs)):
        x, y, z = _position(xs[i], ys[i], zs[i], R, t)
        found += _between(x, y, z, low, high)
    return found


@compiled("contract")
def _count_on_way(
    columns: Float32, k: int, R: Float32, t: Float32, box: Float32, per_way: Floats
) -> int:
    """How many points of block k a box passes over; `per_way` (3,): 1 / its motion, hand frame."""
    low, high = box[0], box[1]
    start, stop = k * BLOCK_SIZE, (k + 1) * BLOCK_SIZE
    xs, ys, zs = columns[0, start:stop], columns[1, start:stop], columns[2, start:stop]
    found = 0
    for i in range(len(xs)):
        x, y, z = _position(xs[i], ys[i], zs[i], R, t)
        # Shares of the way at which the point enters and leaves the box along each axis.
        x0, x1 = (x - high[0]) * per_way[0], (x - low[0]) * per_way[0]
        y0, y1 = (y - high[1]) * per_way[1], (y - low[1]) * per_way[1]
        z0, z1 = (z - high[2]) * per_way[2], (z - low[2]) * per_way[2]
        enter = max(min(x0, x1), min(y0, y1), min(z0, z1), np.float32(0.0))
        leave = min(max(x0, x1), max(y0, y1), max(z0, z1), np.float32(1.0))
        found += enter < leave
    return found


@compiled("contract", "nnan", "nsz", "reassoc")
def _nearest_to_box(columns: Float32, R: Float32, t: Float32, extent: Float32) -> np.float32:
    xs, ys, zs = columns[0], columns[1], columns[2]
    zero = np.float32(0.0)
    middle, half = extent[0], extent[1]
    apart, deepest = np.float32(np.inf), zero  # squared distance outside, depth inside
    for i in range(len(xs)):
        x, y, z = _position(xs[i], ys[i], zs[i], R, t)
        x = abs(x - middle[0]) - half[0]
        y = abs(y - middle[1]) - half[1]
        z = abs(z - middle[2]) - half[2]
        deepest = min(deepest, max(x, y, z))
        x, y, z = max(x, zero), max(y, zero), max(z, zero)
        apart = min(apart, x * x + y * y + z * z)
    return deepest if deepest < zero else np.sqrt(apart)


@compiled("contract")
def _least_between(
    columns: Float32, k: int, R: Float32, t: Float32, box: Float32, ahead: Float32
) -> np.float32:
    """Least z of the points of block k in a box (2, 3); `ahead` (BLOCK_SIZE,) is overwritten."""
    low, high = box[0], box[1]
    start, stop = k * BLOCK_SIZE, (k + 1) * BLOCK_SIZE
    xs, ys, zs = columns[0, start:stop], columns[1, start:stop], columns[2, start:stop]
    for i in range(len(xs)):
        x, y, z = _position(xs[i], ys[i], zs[i], R, t)
        ahead[i] = z if _between(x, y, z, low, high) else np.float32(np.inf)
    least = np.float32(np.inf)
    for i in range(len(xs)):
        least = min(least, ahead[i])
    return least


@compiled("contract")
def _least_likeness(angle: float) -> np.float32:
    """The trace of a rotation by an angle; from 180 degrees on, all hands are similar."""
    return np.float32(1.0 + 2.0 * np.cos(angle) if angle < np.pi else -np.inf)


@compiled("contract")
def _likeness(one: Float32, other: Float32) -> np.float32:
    """Trace of the rotation between two poses; half a turn about z counts as none."""
    x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)  # cosines of matching axes
    for d in range(3):
        x += one[d, 0] * other[d, 0]
        y += one[d, 1] * other[d, 1]
        z += one[d, 2] * other[d, 2]
    return z + abs(x + y)
