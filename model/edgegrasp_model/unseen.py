"""Space around a hand that no camera saw, and the visible extent of objects."""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats, Int64
from edgegrasp_model.gripper import APPROACH_LENGTH, Gripper
from edgegrasp_model.kernels import compiled, distance_behind

MAP_CELL = 0.0022  # metres across a cell of the depth map, at the middle of the cloud
SPLAT = 2  # cells around its own that a point covers, to fill the gaps to the next points
THICKNESS = 0.004  # metres behind a surface that still count as the surface
UNKNOWN_DEPTH = 0.02  # metres beyond THICKNESS at which space counts as fully unknown
MAX_UNSEEN_DEPTH = 0.10  # metres behind a surface; distances are clipped here
UNKNOWN_SHARE = 0.25  # unseen share of a hand part's swept space, from which the hand collides
HAND_SLICES = 9  # of the hand, along y
OUTSIDE_SHARE = 0.5  # share of a slice's swept space, from which a hand reaches out of the image
PLACES = 27  # places on the closing line, from beyond one finger to beyond the other
NO_SURFACE = np.float32(np.inf)
MIN_AHEAD = 0.2  # cosine to the middle of the map, from which a reading counts for an outline
HAND_CELLS = 50  # cells of the map beyond the points, for several cameras: a hand opens less
MIN_UP_SINE = 1e-3  # sine of the angle to up below which up cannot orient the map
HALF_MAP_CELLS = 640  # most cells from the middle of the map to its edge: some 1.4 m
FAR_CELL = 10 * HALF_MAP_CELLS  # stands for everything beyond
NUM_EXTENTS = 11
EXTENT_POINTS = 256  # most points of an object that its extents are measured with
MAX_EXTENT = 0.25  # metres; extents are clipped here


class UnseenSpace(NamedTuple):
    """Unseen parts of E hands and of the space around them; the finger at +y is first."""

    parts: list[Float32]  # (E,) each: the unseen share of each of `probes`
    ways: list[Float32]  # (E,) each: unseen share of the space a finger sweeps on the approach
    depths: list[Float32]  # (E,) each: metres that each fingertip is behind a surface
    beyond: list[Float32]  # (E,) each: unseen metres outward from what each finger touches first
    free: Float32  # (E,) metres of empty space between what the two fingers touch first


def unseen_space(
    depths: Sequence["DepthMap"], T_cloud_hand: Float32, first_touch: Float32, gripper: Gripper
) -> UnseenSpace:
    """Evaluate the cameras' depth maps at the hands of candidates, (E, 4, 4) in the maps' frame.

    Without maps, where the cameras are unknown, everything counts as seen. `first_touch` is (E, 2)
    greatest and least y of the points between the fingers of the open gripper, hand frame.
    """
    if not depths:
        nothing = np.zeros(len(T_cloud_hand), dtype=np.float32)
        both = [nothing, nothing]
        return UnseenSpace([nothing] * len(probes(gripper)), both, both, both, nothing)
    parts, ways, (y, line) = probes(gripper), _ways(gripper), _closing_line(gripper)
    places = [*parts, *ways, line]
    ends = np.cumsum([len(place) for place in places])[:-1]
    behind = np.split(_behind(depths, T_cloud_hand, np.concatenate(places)), ends, axis=1)
    shares = [unseen(part).mean(axis=1) for part in behind[:-1]]
    tips = [np.minimum(part, MAX_UNSEEN_DEPTH).mean(axis=1) for part in behind[:2]]
    along = behind[-1].reshape(len(T_cloud_hand), PLACES, len(line) // PLACES)  # (E, Y, P)
    step, high, low = y[1] - y[0], first_touch[:, :1], first_touch[:, 1:]
    hidden = unseen(along).mean(axis=2)  # (E, Y)
    seen = (along < THICKNESS).all(axis=2)
    return UnseenSpace(
        parts=shares[: len(parts)],
        ways=shares[len(parts) :],
        depths=tips,
        beyond=[step * (hidden * side).sum(axis=1) for side in (y > high, y < low)],
        free=step * (seen * ((y > low + THICKNESS) & (y < high - THICKNESS))).sum(axis=1),
    )


def enters_unseen(
    depths: Sequence["DepthMap"], T_cloud_hand: Float32, gripper: Gripper, length: float
) -> Bools:
    """Which hands (E,) enter unseen space on an approach of `length` metres.

    The ends of the fingers may.
    """
    entered = np.zeros(len(T_cloud_hand), dtype=np.bool_)
    for places in (*_palm_ways(gripper, length), *_ways(gripper, length)) if depths else ():
        left = np.flatnonzero(~entered)
        behind = _behind(depths, T_cloud_hand[left], places)
        entered[left] = unseen(behind).mean(axis=1) > UNKNOWN_SHARE
    return entered


def _behind(depths: Sequence["DepthMap"], T_cloud_hand: Float32, places: Float32) -> Float32:
    """Metres (E, S) behind a surface for the camera that sees most; 0 if no image contains it."""
    nearest: Float32 = np.min([depth.behind(T_cloud_hand, places) for depth in depths], axis=0)
    nearest[np.isinf(nearest)] = 0.0
    return nearest


def leaves_image(
    P_image_cloud: Float64,  # (3, 4) as in `Scene`
    T_cloud_hand: Float32,  # (E, 4, 4)
    gripper: Gripper,
) -> Bools:
    """Which hands (E,) reach out of the image on the approach, into unknown surroundings."""
    places = np.stack(_palm_ways(gripper))  # (slices, S, 3)
    P_image_hand = P_image_cloud @ T_cloud_hand.astype(np.float64)  # (E, 3, 4)
    # Most hands have even the corners of the box around these points inside the image.
    sides = zip(places.min(axis=(0, 1)), places.max(axis=(0, 1)), strict=True)
    corners = np.array(list(product(*sides)))
    leaves: Bools = np.asarray(_outside_image(P_image_hand, corners).any(axis=1))
    outside = _outside_image(P_image_hand[leaves], places.reshape(-1, 3))
    shares = outside.reshape(-1, *places.shape[:2]).mean(axis=2)
    leaves[leaves] = shares.max(axis=1) > OUTSIDE_SHARE
    return leaves


def _outside_image(P_image_hand: Float64, points: Floats) -> Bools:
    """Which points (S, 3) of hands project beyond the image, (E, S), by (E, 3, 4) matrices."""
    seen = P_image_hand[:, :, :3] @ points.T + P_image_hand[:, :, 3:]
    return np.asarray((np.abs(seen[:, :2]) > seen[:, 2:]).any(axis=1))


def unseen(behind: Float32) -> Float32:
    """How unknown space is, by its distance (...) behind the first surface: 0 seen, 1 unknown."""
    return np.asarray(np.clip((behind - THICKNESS) / UNKNOWN_DEPTH, 0.0, 1.0))


@lru_cache(maxsize=16)
def probes(gripper: Gripper) -> list[Float32]:
    """Points of each part of the open hand, and of the space around it; hand frame, metres.

    Tips and roots of both fingers, what is beyond each of them, the space between the fingers in
    three layers, and the hand itself: each (S, 3).
    """
    half, inner = gripper.pad_half_width, gripper.max_opening / 2
    tip, palm = gripper.tip_z, gripper.seen_palm_z
    thick = gripper.finger_thickness / 2
    middle, x = (tip + palm) / 2, [-0.7 * half, 0.7 * half]
    fingers = [
        _grid(x, side * (inner + np.array([0.3, 1.4]) * thick), np.linspace(low, high, 4)[1:])
        for low, high in ((middle, tip), (palm, middle))
        for side in (1.0, -1.0)
    ]
    beyond = [
        _grid([0.0], [side * (inner + thick)], [tip + 0.006, tip + 0.012]) for side in (1.0, -1.0)
    ]
    between = [
        _grid(x, inner * np.array(layer), np.linspace(palm, tip, 5)[1:])
        for layer in ([0.5, 0.85], [-0.25, 0.25], [-0.85, -0.5])
    ]
    inside = [
        _grid(*(np.linspace(*ends)[1:-1] for ends in zip(*box, (4, 7, 4), strict=True)))
        for box in gripper.hand.boxes
    ]
    return [*fingers, *beyond, *between, np.concatenate(inside)]


@lru_cache(maxsize=16)
def _ways(gripper: Gripper, length: float = APPROACH_LENGTH) -> list[Float32]:
    """Points of the space that each finger sweeps behind its final position: each (S, 3)."""
    half, inner = gripper.pad_half_width, gripper.max_opening / 2
    root = min(low[2] for low, _ in gripper.finger.boxes)
    thick = gripper.finger_thickness
    x, z = [-0.7 * half, 0.7 * half], root - np.linspace(0.0, length, 5)[1:]
    return [_grid(x, side * (inner + np.array([0.15, 0.7]) * thick), z) for side in (1.0, -1.0)]


@lru_cache(maxsize=16)
def _palm_ways(gripper: Gripper, length: float = APPROACH_LENGTH) -> list[Float32]:
    """Points of the space that slices of the hand sweep, from end to end: each (S, 3)."""
    slices = []
    for low, high in gripper.hand.boxes:
        x = (low[0] + high[0]) / 2 + 0.3 * (high[0] - low[0]) * np.array([-1.0, 1.0])
        z = np.linspace(low[2] - length, high[2], 7)[:-1]
        slices += [_grid(x, [y], z) for y in np.linspace(low[1], high[1], HAND_SLICES)]
    return slices


@lru_cache(maxsize=16)
def _closing_line(gripper: Gripper) -> tuple[Float32, Float32]:
    """The y (PLACES,) of places from beyond one finger to beyond the other, and points at each."""
    half, length = gripper.pad_half_width, gripper.tip_z - gripper.seen_palm_z
    end = gripper.max_opening / 2 + gripper.finger_thickness
    y = np.linspace(-end, end, PLACES, dtype=np.float32)
    across = _grid([-0.5 * half, 0.5 * half], [0.0], gripper.tip_z - np.array([0.1, 0.3]) * length)
    line = across + y[:, None, None] * np.array([0.0, 1.0, 0.0], dtype=np.float32)
    return y, line.reshape(-1, 3)


def _grid(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Float32:
    """All points (X * Y * Z, 3) with these coordinates."""
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid.astype(np.float32)


def visible_extents(
    points: Float32,  # (N, 3)
    number: Int64,  # (N,) the object of each point
    contact_index: Int64,  # (E,) rows of `points`: the object of that point is measured
    T_cloud_hand: Float32,  # (E, 4, 4) hands
    side: Float32,  # (E,) 1 or -1, the factor on x
    gripper: Gripper,  # fingers open to its maximum
    up: Float32,  # (3,) away from gravity
) -> Float32:
    """The visible size of the object between the fingers, and how far it extends beyond them.

    Metres (E, NUM_EXTENTS): beyond each finger, of the whole object, then of its part in front of
    the palm that is within a strip three pads wide; along x and -x; ahead of the tips, behind the
    palm; length, width, height.
    """
    labels, groups = np.unique(number[contact_index], return_inverse=True)
    vertical = np.asarray(up, dtype=np.float64) / np.linalg.norm(np.asarray(up, dtype=np.float64))
    parts, sizes = [], np.zeros((len(labels), 3), dtype=np.float32)
    for row, label in enumerate(labels):
        part = points[number == label]
        part = part[:: -(-len(part) // EXTENT_POINTS)]
        parts.append(part)
        exact = part.astype(np.float64)
        height = exact @ vertical
        flat = exact - exact.mean(axis=0) - (height - height.mean())[:, None] * vertical
        spread = np.linalg.eigvalsh(flat.T @ flat / len(flat))  # ascending; the first is along up
        # Length and width of an evenly filled rectangle with this variance, and the points' height.
        sizes[row, :2] = np.sqrt(12.0 * np.maximum(spread[:0:-1], 0.0))
        sizes[row, 2] = np.ptp(height)
    if len(labels) == 0:
        return np.zeros((len(T_cloud_hand), NUM_EXTENTS), dtype=np.float32)
    bounds = np.cumsum([0, *map(len, parts)])
    inner, half = gripper.max_opening / 2, 3 * gripper.pad_half_width
    limits = np.array([inner, half, gripper.seen_palm_z, gripper.tip_z], dtype=np.float32)
    group = groups.reshape(-1).astype(np.int64)
    extents = _extents(np.concatenate(parts), bounds, group, T_cloud_hand, side, limits)
    extents[:, -3:] = sizes[group]
    return np.clip(extents, -MAX_EXTENT, MAX_EXTENT, out=extents)


@compiled("contract")
def _extents(
    points: Float32,
    bounds: Int64,
    group: Int64,
    T_cloud_hand: Float32,
    side: Float32,
    limits: Float32,
) -> Float32:
    """All columns but the last three, which stay 0; objects begin and end at `bounds`."""
    inner, half, palm, tip = limits
    extents = np.zeros((len(group), NUM_EXTENTS), np.float32)
    for e in range(len(group)):
        T = T_cloud_hand[e]
        low_x = low_y = low_z = np.float32(np.inf)
        high_x = high_y = high_z = np.float32(-np.inf)
        low, high = np.float32(0.0), np.float32(0.0)
        for i in range(bounds[group[e]], bounds[group[e] + 1]):
            a, b, c = points[i, 0] - T[0, 3], points[i, 1] - T[1, 3], points[i, 2] - T[2, 3]
            x = side[e] * (a * T[0, 0] + b * T[1, 0] + c * T[2, 0])
            y = a * T[0, 1] + b * T[1, 1] + c * T[2, 1]
            z = a * T[0, 2] + b * T[1, 2] + c * T[2, 2]
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
            low_z, high_z = min(low_z, z), max(high_z, z)
            if abs(x) < half and z > palm:
                low, high = min(low, y), max(high, y)
        extents[e, 0], extents[e, 1] = high_y - inner, -low_y - inner
        extents[e, 2], extents[e, 3] = high - inner, -low - inner
        extents[e, 4], extents[e, 5] = high_x, -low_x
        extents[e, 6], extents[e, 7] = high_z - tip, palm - low_z
    return extents


class DepthMap(NamedTuple):
    """Distance of the first surface in each direction from a camera."""

    viewpoint: Float32  # (3,)
    axes: Float32  # (3, 3) rows: across, down, toward the middle of the cloud
    cell: float  # tangent of the angle of a cell
    # (2 H + 1, 2 H + 1) metres from the camera; inf where nothing was seen, -inf outside its image
    distance: Float32

    @classmethod
    def of_cloud(
        cls, points: Float32, viewpoint: Float32, up: Float32, own: Float32 | None = None
    ) -> Self:
        """The depth map of points (N, 3), metres, from a camera; `up` fixes its roll.

        `own` (M, 3) are this camera's readings if there are several cameras: they show its image.
        """
        way = points.mean(axis=0, dtype=np.float64) - viewpoint.astype(np.float64)
        away = max(float(np.linalg.norm(way)), 1e-6)
        ahead = way / away
        across = np.cross(ahead, np.asarray(up, dtype=np.float64))
        if np.linalg.norm(across) < MIN_UP_SINE * np.linalg.norm(up):  # seen from straight above
            across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(ahead, across), ahead]).astype(np.float32)
        along = (points - viewpoint) @ axes.T  # (N, 3)
        tangents = along[:, :2] / np.maximum(along[:, 2:], np.float32(1e-6))
        cell = np.clip(np.floor(tangents / np.float32(MAP_CELL / away)), -FAR_CELL, FAR_CELL)
        margin = SPLAT if own is None else HAND_CELLS
        half = min(int(np.abs(cell).max()) + margin, HALF_MAP_CELLS)
        depth = np.full((2 * half + 1, 2 * half + 1), NO_SURFACE)
        distance = np.linalg.norm(along, axis=1).astype(np.float32)
        _cover(depth, cell.astype(np.int64) + half, distance)
        if own is not None:
            middles = (np.arange(-half, half + 1) + 0.5) * (MAP_CELL / away)
            depth[_outside_own((own - viewpoint) @ axes.T, middles)] = -NO_SURFACE
        return cls(viewpoint, axes, MAP_CELL / away, depth)

    def behind(self, T_cloud_hand: Float32, places: Float32) -> Float32:
        """Metres (E, S) that places (S, 3) of hands (E, 4, 4) lie behind a surface, or 0."""
        turn = np.ascontiguousarray(self.axes @ T_cloud_hand[:, :3, :3], dtype=np.float32)
        shift = ((T_cloud_hand[:, :3, 3] - self.viewpoint) @ self.axes.T).astype(np.float32)
        return distance_behind(self.distance, turn, shift, places, np.float32(1.0 / self.cell))


def _outside_own(sight: Floats, tangents: Floats) -> Bools:
    """Which directions (K, K), of tangents (K,) across and down, a camera's image does not contain.

    Its image is the convex outline of its readings (M, 3), along the axes of the map.
    """
    ahead = sight[sight[:, 2] > MIN_AHEAD * np.linalg.norm(sight, axis=1)].astype(np.float64)
    try:
        a, b, c = ConvexHull(ahead[:, :2] / ahead[:, 2:]).equations.T  # inside: a x + b y + c <= 0
    except (QhullError, ValueError):  # too few readings, or all on a line
        return np.ones((len(tangents), len(tangents)), dtype=np.bool_)
    b[b == 0.0] = 1e-12
    bound = -(np.multiply.outer(tangents, a) + c) / b
    low = np.where(b < 0.0, bound, -np.inf).max(axis=1, keepdims=True)
    high = np.where(b > 0.0, bound, np.inf).min(axis=1, keepdims=True)
    return np.asarray((tangents < low) | (tangents > high))


@compiled()
def _cover(depth: Float32, cell: Int64, distance: Float32) -> None:
    """Write distances (N,) into the cells around each point's cell (N, 2), keeping the nearest."""
    for n in range(len(cell)):
        for i in range(max(cell[n, 0] - SPLAT, 0), min(cell[n, 0] + SPLAT + 1, len(depth))):
            for j in range(max(cell[n, 1] - SPLAT, 0), min(cell[n, 1] + SPLAT + 1, len(depth))):
                depth[i, j] = min(depth[i, j], distance[n])
