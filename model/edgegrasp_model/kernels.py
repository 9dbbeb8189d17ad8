"""Loops over the points of a cloud, compiled to machine code by Numba.

NumPy would need many passes over large arrays; these loops take one point at a time and stay in the
processor's cache.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np

from edgegrasp_camera.arrays import Float32, Float64, Int64

Loop = TypeVar("Loop", bound=Callable[..., Any])

ROUNDING = 1e-4  # share of a squared distance; a generous bound of float32 errors
STRIP_CELLS = 4  # cells of a strip's histogram in the gap that ends it
JACOBI_SWEEPS = 6  # rounds of Jacobi's method for a symmetric 3 x 3 matrix; more change nothing
DIAGONAL = 1e-12  # off-diagonal sum, as a share of the trace, at which Jacobi's method stops


def nearest_in_groups(points: Float32, bounds: Int64, k: int) -> Int64:
    """Rows (P, k) of the k nearest points of the same group, the point itself first.

    Points are (P, 3), group after group, from bounds[g] to bounds[g + 1]; the own row fills up
    small groups.
    """
    nearest = np.empty((len(points), k), dtype=np.int64)
    if len(points):
        _nearest(columns_of(points), bounds, nearest)
    return nearest


def extents_across(
    points: Float32,  # (N, 3) of the cloud
    rows: Int64,  # (P,) of points to look at, group after group
    first: Int64,  # (M,) places in `rows` where the group of each edge begins
    last: Int64,  # (M,) and where they end
    # (M, 4, 3) of each edge the point it is at; across the strip, out of the object along it, and
    # ahead of the hand, unit vectors
    frame: Float32,
    # (4,) its half width and its length, how far ahead of the edge its points may be, and the gap
    # length that ends it, metres
    strip: Float32,
) -> Float32:
    """Least and greatest metres (M, 2) that the surface extends into the object, across an edge."""
    extent = np.zeros((len(frame), 2), dtype=np.float32)
    _along_strips(columns_of(points[rows]), first, last, frame, strip, extent)
    return extent


def level_spread(
    points: Float32,  # (N, 3) of the cloud
    rows: Int64,  # (M,) of the points to look at
    toward: Float32,  # (T, M, 3) unit, toward each viewpoint
    radius: float,  # metres around each point in which others count,
    drop: float,  # and how much lower they may lie, metres
) -> tuple[Float32, Float32, Float32]:
    """How the neighbourhood of each point is distributed, from each viewpoint.

    Returns the direction orthogonal to `toward` in which they spread least, (T, M, 3) unit; how far
    (T, M) the point lies from their mean along it, not negative; their standard deviation (T, M)
    along it, metres.
    """
    cells = np.floor((points - points.min(axis=0)) / np.float32(radius)).astype(np.int64) + 1
    sizes = cells.max(axis=0) + 2
    key = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    order = np.argsort(key, kind="stable")
    least = np.empty(toward.shape, dtype=np.float32)
    offset, deviation = np.empty((2, *toward.shape[:2]), dtype=np.float32)
    _level_spread(
        columns_of(points[order]),
        key[order],
        points[rows],
        key[rows],
        sizes,
        toward,
        np.array([radius, drop], dtype=np.float32),
        least,
        offset,
        deviation,
    )
    return least, offset, deviation


def columns_of(points: Float32) -> Float32:
    """Points (N, 3) as rows x, y, z (3, N)."""
    return np.ascontiguousarray(points.T, dtype=np.float32)


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


@compiled("contract")
def least_spread(points: Float32, rows: Int64) -> Float32:
    """Unit direction (M, 3), either sign, in which points (N, 3) of rows (M, K) spread least."""
    count, direction = rows.shape[1], np.empty((len(rows), 3), np.float32)
    around, spread, axes = np.empty((count, 3)), np.empty((3, 3)), np.empty((3, 3))
    for m in range(len(rows)):
        for d in range(3):
            mean = 0.0
            for k in range(count):
                around[k, d] = points[rows[m, k], d]
                mean += around[k, d]
            for k in range(count):
                around[k, d] -= mean / count
        for i in range(3):
            for j in range(3):
                axes[i, j] = 1.0 if i == j else 0.0
                spread[i, j] = 0.0
                for k in range(count):
                    spread[i, j] += around[k, i] * around[k, j]
        for _ in range(JACOBI_SWEEPS):
            for turn in range(3):
                _rotate_away(spread, axes, turn % 2, 1 if turn == 0 else 2)
            off = abs(spread[0, 1]) + abs(spread[0, 2]) + abs(spread[1, 2])
            if off <= DIAGONAL * (spread[0, 0] + spread[1, 1] + spread[2, 2]):
                break
        least = 0
        for d in range(1, 3):
            least = d if spread[d, d] < spread[least, least] else least
        for d in range(3):
            direction[m, d] = axes[d, least]
    return direction


@compiled("contract")
def _rotate_away(matrix: Float64, axes: Float64, p: int, q: int) -> None:
    """One rotation of Jacobi's method: makes element (p, q) of a symmetric matrix 0."""
    if matrix[p, q] == 0.0:
        return
    ratio = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
    tangent = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
    tangent = tangent if ratio >= 0.0 else -tangent
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(3):
        a, b = matrix[k, p], matrix[k, q]
        matrix[k, p], matrix[k, q] = cosine * a - sine * b, sine * a + cosine * b
    for k in range(3):
        a, b = matrix[p, k], matrix[q, k]
        matrix[p, k], matrix[q, k] = cosine * a - sine * b, sine * a + cosine * b
        a, b = axes[k, p], axes[k, q]
        axes[k, p], axes[k, q] = cosine * a - sine * b, sine * a + cosine * b


@compiled("contract")
def _nearest(columns: Float32, bounds: Int64, nearest: Int64) -> None:
    k = nearest.shape[1]
    largest = np.max(bounds[1:] - bounds[:-1])
    squared = np.empty(largest, np.float32)
    near = np.empty(largest, np.int64)
    best = np.empty(k, np.float64)
    for group in range(len(bounds) - 1):
        start, stop = bounds[group], bounds[group + 1]
        xs, ys, zs = columns[0, start:stop], columns[1, start:stop], columns[2, start:stop]
        best[:] = np.inf
        for i in range(len(xs)):
            px, py, pz = xs[i], ys[i], zs[i]
            # The k nearest of the previous row bound the distance to this row's k nearest.
            step = 0.0
            if i > 0:
                step = np.float64(px - xs[i - 1]) ** 2
                step += np.float64(py - ys[i - 1]) ** 2 + np.float64(pz - zs[i - 1]) ** 2
            limit = np.float32((np.sqrt(best[k - 1]) + np.sqrt(step)) ** 2 * (1.0 + ROUNDING))
            for j in range(len(xs)):
                x, y, z = xs[j] - px, ys[j] - py, zs[j] - pz
                squared[j] = x * x + y * y + z * z
            found = 0
            for j in range(len(xs)):
                near[found] = j
                found += squared[j] <= limit
            mine = nearest[start + i]
            mine[:] = start + i
            best[:] = np.inf
            for c in range(found):
                j = near[c]
                x = np.float64(xs[j]) - np.float64(px)
                y = np.float64(ys[j]) - np.float64(py)
                z = np.float64(zs[j]) - np.float64(pz)
                here = x * x + y * y + z * z
                if here < best[k - 1]:
                    place = k - 1
                    while place > 0 and best[place - 1] > here:
                        best[place], mine[place] = best[place - 1], mine[place - 1]
                        place -= 1
                    best[place], mine[place] = here, start + j


@compiled("contract")
def _along_strips(
    columns: Float32,
    first: Int64,
    last: Int64,
    frame: Float32,
    strip: Float32,
    extent: Float32,
) -> None:
    length, gap = strip[1], strip[3]
    cell = gap / STRIP_CELLS
    cells = int(np.ceil((length + gap) / cell)) + 1
    reached = np.empty(cells, np.float32)
    depth = np.empty(np.max(last - first) if len(first) else 0, np.float32)
    for m in range(len(frame)):
        _into_strip(columns, first[m], last[m], frame[m], strip, depth)
        reached[:] = -np.inf
        least, found = np.float32(0.0), 0
        for i in range(last[m] - first[m]):
            depth[found] = depth[i]
            found += depth[i] < length
        for inward in depth[:found]:
            least = min(least, inward)
            place = int((inward + gap) / cell)
            reached[place] = max(reached[place], inward)
        furthest = np.float32(0.0)
        for place in range(int(gap / cell), cells):
            if reached[place] > furthest:
                if reached[place] - furthest > gap:
                    break
                furthest = reached[place]
        extent[m, 0], extent[m, 1] = least, furthest


@compiled("contract")
def _into_strip(
    columns: Float32, first: int, last: int, frame: Float32, strip: Float32, depth: Float32
) -> None:
    """Distance of a group's points into the object; the strip's length for points outside of it."""
    # As separate functions on contiguous arrays, such loops are vectorised to 16 points at a time.
    xs, ys, zs = columns[0, first:last], columns[1, first:last], columns[2, first:last]
    origin, across, out, ahead = frame[0], frame[1], frame[2], frame[3]
    half, length, drop, gap = strip[0], strip[1], strip[2], strip[3]
    for i in range(len(xs)):
        x, y, z = xs[i] - origin[0], ys[i] - origin[1], zs[i] - origin[2]
        sideways = x * across[0] + y * across[1] + z * across[2]
        inward = -(x * out[0] + y * out[1] + z * out[2])
        below = x * ahead[0] + y * ahead[1] + z * ahead[2]
        inside = (abs(sideways) < half) & (below < drop) & (inward > -gap)
        depth[i] = inward if inside else length


@compiled("contract")
def _level_spread(
    columns: Float32,
    key: Int64,
    middle: Float32,
    middle_key: Int64,
    sizes: Int64,
    toward: Float32,
    reach: Float32,
    least: Float32,
    offset: Float32,
    deviation: Float32,
) -> None:
    around, axes = np.empty(columns.shape, np.float32), np.zeros((3, 3), np.float32)
    for m in range(len(middle)):
        found = 0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                start = middle_key[m] + (dx * sizes[1] + dy) * sizes[2] - 1
                for j in range(np.searchsorted(key, start), np.searchsorted(key, start + 3)):
                    around[0, found] = columns[0, j]
                    around[1, found] = columns[1, j]
                    around[2, found] = columns[2, j]
                    found += 1
        near = around[0, :found], around[1, :found], around[2, :found]
        for way in range(len(toward)):
            _set_level_axes(toward[way, m], axes)
            count, a, b, aa, ab, bb = _moments(near, middle[m], axes, reach)
            a, b = a / count, b / count
            aa, ab, bb = aa / count - a * a, ab / count - a * b, bb / count - b * b
            turn = 0.5 * np.arctan2(-2.0 * ab, bb - aa)
            s, t = np.cos(turn), np.sin(turn)  # the direction of least variance
            outward = -(a * s + b * t)
            if outward < 0.0:
                s, t, outward = -s, -t, -outward
            for d in range(3):
                least[way, m, d] = s * axes[1, d] + t * axes[2, d]
            offset[way, m] = outward
            deviation[way, m] = np.sqrt(max(0.0, s * s * aa + 2.0 * s * t * ab + t * t * bb))


@compiled("contract")
def _set_level_axes(up: Float32, axes: Float32) -> None:
    """Up and two level directions, from the axis that is farthest from up."""
    first = 0
    for d in range(1, 3):
        first = d if abs(up[d]) < abs(up[first]) else first
    after, last = (first + 1) % 3, (first + 2) % 3
    length = np.sqrt(up[after] * up[after] + up[last] * up[last])
    for d in range(3):
        axes[0, d] = up[d]
    axes[1, first], axes[1, after], axes[1, last] = 0.0, -up[last] / length, up[after] / length
    for d in range(3):
        one, other = (d + 1) % 3, (d + 2) % 3
        axes[2, d] = up[one] * axes[1, other] - up[other] * axes[1, one]


@compiled("contract", "reassoc", "nsz")
def _moments(
    points: tuple[Float32, Float32, Float32], middle: Float32, axes: Float32, reach: Float32
) -> tuple[np.float32, ...]:
    """How many points are near, and the sums of their level coordinates s, t, s s, s t and t t."""
    count, a, b, aa, ab, bb = np.zeros(6, np.float32)
    xs, ys, zs = points
    for i in range(len(xs)):
        x, y, z = xs[i] - middle[0], ys[i] - middle[1], zs[i] - middle[2]
        above = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2] > -reach[1]
        near = above & (x * x + y * y + z * z < reach[0] * reach[0])
        one = np.float32(near)
        s = one * (x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2])
        t = one * (x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2])
        a, b, aa, ab, bb = a + s, b + t, aa + s * s, ab + s * t, bb + t * t
        count += one
    return count, a, b, aa, ab, bb
