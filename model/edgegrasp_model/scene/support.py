"""The plane that things stand on: given, or found among the planes of what is seen."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from edgegrasp_model.kernels import heights_and_distances, least_spread
from edgegrasp_model.options import AutoPlane, RansacPlane, SupportPlane
from edgegrasp_model.scene.things import (
    PlaneView,
    find_things,
    number_cells,
    occupied_cells,
    plan_axes,
)

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

THICKNESS = 0.004, 0.006  # metres, and per squared metre of distance, within which a plane holds
MAX_TILT = math.radians(30)  # between a plane that is looked for and an `up` that was sent
SAMPLE = 2000  # points that planes are made of and judged by
NEIGHBORS = 12  # points around one, itself included, that give its normal
JUDGED = 100  # planes that are judged in search of the next one
MAX_PLANES = 8
CROWD_RADIUS = 0.02  # metres around a point in which those neighbours share its surface
SAME_WAY, ROUGHLY_SAME_WAY = 0.9, 0.75  # cosines between a plane's normal and those of its points
REFINEMENTS = 4  # least squares over the plane's points
MIN_SHARE = 0.02  # of the seen surface that a plane holds
VIEW = 12_000  # points that say what stands on a plane
MEASURED = 6_000  # points that say how well a plane agrees with what is seen
CELL = 0.02  # metres
NEAR_BELOW = 0.3  # metres under a plane where a support shows nothing
OUTLINED = 1000  # points of a plane that say how far it goes
MAX_BELOW = 0.5  # share of what is seen at and right under a plane that lies under it
MIN_AREA = 0.03  # square metres of a support that are seen: more than of an object's side
BARE = 0.5  # share of the seen surface from which a small plane is a support with nothing on it
NOTHING_ON_IT = 0.02  # weight of a plane's own points beside those of things
UNUSED = 0.3  # worth of a plane with nothing on it beside one with something
ALIKE = 0.7  # share of the best plane's worth from which another one is a doubt
USUAL_DISTANCE = 0.7  # metres to a camera that is not known
MIN_MARGIN, MAX_MARGIN = 0.004, 0.02  # metres over the plane that still belong to it
GIVEN_MARGIN = 0.005  # metres, over a plane that is given and not seen
DEVIATIONS = 4.0  # of a plane's own points that still belong to it
MAX_BOW = 0.025  # metres by which a support may rise over its plane, as seen
STIFF = 1e-6 * np.eye(6)  # keeps a support flat where too little of it is seen
DECAY = 0.35  # of the heights of what is left of a support, within which half of its points are
TAIL = 5.0  # times as high as half of its points are nearly all
MIN_SEEN = 200  # points of a given plane from which its residual is measured


@dataclass(frozen=True)
class Support:
    """A support plane, and how well what is seen agrees with it; the cloud's frame."""

    plane: SupportPlane
    residual: float  # metres, median distance of its points; NaN where it is not seen
    share: float  # of the seen surface that lies in it
    spread: float  # standard deviation of its points at `distance`, metres; NaN: not seen
    distance: float  # metres from the camera to its points, the median
    least: float  # metres over it that belong to it anyway
    bow: Float64  # (6,) rise over the plane at (x, y): of 1, x, y, x^2, x y, y^2
    axes: Float64  # (4, 3) x and y along the plane, its normal, and an origin on it; cloud frame

    @property
    def normal(self) -> Float64:
        """(3,) unit."""
        return np.asarray(self.axes[2])

    def plan(self, points: NDArray[np.floating]) -> Float64:
        """Places (N, 2) along the plane of points (N, 3), metres."""
        return np.asarray((points - self.axes[3]) @ self.axes[:2].T)

    def heights(self, seen: "Seen") -> tuple[Float32, Float32, Float32]:
        """How high points stand over the support, which may be bowed, and what belongs to it.

        The noise of depth cameras grows with the square of the distance.

        Args:
            seen: N points.

        Returns:
            The height (N,) of each, the height (N,) up to which it belongs to the support, and
            the distance (N,) from the plane within which it may be a point of it; metres.
        """
        eye = seen.viewpoint
        height, squared = heights_and_distances(
            seen.points, self.axes, self.bow, MAX_BOW, self.axes[3] if eye is None else eye
        )
        if eye is None:
            squared = np.full(len(squared), USUAL_DISTANCE**2, dtype=np.float32)
        thick = np.asarray(THICKNESS[0] + THICKNESS[1] * squared)
        if math.isnan(self.spread):
            return height, np.full_like(height, self.least), thick
        grown = np.float32(DEVIATIONS * self.spread / self.distance**2) * squared
        return height, np.clip(grown, self.least, max(MAX_MARGIN, self.least)), thick


class Seen(NamedTuple):
    """N points and from where they were seen."""

    points: Float32  # (N, 3) metres
    viewpoint: Float64 | None  # (3,) the camera, the mean of several; None: unknown
    at_border: Bools | None  # (N,) at the border of the camera's image; None: unknown

    def take(self, rows: NDArray[np.int64]) -> "Seen":
        """Some of the points."""
        border = None if self.at_border is None else self.at_border[rows]
        return Seen(self.points[rows], self.viewpoint, border)

    def thinned(self, count: int) -> "Seen":
        """Every so many-th of the points, at least `count` where there are as many."""
        return self.take(np.arange(0, len(self.points), max(len(self.points) // count, 1)))

    def distance(self) -> Float64:
        """Metres (N,) from the camera."""
        if self.viewpoint is None:
            return np.full(len(self.points), USUAL_DISTANCE)
        apart = self.points - self.viewpoint
        return np.asarray(np.sqrt(np.einsum("nd,nd->n", apart, apart)))


class _Plane(NamedTuple):
    normal: Float64  # (3,) unit, to the side it is seen from
    offset: float
    share: float  # of the seen surface

    def heights(self, points: NDArray[np.floating]) -> Float64:
        heights: Float64 = points @ self.normal - self.offset
        return heights


def thickness(distance: NDArray[np.floating]) -> NDArray[np.floating]:
    """Metres from a plane within which points seen from `distance` (N,) may belong to it."""
    return np.asarray(THICKNESS[0] + THICKNESS[1] * np.square(distance))


def find_support(
    seen: Seen,
    request: AutoPlane | RansacPlane,
    up: Float64 | None,
    max_size: float,
    rng: np.random.Generator,
    warnings: list[str],
) -> Support | None:
    """Find the plane that the things stand on.

    Planes are found one after the other, by RANSAC over points with normals, and turned to the
    camera. The support is not the largest of them but the one with the most things on it; nothing
    is seen through it nor right under it, and it is near.

    Args:
        seen: N points, metres.
        request: `auto`, or the largest plane within a tilt of `up`.
        up: (3,) away from gravity; None: unknown.
        max_size: Longest side of a thing, metres.
        rng: Source of the samples.
        warnings: Gets why there is none, or why it is in doubt.

    Returns:
        The plane; None where nothing seen looks like a support.
    """
    up = None if up is None else up / np.linalg.norm(up)
    planes = _planes(seen, up, rng)
    most = request.max_tilt + 1e-9 if isinstance(request, RansacPlane) else MAX_TILT
    level = [plane for plane in planes if up is None or _tilt(plane, up) <= most]
    if isinstance(request, RansacPlane):
        best = max(level, key=lambda plane: plane.share, default=None)
        best = None if best is None or best.share < request.min_share else best
    else:
        best = _most_stood_on(seen, level, max_size, rng, warnings)
    if best is None:
        warnings.append(_none_found(planes, up))
        return None
    least = request.distance if isinstance(request, RansacPlane) else MIN_MARGIN
    return measured(seen, _as_option(best), least, best.share)


def measured(
    seen: Seen, plane: SupportPlane, least: float = GIVEN_MARGIN, share: float | None = None
) -> Support:
    """A plane, and how well the points agree with it where it is seen.

    Args:
        seen: N points.
        plane: Of the cloud's frame.
        least: Metres over it that belong to it anyway.
        share: Of the seen surface, where it is known.
    """
    sample = seen.thinned(MEASURED)
    points, distance = sample.points.astype(np.float64), sample.distance()
    normal = np.asarray(plane.normal) / np.linalg.norm(plane.normal)
    origin = points.mean(axis=0) if len(points) else np.zeros(3)
    thick = thickness(distance)
    height: Float64 = plane.heights(points).astype(np.float64)
    origin -= float(plane.heights(origin)) * normal
    x, y = plan_axes(normal, seen.viewpoint, points)
    axes = np.stack([x, y, normal, origin])
    near = np.abs(height) < thick
    # Where the cloud was cut off above the plane, only what stands on it is near.
    if near.sum() < MIN_SEEN or (height[near] < 0).mean() < 0.2:
        flat, unknown = np.zeros(6), math.nan
        least = max(least, _left_over((points - origin) @ axes[:2].T, height))
        return Support(plane, unknown, share or 0.0, unknown, USUAL_DISTANCE, least, flat, axes)
    terms = _squares((points - origin) @ axes[:2].T)
    bow: Float64 = np.zeros(6)
    for _ in range(REFINEMENTS):
        near = np.abs(height - bow @ terms) < thick
        held = near * terms
        bow = np.asarray(np.linalg.solve(held @ terms.T + STIFF, held @ height))
    off, apart = np.abs(height - bow @ terms)[near], distance[near]
    middle = float(np.median(apart))
    spread = 1.4826 * float(np.median(off / np.square(apart / middle)))
    found = share or float(near.mean())
    return Support(plane, float(np.median(off)), found, spread, middle, least, bow, axes)


def _left_over(plan: Float64, height: Float64) -> float:
    """How high noise takes points (N, 2), (N,) of a support that was cut off, but not all; metres.

    They become fewer with height, unlike those of flat things.
    """
    over = height > 0
    cell, height = number_cells(plan[over], CELL), height[over]
    top = np.zeros(cell.max(initial=-1) + 1)
    np.maximum.at(top, cell, height)
    bare = height[top[cell] < MAX_MARGIN]
    if np.count_nonzero(top[top > 0] < MAX_MARGIN) * CELL**2 < MIN_AREA:
        return 0.0
    low, middle, high = np.quantile(bare, (0.01, 0.5, 0.99))
    return float(low + TAIL * (middle - low)) if middle - low < DECAY * (high - low) else 0.0


def raised(support: Support, seen: Seen) -> Support:
    """The support moved along its normal to points that lie over it: the floor of a box on it."""
    plane = support.plane
    offset = plane.offset + float(np.median(plane.heights(seen.points)))
    return measured(seen, plane.model_copy(update={"offset": offset}), MIN_MARGIN, support.share)


def _squares(plan: Float64) -> Float64:
    """1, x, y, x^2, x y, y^2 (6, N) of points (N, 2)."""
    x, y = plan.T
    return np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y])


def _planes(seen: Seen, up: Float64 | None, rng: np.random.Generator) -> list[_Plane]:
    """The planes of what is seen, the largest first, each turned to where it is seen from."""
    if len(seen.points) < NEIGHBORS:
        return []
    size = len(seen.points)
    rows = rng.choice(size, min(SAMPLE, size), replace=False, shuffle=False)
    sample = seen.take(rows)
    points = sample.points.astype(np.float64)
    thick = thickness(sample.distance())
    apart, around = cKDTree(points).query(points, k=NEIGHBORS)
    normals = _turned(least_spread(points, np.asarray(around)), points, seen.viewpoint, up)
    # Surfaces near the camera have more points: weigh each point by the surface it stands for.
    weight = 1.0 / (np.asarray(apart) < CROWD_RADIUS).sum(axis=1)
    weight /= weight.sum()
    left = np.arange(len(points))
    places, ways, limits = (each.astype(np.float32) for each in (points, normals, thick))
    planes: list[_Plane] = []
    while len(planes) < MAX_PLANES and len(left) >= NEIGHBORS:
        corner = rng.choice(left, min(JUDGED, len(left)), replace=False)
        offset = np.einsum("td,td->t", normals[corner], points[corner])
        apart = places[left] @ ways[corner].T
        apart -= offset.astype(np.float32)
        held = np.abs(apart, out=apart) < limits[left, None]
        held &= ways[left] @ ways[corner].T > SAME_WAY
        share = weight[left] @ held
        best = int(share.argmax())
        if share[best] < MIN_SHARE:
            break
        plane = _Plane(normals[corner[best]], float(offset[best]), 0.0)
        for _ in range(REFINEMENTS):
            near = np.abs(plane.heights(points[left])) < thick[left]
            mine = left[near & (normals[left] @ plane.normal > ROUGHLY_SAME_WAY)]
            if len(mine) < NEIGHBORS:  # on round things a plane slips off
                break
            plane = _fitted(points[mine], weight[mine], plane.normal)
        planes.append(plane)
        gone = np.abs(plane.heights(points[left])) < 1.5 * thick[left]
        left = left[~(gone & (normals[left] @ plane.normal > 0.5))]
    return sorted(planes, key=lambda plane: -plane.share)


def _turned(
    normals: Float32, points: Float64, viewpoint: Float64 | None, up: Float64 | None
) -> Float64:
    """Normals on the side of the camera; of `up`, or +z, where there is none."""
    toward = np.array([0.0, 0.0, 1.0]) if up is None else up
    side = normals @ toward
    if viewpoint is not None:
        side = np.einsum("nd,nd->n", normals, viewpoint - points)
    return np.where(side[:, None] < 0, -normals, normals).astype(np.float64)


def _fitted(points: Float64, weight: Float64, side: Float64) -> _Plane:
    """The plane nearest to points (N, 3), its normal on a side."""
    middle = weight @ points / weight.sum()
    around = points - middle
    _, vectors = np.linalg.eigh((around * weight[:, None]).T @ around)  # ascending
    normal: Float64 = vectors[:, 0] if vectors[:, 0] @ side >= 0 else -vectors[:, 0]
    return _Plane(normal, float(normal @ middle), float(weight.sum()))


def _tilt(plane: _Plane, up: Float64) -> float:
    return math.acos(min(max(float(plane.normal @ up), -1.0), 1.0))


def _most_stood_on(
    seen: Seen,
    planes: list[_Plane],
    max_size: float,
    rng: np.random.Generator,
    warnings: list[str],
) -> _Plane | None:
    """The plane of greatest worth; None where none is a support at all."""
    sample = seen.thinned(VIEW)
    best, worth, second = None, 0.0, 0.0
    for plane in (_refined(sample, plane) for plane in planes):
        this = _worth(sample, plane, max_size, least=worth * ALIKE)
        if this > worth:
            best, worth, second = plane, this, worth
        else:
            second = max(second, this)
    if best is not None and second > ALIKE * worth:
        warnings.append(
            "two planes look alike as the support: check the one in the answer, or send up, "
            "support or a workspace."
        )
    return best


def _refined(seen: Seen, plane: _Plane) -> _Plane:
    """A plane fitted again to more points than it was found by."""
    points, thick = seen.points.astype(np.float64), thickness(seen.distance())
    for within in (1.0, 0.7, 0.5):
        near = np.flatnonzero(np.abs(plane.heights(points)) < within * thick)
        if len(near) < NEIGHBORS:
            break
        fitted = _fitted(points[near], np.ones(len(near)), plane.normal)
        plane = plane._replace(normal=fitted.normal, offset=fitted.offset)
    return plane


def _worth(seen: Seen, plane: _Plane, max_size: float, least: float) -> float:
    """How much a plane is stood on and seen, over squared distance; 0 where it is no support."""
    distance, height = seen.distance(), plane.heights(seen.points)
    thick = thickness(distance)
    on = np.abs(height) < thick
    size = int(on.sum())
    if size == 0:
        return 0.0
    if seen.viewpoint is not None and plane.heights(seen.viewpoint) < thick[on].mean():
        return 0.0
    far = float(np.median(distance[on]))
    if size / far**2 <= least:  # were everything on it a thing, it would not be worth more
        return 0.0
    axes = plan_axes(plane.normal, seen.viewpoint, seen.points)
    plan = seen.points @ axes.T
    area = occupied_cells(plan[on], CELL) * CELL**2
    if area < MIN_AREA:
        return 0.0
    below = (height < -3 * thick) & (height > -NEAR_BELOW)
    near_below = _over_hull(plan[on], plan[below])
    if near_below > MAX_BELOW * (near_below + size):
        return 0.0
    out = np.flatnonzero(height > 2 * thick)
    border = None if seen.at_border is None else seen.at_border[out]
    view = PlaneView(plan[out], height[out], 2 * thick[out], plan[on], border)
    things = int((find_things(view, max_size) >= 0).sum())
    if things == 0 and plane.share < BARE and area < max_size**2 / 2:
        return 0.0
    through = _seen_through(seen, height, height < -3 * thick, plan[on], axes, plane)
    worth = math.sqrt((min(things, size) + NOTHING_ON_IT * size) * size) / far**2
    worth *= 1.0 if things else UNUSED
    return max(worth * size / (size + near_below) - through / far**2, 0.0)


def _over_hull(on: Float64, others: Float64) -> int:
    """How many of other points lie over the middle part of a plane's points; plan, metres."""
    on = on[:: len(on) // OUTLINED + 1]
    low, high = np.percentile(on, [2, 98], axis=0)
    try:
        sides = ConvexHull(on[((on > low) & (on < high)).all(axis=1)]).equations
    except (QhullError, ValueError):  # too few points, or all in a line
        return 0
    # The front of what the plane is the top of lies at its edge.
    return int((others @ sides[:, :2].T + sides[:, 2] < -CELL).all(axis=1).sum())


def _seen_through(
    seen: Seen, height: Float64, below: Bools, on: Float64, axes: Float64, plane: _Plane
) -> int:
    """How many points under a plane are seen through its own seen part: it is none, then."""
    if seen.viewpoint is None or not below.any():
        return 0
    above = float(plane.heights(seen.viewpoint))
    way = above / (above - height[below])
    crossed = (seen.viewpoint + (seen.points[below] - seen.viewpoint) * way[:, None]) @ axes.T
    low = on.min(axis=0)
    cell, other = (np.floor((plan - low) / CELL).astype(np.int64) for plan in (on, crossed))
    held = np.zeros(cell.max(axis=0) + 1, dtype=bool)
    held[cell[:, 0], cell[:, 1]] = True
    held = ndimage.binary_erosion(held)
    other = other[((other >= 0) & (other < held.shape)).all(axis=1)]
    return int(held[other[:, 0], other[:, 1]].sum())


def _as_option(plane: _Plane) -> SupportPlane:
    x, y, z = plane.normal.tolist()
    return SupportPlane(normal=(x, y, z), offset=plane.offset)


def _none_found(planes: list[_Plane], up: Float64 | None) -> str:
    said = "no support plane was found"
    if planes and up is not None:
        tilt = math.degrees(_tilt(planes[0], up))
        said += f": the largest plane that is seen is tilted by {tilt:.0f} degrees from up"
    return f"{said}. Send support, or the true up, if there is one in view."
