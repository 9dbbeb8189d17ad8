"""The support plane: given, or fitted to the points that the `scene` network calls a support."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Float32, Float64, Floats
from edgegrasp_model.kernels import heights_and_distances
from edgegrasp_model.options import SupportPlane


@dataclass(frozen=True)
class PlaneLimits:
    """What belongs to a support plane; metres unless stated."""

    thickness: tuple[float, float] = (0.004, 0.006)  # and per squared metre of distance
    thickest: float = 0.03  # however far the plane is away
    margin: tuple[float, float] = (0.004, 0.02)  # least and greatest height that belongs to it
    given_margin: float = 0.005  # of a plane that is given and not seen
    deviations: float = 4.0  # of its own points that still belong to it
    bow: float = 0.025  # by which a support may rise over its plane
    tilt: float = math.radians(30)  # radians between the plane and a given `up`
    near_objects: float = 0.15  # around an object where the support counts in full
    far_weight: float = 0.1  # of support points elsewhere
    fewest: int = 60  # points that a plane is fitted to, and by which its residual is measured
    cell: float = 0.02  # in which surfaces are counted
    least_area: float = 0.008  # square metres of it that are seen
    usual_distance: float = 0.7  # to a camera that is not known


LIMITS = PlaneLimits()
TRIES, SAMPLE = 150, 1200  # planes that are tried, points that judge them
REFINEMENTS = 4  # least squares over the plane's points
MEASURED = 6000  # points that say how well a plane agrees with what is seen
STIFF = 1e-6 * np.eye(6)  # keeps a support flat where too little of it is seen


@dataclass(frozen=True)
class Support:
    """A support plane, and how well what is seen agrees with it; the cloud's frame."""

    plane: SupportPlane
    residual: float  # metres, median distance of its points; NaN where it is not seen
    share: float  # of the points that lie in it
    spread: float  # standard deviation of its points at `distance`, metres; NaN: not seen
    distance: float  # metres from the camera to its points, the median
    least: float  # metres over it that belong to it anyway
    bow: Float64  # (6,) rise over the plane at (x, y): of 1, x, y, x^2, x y, y^2
    axes: Float64  # (4, 3) x and y along the plane, its normal, and an origin on it; cloud frame

    @property
    def normal(self) -> Float64:
        """(3,) unit."""
        return np.asarray(self.axes[2])

    def plan(self, points: Floats) -> Float64:
        """Places (N, 2) along the plane of points (N, 3), metres."""
        return np.asarray((points - self.axes[3]) @ self.axes[:2].T)

    def heights(self, seen: "Seen") -> tuple[Float32, Float32]:
        """How high points stand over the support, which may be bowed, and what belongs to it.

        The noise of depth cameras grows with the square of the distance.

        Args:
            seen: N points.

        Returns:
            The height (N,) of each, and the height (N,) up to which it belongs to the support.
        """
        eye = seen.viewpoint
        height, squared = heights_and_distances(
            seen.points, self.axes, self.bow, LIMITS.bow, self.axes[3] if eye is None else eye
        )
        if math.isnan(self.spread):
            return height, np.full_like(height, self.least)
        if eye is None:
            squared = np.full(len(squared), LIMITS.usual_distance**2, dtype=np.float32)
        grown = np.float32(LIMITS.deviations * self.spread / self.distance**2) * squared
        return height, np.clip(grown, self.least, max(LIMITS.margin[1], self.least))


class Seen(NamedTuple):
    """N points and from where they were seen."""

    points: Float32  # (N, 3) metres
    viewpoint: Float64 | None  # (3,) the camera, the mean of several; None: unknown

    def distance(self) -> Float64:
        """Metres (N,) from the camera."""
        if self.viewpoint is None:
            return np.full(len(self.points), LIMITS.usual_distance)
        apart = self.points - self.viewpoint
        return np.asarray(np.sqrt(np.einsum("nd,nd->n", apart, apart)))

    def thickness(self) -> Float64:
        """Metres (N,) from a plane within which points may belong to it."""
        thick = LIMITS.thickness[0] + LIMITS.thickness[1] * np.square(self.distance())
        return np.minimum(thick, LIMITS.thickest)


def fit_plane(
    seen: Seen,
    weight: Floats,
    rng: np.random.Generator,
    up: Float64 | None = None,
    max_tilt: float = LIMITS.tilt,
) -> SupportPlane | None:
    """The plane that holds the most of weighted points, facing the camera (RANSAC).

    Args:
        seen: N points that may belong to it.
        weight: (N,) what each counts.
        rng: Source of the samples.
        up: (3,) unit; None: any tilt will do.
        max_tilt: Radians from `up`.

    Returns:
        The plane; None where there are too few points, or none of it is level enough.
    """
    held = np.flatnonzero(weight > 0)
    if len(held) < LIMITS.fewest:
        return None
    chosen = rng.choice(
        held, min(SAMPLE, len(held)), replace=False, p=weight[held] / weight[held].sum()
    )
    sample = Seen(seen.points[chosen], seen.viewpoint)
    points, thick = sample.points.astype(np.float64), sample.thickness()
    corners = points[rng.integers(len(points), size=(TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    wide = length > 1e-6
    normals, origin = normals[wide] / length[wide, None], corners[wide, 0]
    toward = _toward(seen, origin, up)
    normals = np.where((np.einsum("td,td->t", normals, toward) < 0)[:, None], -normals, normals)
    if up is not None:
        level = normals @ up >= math.cos(max_tilt + 1e-9)
        normals, origin = normals[level], origin[level]
    if len(normals) == 0:
        return None
    heights = points @ normals.T - np.einsum("td,td->t", normals, origin)
    worth = (np.abs(heights) < thick[:, None]).sum(axis=0)
    best = int(worth.argmax())
    normal, offset = normals[best], float(normals[best] @ origin[best])
    for within in (1.0, 0.7, 0.5):
        near = np.abs(points @ normal - offset) < within * thick
        if near.sum() < LIMITS.fewest // 2:
            break
        middle = points[near].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov((points[near] - middle).T))  # ascending
        normal = vectors[:, 0] if vectors[:, 0] @ normal >= 0 else -vectors[:, 0]
        offset = float(normal @ middle)
    if up is not None and normal @ up < math.cos(max_tilt + 1e-9):
        return None
    x, y, z = normal.tolist()
    return SupportPlane(normal=(x, y, z), offset=offset)


def near_objects(points: Float32, objects: Float32) -> Float64:
    """What each point (N, 3) of a support counts: in full near an object (M, 3), else a little."""
    if len(objects) == 0:
        return np.ones(len(points))
    around = cKDTree(objects[:: max(len(objects) // 500, 1)])
    apart, _ = around.query(points, distance_upper_bound=LIMITS.near_objects)
    return np.where(np.isfinite(apart), 1.0, LIMITS.far_weight)


def by_surface(points: Float32) -> Float64:
    """What each point (N, 3) counts so that equal areas count alike."""
    cell = np.floor(points / LIMITS.cell).astype(np.int64)
    _, which, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / count[which.reshape(-1)])


def area(support: Support, points: Float32) -> float:
    """Square metres of the support that points (N, 3) cover."""
    near = np.abs(support.plane.heights(points)) < LIMITS.margin[1]
    cell = np.floor(support.plan(points[near]) / LIMITS.cell).astype(np.int64)
    return len(np.unique(cell, axis=0)) * LIMITS.cell**2


def _toward(seen: Seen, origin: Float64, up: Float64 | None) -> Float64:
    """Directions (T, 3) to which normals point: the camera, else up, else +z."""
    if seen.viewpoint is not None:
        return np.asarray(seen.viewpoint - origin)
    return np.broadcast_to(np.array([0.0, 0.0, 1.0]) if up is None else up, origin.shape)


def measured(seen: Seen, plane: SupportPlane, least: float = LIMITS.given_margin) -> Support:
    """A plane, and how well the points agree with it where it is seen.

    Args:
        seen: N points.
        plane: Of the cloud's frame.
        least: Metres over it that belong to it anyway.
    """
    each = max(len(seen.points) // MEASURED, 1)
    sample = Seen(seen.points[::each], seen.viewpoint)
    points, distance = sample.points.astype(np.float64), sample.distance()
    thick = sample.thickness()
    normal = np.asarray(plane.normal) / np.linalg.norm(plane.normal)
    origin = points.mean(axis=0) if len(points) else np.zeros(3)
    height: Float64 = plane.heights(points).astype(np.float64)
    origin -= float(plane.heights(origin)) * normal
    axes = np.stack([*plan_axes(normal, seen.viewpoint, points), normal, origin])
    near = np.abs(height) < thick
    # Where the cloud was cut off above the plane, only what stands on it is near.
    if near.sum() < LIMITS.fewest or (height[near] < 1e-4).mean() < 0.2:
        unknown, flat = math.nan, np.zeros(6)
        return Support(plane, unknown, 0.0, unknown, LIMITS.usual_distance, least, flat, axes)
    terms = _squares((points - origin) @ axes[:2].T)
    bow: Float64 = np.zeros(6)
    for _ in range(REFINEMENTS):
        near = np.abs(height - bow @ terms) < thick
        held = near * terms
        bow = np.asarray(np.linalg.solve(held @ terms.T + STIFF, held @ height))
    off, apart = np.abs(height - bow @ terms)[near], distance[near]
    middle = float(np.median(apart))
    spread = 1.4826 * float(np.median(off / np.square(apart / middle)))
    share = float(near.mean())
    return Support(plane, float(np.median(off)), share, spread, middle, least, bow, axes)


def plan_axes(normal: Float64, viewpoint: Float64 | None, points: Floats) -> Float64:
    """Two unit axes (2, 3) along a plane, the first toward the camera, else the furthest point."""
    middle = (
        np.array([axis.mean(dtype=np.float64) for axis in points.T]) if len(points) else np.zeros(3)
    )
    offsets = points[:: max(len(points) // 1000, 1)] - middle
    offsets = np.concatenate([np.eye(3) if viewpoint is None else [viewpoint - middle], offsets])
    level = offsets - (offsets @ normal)[:, None] * normal
    length = np.linalg.norm(level, axis=1)
    first = 0 if viewpoint is not None and length[0] > 1e-3 else int(length.argmax())
    x = level[first] / max(length[first], 1e-9)
    return np.stack([x, np.cross(normal, x)])


def _squares(plan: Float64) -> Float64:
    """1, x, y, x^2, x y, y^2 (6, N) of points (N, 2)."""
    x, y = plan.T
    return np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
