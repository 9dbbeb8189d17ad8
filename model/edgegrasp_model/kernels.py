"""Loops over the points of a cloud, compiled to machine code by Numba.

NumPy needs many passes over large arrays for these; here each takes one hand or one point at a
time, in the processor's cache.
"""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

ROUNDING = 1e-4  # share of a squared distance that float32 may be off, many times over
BLOCK = 512  # points at a time, so that their positions stay in the first cache


def points_in_hand_boxes(
    points: Float32, T_cloud_hand: Float32, low: Float32, high: Float32
) -> tuple[Int64, Int64, Float32]:
    """Points between two corners of hand frames.

    Args:
        points: (N, 3) of the cloud.
        T_cloud_hand: (E, 4, 4).
        low: (3,) corner, hand frame, metres.
        high: (3,) corner.

    Returns:
        Hand (P,) ascending, row (P,) ascending within each, position (P, 3) in its frame.
    """
    columns, turn, shift = _columns(points), *_to_hand(T_cloud_hand)
    count = np.empty(len(turn), dtype=np.int64)
    _count_within(columns, turn, shift, low, high, count)
    hand = np.repeat(np.arange(len(turn)), count)
    row = np.empty(len(hand), dtype=np.int64)
    position = np.empty((len(hand), 3), dtype=np.float32)
    _fill_within(columns, turn, shift, low, high, np.cumsum(count) - count, row, position)
    return hand, row, position


def any_point_in_boxes(points: Float32, T_cloud_hand: Float32, boxes: Float64) -> Bools:
    """Which hands (E,) have a point (N, 3) in one of their boxes (B, 2, 3), hand frame."""
    turn, shift = _to_hand(T_cloud_hand)
    hit = np.zeros(len(turn), dtype=np.bool_)
    _meet(_columns(points), turn, shift, boxes.astype(np.float32), hit)
    return hit


def signed_distance_to_boxes(points: Float32, T_cloud_hand: Float32, boxes: Float64) -> Float32:
    """Signed distance (E,) of points (N, 3) to the boxes (B, 2, 3) of each hand, the least."""
    turn, shift = _to_hand(T_cloud_hand)
    middle, half = boxes.mean(axis=1), (boxes[:, 1] - boxes[:, 0]) / 2
    nearest = np.full(len(turn), np.inf, dtype=np.float32)
    extents = np.stack((middle, half), axis=1).astype(np.float32)
    _nearest_to_boxes(_columns(points), turn, shift, extents, nearest)
    return nearest


def nearest_in_groups(points: Float32, bounds: Int64, k: int) -> Int64:
    """The k nearest points of the same group, nearest first; the own row fills up small groups.

    Args:
        points: (P, 3), group after group.
        bounds: (G + 1,) where each group begins, and the last ends.
        k: How many, the point itself included.

    Returns:
        (P, k) rows of `points`.
    """
    nearest = np.empty((len(points), k), dtype=np.int64)
    if len(points):
        _nearest(_columns(points), bounds, nearest)
    return nearest


def _columns(points: Float32) -> Float32:
    return np.ascontiguousarray(points.T, dtype=np.float32)  # (3, N)


def _to_hand(T_cloud_hand: Float32) -> tuple[Float32, Float32]:
    """Turn (E, 3, 3) and shift (E, 3) from the cloud's frame to hand frames."""
    turn = np.ascontiguousarray(T_cloud_hand[:, :3, :3].transpose(0, 2, 1))
    return turn, -(turn @ T_cloud_hand[:, :3, 3:])[:, :, 0]


def compiled(*freedom: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function when it is first called, and keep it on disk where that is possible.

    Args:
        freedom: What the compiler may change in float arithmetic, LLVM's fast-math flags.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": set(freedom)}

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            kept: Callable[..., Any] = numba.njit(cache=True, **options)(function)
            return kept
        except RuntimeError:  # no folder to keep it in: neither beside the file nor the user's own
            fresh: Callable[..., Any] = numba.njit(**options)(function)
            return fresh

    return decorate


@compiled("contract")
def _position(
    px: np.float32, py: np.float32, pz: np.float32, turn: Float32, shift: Float32
) -> tuple[np.float32, np.float32, np.float32]:
    return (
        turn[0, 0] * px + turn[0, 1] * py + turn[0, 2] * pz + shift[0],
        turn[1, 0] * px + turn[1, 1] * py + turn[1, 2] * pz + shift[1],
        turn[2, 0] * px + turn[2, 1] * py + turn[2, 2] * pz + shift[2],
    )


@compiled("contract")
def _between(x: np.float32, y: np.float32, z: np.float32, low: Float32, high: Float32) -> bool:
    inside: bool = (
        (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])
    )
    return inside


@compiled("contract")
def _count_within(
    columns: Float32, turn: Float32, shift: Float32, low: Float32, high: Float32, count: Int64
) -> None:
    xs, ys, zs = columns[0], columns[1], columns[2]
    for e in range(len(turn)):
        found = 0
        for i in range(len(xs)):
            x, y, z = _position(xs[i], ys[i], zs[i], turn[e], shift[e])
            found += _between(x, y, z, low, high)
        count[e] = found


@compiled("contract")
def _fill_within(
    columns: Float32,
    turn: Float32,
    shift: Float32,
    low: Float32,
    high: Float32,
    first: Int64,
    row: Int64,
    position: Float32,
) -> None:
    xs, ys, zs = columns[0], columns[1], columns[2]
    for e in range(len(turn)):
        place = first[e]
        for i in range(len(xs)):
            x, y, z = _position(xs[i], ys[i], zs[i], turn[e], shift[e])
            if _between(x, y, z, low, high):
                row[place] = i
                position[place, 0], position[place, 1], position[place, 2] = x, y, z
                place += 1


@compiled("contract")
def _meet(columns: Float32, turn: Float32, shift: Float32, boxes: Float32, hit: Bools) -> None:
    count = columns.shape[1]
    xh, yh, zh = (
        np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.float32),
    )
    for e in range(len(turn)):
        for start in range(0, count, BLOCK):
            block = columns[:, start : start + BLOCK]
            xs, ys, zs = block[0], block[1], block[2]
            for i in range(len(xs)):
                xh[i], yh[i], zh[i] = _position(xs[i], ys[i], zs[i], turn[e], shift[e])
            inside = 0
            for b in range(len(boxes)):
                low, high = boxes[b, 0], boxes[b, 1]
                for i in range(len(xs)):
                    inside += _between(xh[i], yh[i], zh[i], low, high)
            if inside:
                hit[e] = True
                break


@compiled("contract", "nnan", "nsz", "reassoc")
def _nearest_to_boxes(
    columns: Float32, turn: Float32, shift: Float32, extents: Float32, nearest: Float32
) -> None:
    xs, ys, zs = columns[0], columns[1], columns[2]
    zero = np.float32(0.0)
    for e in range(len(turn)):
        for b in range(len(extents)):
            middle, half = extents[b, 0], extents[b, 1]
            apart, deepest = np.float32(np.inf), zero  # squared distance outside, depth inside
            for i in range(len(xs)):
                x, y, z = _position(xs[i], ys[i], zs[i], turn[e], shift[e])
                x = abs(x - middle[0]) - half[0]
                y = abs(y - middle[1]) - half[1]
                z = abs(z - middle[2]) - half[2]
                deepest = min(deepest, max(x, y, z))
                x, y, z = max(x, zero), max(y, zero), max(z, zero)
                apart = min(apart, x * x + y * y + z * z)
            nearest[e] = min(nearest[e], deepest if deepest < zero else np.sqrt(apart))


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
            # The k nearest of the row before lie at most this far from here: a safe limit.
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
