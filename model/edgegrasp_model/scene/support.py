"""The support plane: given, the largest one seen, or fitted to points classified as support."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats, Int64
from edgegrasp_model.kernels import compiled
from edgegrasp_model.options import SUPPORT_STREAM, DetectOptions, RansacPlane, SupportPlane
from edgegrasp_model.scene.cloud import (
    HAND_REACH,
    MAX_DISTANCE,
    OUTLIER_PERCENT,
    CanonicalFrame,
    CheckedCloud,
    grid_cells,
    inside_workspace,
    subsample,
    unit,
    usual_up,
)
from edgegrasp_model.scene.segment import Segmentation

# Noise of depth cameras: metres off a plane, and further metres per distance squared.
PLANE_NOISE, NOISE_GROWTH = 0.004, 0.006

# The margin above a plane, up to which points belong to it.
MARGIN_DEVIATIONS = 4.0  # standard deviations of the plane's points; PLANE_NOISE metres at least
MAX_MARGIN = 0.02  # metres
GIVEN_PLANE_MARGIN = 0.005  # metres, of a plane that the caller gives
MAX_BOW = 0.025  # metres by which a bowed support rises or sinks from its plane
HEEDED_RISE = 0.001  # metres; hands ignore smaller rises of the visible support over its plane

# The fit to points classified as support.
MIN_PLANE_POINTS = 60
NEAR_DISTANCE, FAR_WEIGHT = 0.15, 0.1  # metres to an object; weight of points farther away
MAX_SHARE_BELOW = 0.1  # of the objects' points, below the plane
REFINE_DISTANCE = 0.08  # metres to an object, of points that refine the plane
AREA_CELL = 0.02  # metres, side of the cells that measure areas
MIN_SUPPORT_AREA = 0.008  # square metres; the top of an object is smaller

# A cloud that was cropped above its support.
MIN_SUPPORT_SHARE = 0.2  # of points classified as support, otherwise
MIN_UP_COSINE = 0.5  # of the angle between up and its usual direction
ASSUMED_PLANE_GAP = 0.003  # metres from the lowest points down to the assumed plane

# Depths that a given plane corrects.
INLIER_DISTANCE = 0.01  # metres from the plane
MIN_INLIER_SHARE = 0.1  # of the points
MAX_INLIER_SPREAD = 0.35  # median distance, as a share of INLIER_DISTANCE; a wall's is 0.5
MIN_CORRECTED_AREA = 0.035  # square metres; flat tops of objects are smaller


@dataclass(frozen=True)
class Support:
    """A support plane and how well the points agree with it; cloud frame."""

    plane: SupportPlane
    frame: CanonicalFrame  # its z is the height over the plane, along the unit normal
    margin: float  # metres above it that always belong to it
    residual: float | None = None  # metres, median distance of its points; None: it is not seen
    share: float = 0.0  # of the points that lie in it
    growth: float = math.nan  # noise of its points, metres per squared metre of distance
    # Rise over the plane at (x, y): of 1, x, y, x^2, x y, y^2.
    bow: Float64 = field(default_factory=lambda: np.zeros(6))

    def plane_under(self, objects: Floats, least: float) -> SupportPlane:
        """The plane that hands stay above, fitted to the visible support under objects (N, 3).

        It is `least` metres over the support's plane, or higher where the support rises more.
        """
        terms = _bow_terms(*self.frame.points_from_cloud(objects)[:, :2].T)
        rise = np.minimum(self.bow @ terms, MAX_BOW)
        if rise.max(initial=0.0) < max(least, HEEDED_RISE):
            offset = self.plane.offset + least * float(np.linalg.norm(self.plane.normal))
            return self.plane.model_copy(update={"offset": offset})
        height, *slope = np.linalg.lstsq(terms[:3].T, np.maximum(rise, least))[0]
        tilted = SupportPlane.model_construct(normal=(-slope[0], -slope[1], 1.0), offset=height)
        T_cloud_plane = np.asarray(np.linalg.inv(self.frame.T_canonical_cloud), np.float64)
        return plane_in(CanonicalFrame(T_cloud_plane), tilted)

    def heights(self, seen: "ViewedPoints") -> tuple[Float32, Float32]:
        """Heights (N,) over the support, which may be bowed, and margins (N,) that belong to it.

        The noise of depth cameras grows with the square of the distance.
        """
        height = _heights(seen.points, self.frame.T_canonical_cloud, self.bow)
        if math.isnan(self.growth):
            return height, np.full_like(height, self.margin)
        noise = np.float32(MARGIN_DEVIATIONS * self.growth) * np.square(seen.away)
        return height, np.clip(noise, self.margin, max(MAX_MARGIN, self.margin), out=noise)


class ViewedPoints(NamedTuple):
    """N points and their viewpoint."""

    points: Float32  # (N, 3) metres
    viewpoint: Float64  # (3,) the camera, or the mean of several
    away: Float32  # (N,) metres from each point to the camera that saw it

    @classmethod
    def by_cameras(cls, sent: CheckedCloud, viewpoints: Float64) -> "ViewedPoints":
        """The points of a cloud, which cameras at (W, 3) saw."""
        eyes = viewpoints if len(viewpoints) < 2 else viewpoints[sent.view_ids]
        apart = sent.points - eyes.astype(np.float32)
        away = np.sqrt(np.einsum("nd,nd->n", apart, apart))
        return cls(sent.points, viewpoints.sum(axis=0) / max(len(viewpoints), 1), away)

    def take(self, rows: Int64) -> "ViewedPoints":
        """The points of the given rows."""
        return ViewedPoints(self.points[rows], self.viewpoint, self.away[rows])


def heights_over(plane: SupportPlane, points: Floats) -> Floats:
    """Heights (N,) of points (N, 3) over a plane, metres."""
    return np.asarray(points @ np.asarray(plane.normal) - plane.offset)


def plane_in(frame: CanonicalFrame, plane: SupportPlane) -> SupportPlane:
    """Transform a plane from the cloud's frame to another one."""
    normal = np.asarray(plane.normal)
    length = float(np.linalg.norm(normal))
    foot = frame.points_from_cloud(normal * (plane.offset / length**2))
    turned = frame.directions_from_cloud(normal) / length
    return SupportPlane.model_construct(normal=tuple(turned.tolist()), offset=float(foot @ turned))


def find_support(
    seen: ViewedPoints,  # N points
    inside: Bools,  # (N,) which of them lie in the workspace
    segmentation: Segmentation | None,  # the network's output, if it was run
    options: DetectOptions,
    warnings: list[str],  # gets what is wrong with the support, or that there is none
) -> Support | None:
    """The support plane of a request."""
    request = options.support
    if request is None or len(seen.points) == 0:
        return None
    found: Support | None = None
    up, rng = options.known_up, np.random.default_rng([options.seed, SUPPORT_STREAM])
    if isinstance(request, SupportPlane):
        found = _given_support(seen, segmentation, request, options, warnings)
    elif isinstance(request, RansacPlane):
        up = segmentation.up if up is None and segmentation is not None else up
        cell, count = grid_cells(seen.points, AREA_CELL)  # equal areas get equal weight
        plane = fit_plane(seen, inside / count[cell], rng, up, request.max_tilt)
        if plane is not None:
            found = measure_support(seen, plane, request.distance, True)
            found = found if found.share >= request.min_share else None
    else:
        assert segmentation is not None
        found = _fit_support(seen, segmentation, up, rng)
        found = found or _assume_support(seen, segmentation, options, warnings)
    if found is None:
        warnings.append(
            "no support plane is seen: objects are returned without one, and hands may reach "
            "under them. Send support, or check up and the camera's pose, whose z is forward."
        )
    elif heights_over(found.plane, seen.viewpoint) < 0:
        warnings.append(
            "the viewpoint lies below the support plane: check viewpoint, up and support."
        )
    return found


def _given_support(
    seen: ViewedPoints,
    segmentation: Segmentation | None,
    plane: SupportPlane,
    options: DetectOptions,
    warnings: list[str],
) -> Support:
    """The support in a plane that the caller gives, measured on the points."""
    # The table around a bin must not count as its floor; a followed object's workspace is no bin.
    around = np.inf if options.follows_only else HAND_REACH * np.abs(plane.normal)
    over = np.flatnonzero(inside_workspace(seen.points, options.workspace, around))
    sample = seen.take(subsample(over))
    below = float(heights_over(plane, sample.points).min(initial=np.inf))
    if options.max_object_size < below < np.inf:
        warnings.append(
            f"the given support plane lies {below:.3g} m below everything that is seen: check "
            "its frame, normal, and offset in metres."
        )
    on = np.flatnonzero([] if segmentation is None else segmentation.support_probability > 0.5)
    # In a cloud cropped above its support, only flat tops may be classified as support.
    whole = len(on) > MIN_SUPPORT_SHARE * len(seen.points)
    whole = whole and _wider_than_object(seen.points[subsample(on)], plane)
    return measure_support(sample, plane, GIVEN_PLANE_MARGIN, whole)


def _fit_support(
    seen: ViewedPoints, segmentation: Segmentation, up: Float64 | None, rng: np.random.Generator
) -> Support | None:
    """The plane of the points classified as support, weighted toward those near objects."""
    on = np.flatnonzero(segmentation.support_probability > 0.5)
    held = np.flatnonzero(segmentation.object_of_point >= 0)
    part = seen.take(subsample(on))
    around = seen.points[subsample(held, 500)]
    # Metres to the nearest object; infinity beyond NEAR_DISTANCE, or where there is no object.
    apart = np.asarray(cKDTree(around).query(part.points, distance_upper_bound=NEAR_DISTANCE)[0])
    weight = np.where(np.isfinite(apart), 1.0, FAR_WEIGHT)
    tilt, up = (30, segmentation.up) if up is None else (12, up)  # degrees; estimates are rough
    for _ in range(2):
        plane = fit_plane(part, weight, rng, up, math.radians(tilt))
        if plane is None:
            return None
        below = heights_over(plane, around) < -MAX_MARGIN
        if len(below) == 0 or below.mean() <= MAX_SHARE_BELOW:
            break
        # This plane is the top of something larger, and the objects stand below it.
        weight[heights_over(plane, part.points) > -MAX_MARGIN] = 0.0
    else:
        return None
    # Refined by the points close to objects: the plane of a bin's floor, not the table's.
    close = part.points[apart < REFINE_DISTANCE]
    near = close[np.abs(heights_over(plane, close)) < MAX_MARGIN].astype(np.float64)
    for within in (2.0, 1.25, 1.0):
        if len(near) < MIN_PLANE_POINTS:
            break
        height = heights_over(plane, near)
        near = near[np.abs(height - np.median(height)) < within * PLANE_NOISE]
        plane = _fit_least_squares(near, plane) if len(near) >= MIN_PLANE_POINTS else plane
    found = measure_support(part, plane, PLANE_NOISE, True)
    places = found.frame.points_from_cloud(part.points)
    _, count = grid_cells(places[np.abs(places[:, 2]) < MAX_MARGIN, :2], AREA_CELL)
    if len(count) * AREA_CELL**2 <= MIN_SUPPORT_AREA:
        return None
    return replace(found, share=found.share * len(on) / len(seen.points))  # of all points


def _assume_support(
    seen: ViewedPoints, segmentation: Segmentation, options: DetectOptions, warnings: list[str]
) -> Support | None:
    """A support under the lowest points of a cloud that was cropped above it."""
    if (segmentation.support_probability > 0.5).mean() > MIN_SUPPORT_SHARE:
        return None
    up, objects = options.known_up, segmentation.object_of_point >= 0
    if up is None and has_camera_at_origin(options):
        if objects.mean() <= 1.0 - MIN_SUPPORT_SHARE:
            return None
        up = up_of_cropped(seen.points[objects], seen.viewpoint, segmentation.up)
    elif up is None:
        if segmentation.up[2] <= 0:
            return None
        up = np.array([0.0, 0.0, 1.0])
    lowest = float(np.percentile(seen.points.astype(np.float64) @ up, OUTLIER_PERCENT))
    plane = SupportPlane.model_construct(
        normal=tuple(up.tolist()), offset=lowest - ASSUMED_PLANE_GAP
    )
    warnings.append(
        "no support plane is seen: one is assumed under the lowest points. Send support (null, "
        "with objects: off, if there is none)."
    )
    return measure_support(seen, plane, 0.0, False)


def has_camera_at_origin(options: DetectOptions) -> bool:
    """Whether a camera is at the origin; if not, z is up, as in the frame of a robot or a world."""
    cameras = options.viewpoint
    return cameras is not None and not np.reshape(cameras, (-1, 3)).any(axis=1).all()


def up_of_cropped(
    cloud: Float32,  # (N, 3) metres, in the frame of a camera
    viewpoint: Float64,  # (3,)
    estimate: Float64 | None,  # (3,) unit, of the network; None: unknown
) -> Float64:
    """Up (3,), unit, of a cloud without its support, from the plane of the cloud's lower edge.

    Of the faces of the convex hull that the camera does not see, this takes the one with points in
    the most places. As many may lie in the sides of a box as in its bottom, so a face counts less
    the more its direction differs from the usual up: between the top of the image and the camera,
    and near the network's estimate.
    """
    points = subsample(cloud).astype(np.float64)
    toward = unit(viewpoint - points.mean(axis=0))
    hints = [toward, usual_up(-toward), *([] if estimate is None else [estimate])]
    usual: Float64 = unit(np.sum(hints, axis=0))
    try:
        planes = ConvexHull(points).equations
    except (QhullError, ValueError):  # a flat cloud; fewer than four points
        return usual
    likely = -planes[:, :3] @ usual > MIN_UP_COSINE
    likely &= (planes[:, :3] @ toward < 0.0) & (planes[:, :3] @ viewpoint + planes[:, 3] < 0.0)
    planes = planes[likely]
    near = points @ planes[:, :3].T + planes[:, 3] > -PLANE_NOISE
    places = [len(grid_cells(points[touched], PLANE_NOISE)[1]) for touched in near.T]
    if not places:
        return usual
    weight = -planes[:, :3] @ usual - MIN_UP_COSINE
    return np.asarray(-planes[np.argmax(places * weight), :3])


def _fit_least_squares(points: Float64, like: SupportPlane) -> SupportPlane:
    """The plane through points (N, 3), facing the same way as another one."""
    middle = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - middle).T))  # ascending
    normal = vectors[:, 0] if vectors[:, 0] @ like.normal >= 0 else -vectors[:, 0]
    offset = float(normal @ middle)
    return SupportPlane.model_construct(normal=tuple(normal.tolist()), offset=offset)


def fit_plane(
    seen: ViewedPoints,  # N points that may belong to it
    weight: Floats,  # (N,) the weight of each
    rng: np.random.Generator,
    up: Float64 | None,  # (3,) unit; None: any tilt is allowed
    max_tilt: float = math.radians(30),  # from `up`
) -> SupportPlane | None:
    """The plane that contains the most of the weighted points, facing the camera (RANSAC).

    None: there are too few points, or no plane is level enough.
    """
    held = np.flatnonzero(weight > 0)
    if len(held) < MIN_PLANE_POINTS:
        return None
    # The best of 150 planes on a sample of 1200 points.
    chosen = rng.choice(
        held, min(1200, len(held)), replace=False, p=weight[held] / weight[held].sum()
    )
    sample = seen.take(chosen)
    points = sample.points.astype(np.float64)
    thick = PLANE_NOISE + NOISE_GROWTH * np.square(sample.away)
    corners = points[rng.integers(len(points), size=(150, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    wide = length > 1e-6
    normals, origin = normals[wide] / length[wide, None], corners[wide, 0]
    toward = seen.viewpoint - origin
    normals = np.where((np.einsum("td,td->t", normals, toward) < 0)[:, None], -normals, normals)
    if up is not None:
        level = normals @ up >= math.cos(max_tilt + 1e-9)
        normals, origin = normals[level], origin[level]
    if len(normals) == 0:
        return None
    heights = points @ normals.T - np.einsum("td,td->t", normals, origin)
    best = int((np.abs(heights) < thick[:, None]).sum(axis=0).argmax())
    offset = float(normals[best] @ origin[best])
    plane = SupportPlane.model_construct(normal=tuple(normals[best].tolist()), offset=offset)
    for within in (1.0, 0.7, 0.5):
        near = np.abs(heights_over(plane, points)) < within * thick
        if near.sum() < MIN_PLANE_POINTS // 2:
            break
        plane = _fit_least_squares(points[near], plane)
    level_enough = up is None or np.dot(up, plane.normal) >= math.cos(max_tilt + 1e-9)
    return plane if level_enough else None


def measure_support(seen: ViewedPoints, plane: SupportPlane, least: float, whole: bool) -> Support:
    """Measure the support in a plane on the points; it is at least `least` metres thick.

    `whole`: the cloud was not cropped above the plane.
    """
    sample = seen.take(subsample(np.arange(len(seen.points))))
    frame = CanonicalFrame.from_scene(sample.points, plane.normal, seen.viewpoint)
    frame.T_canonical_cloud[2, 3] = -plane.offset / np.linalg.norm(plane.normal)
    x, y, height = frame.points_from_cloud(sample.points).T
    distance = sample.away
    thick = PLANE_NOISE + NOISE_GROWTH * np.square(distance)
    near = np.abs(height) < thick
    # If the cloud was cropped above the plane, only objects on it are near.
    if near.sum() < MIN_PLANE_POINTS or (not whole and (height[near] < 1e-4).mean() < 0.2):
        return Support(plane, frame, least)
    terms, bow = _bow_terms(x, y), np.zeros(6)
    ridge = 1e-6 * np.eye(6)  # keeps the bow small where little of the support is seen
    for _ in range(4):
        near = np.abs(height - bow @ terms) < thick
        held = near * terms
        bow = np.asarray(np.linalg.solve(held @ terms.T + ridge, held @ height))
    off = np.abs(height - bow @ terms)[near]
    growth = 1.4826 * float(np.median(off / np.square(distance[near])))
    residual = float(np.median(np.abs(height[near])))
    return Support(plane, frame, least, residual, float(near.mean()), growth, bow)


def _bow_terms(x: Floats, y: Floats) -> Floats:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])


@compiled("contract")
def _heights(points: Float32, T_plane_cloud: Float64, bow: Float64) -> Float32:
    """Heights (N,) over a bowed plane."""
    T, height = T_plane_cloud, np.empty(len(points), np.float32)
    for i in range(len(points)):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        rise = bow[0] + bow[1] * x + bow[2] * y + bow[3] * x * x + bow[4] * x * y + bow[5] * y * y
        rise = min(max(rise, -MAX_BOW), MAX_BOW)
        height[i] = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3] - rise
    return height


def correct_depth_scale(
    sent: CheckedCloud, plane: object, viewpoints: Float64, warnings: list[str]
) -> CheckedCloud:
    """Scale every view about its camera so that its support lies in the plane, if one is given.

    `viewpoints` (W, 3), metres, are the cameras; the cloud's `view_ids` are their rows.
    """
    if not isinstance(plane, SupportPlane) or plane.max_depth_error == 0.0:
        return sent
    several = len(viewpoints) > 1 and sent.view_ids is not None
    points = sent.points.copy()
    for number, viewpoint in enumerate(viewpoints):
        rows = np.flatnonzero(sent.view_ids == number) if several else slice(None)
        which = f"the depths of view {number}" if several else "the depths"
        scale = depth_scale(points[rows], viewpoint, plane)
        if scale is None:
            warnings.append(
                f"{which} are used as sent: no support plane is seen within "
                f"options.support.max_depth_error ({plane.max_depth_error:g}) of its place."
            )
        elif round(scale, 3) != 1.0:
            warnings.append(f"{which} were multiplied by {scale:.3f} to fit the support plane.")
            points[rows] = viewpoint + scale * (points[rows] - viewpoint)
    return replace(sent, points=points)


def depth_scale(points: Floats, viewpoint: Float64, plane: SupportPlane) -> float | None:
    """The factor on a view's depths that moves its points of the support into the plane.

    If several factors fit (the table, or the flat top of an object), the smallest one is taken, as
    nothing is seen below the table. None if the camera is not above the plane, is too high, or sees
    too little. Points (N, 3) and viewpoint (3,) in metres.
    """
    height = float(heights_over(plane, viewpoint))
    falls = height - heights_over(plane, points.astype(np.float64))
    if not INLIER_DISTANCE < height < MAX_DISTANCE:
        return None
    # A scaled point lies in the plane if it is as far below the camera as the plane is.
    factors = np.sort(height / falls[falls > 0.5 * height])
    reach = INLIER_DISTANCE / height
    tried = np.arange(1.0 - plane.max_depth_error, 1.0 + plane.max_depth_error, reach / 10)
    held = np.searchsorted(factors, tried + reach) - np.searchsorted(factors, tried - reach)
    enough = max(MIN_INLIER_SHARE * len(points), MIN_PLANE_POINTS)
    start, width = 0, 21  # factors from the start of a peak to beyond it
    while start < len(tried):
        window = held[start : start + width]
        if window.max() >= enough:
            scale = _median_scale(factors, float(tried[start + int(window.argmax())]), reach)
            if scale is not None and abs(scale - 1.0) <= plane.max_depth_error:
                scaled = viewpoint + scale * (subsample(points) - viewpoint)
                inliers = scaled[np.abs(heights_over(plane, scaled)) < INLIER_DISTANCE]
                if _wider_than_object(inliers, plane):
                    return scale
            start += width - 1
        start += 1
    return None


def _wider_than_object(points: Floats, plane: SupportPlane) -> bool:
    """Whether points (N, 3) cover more of a plane than an object's flat top."""
    frame = CanonicalFrame.from_scene(points, plane.normal, None)
    _, count = grid_cells(frame.points_from_cloud(points)[:, :2], AREA_CELL)
    return len(count) * AREA_CELL**2 > MIN_CORRECTED_AREA


def _median_scale(factors: Float64, scale: float, reach: float) -> float | None:
    """The median of the factors near `scale`; None if they spread too much for a plane."""
    for _ in range(20):
        within = factors[np.abs(factors - scale) <= reach]
        scale = float(np.median(within))
    spread = float(np.median(np.abs(within - scale)))
    return scale if spread <= MAX_INLIER_SPREAD * reach else None
