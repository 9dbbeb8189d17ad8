"""The support plane: given, the largest one seen, or fitted to what the network calls support."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions, RansacPlane, SupportPlane
from edgegrasp_model.scene.cloud import MAX_DISTANCE, CanonicalFrame, CheckedCloud, thinned
from edgegrasp_model.scene.regions import inside_workspace
from edgegrasp_model.scene.segment import Segmentation

THICK = 0.006  # metres from a plane within which points may belong to it
MOST_MARGIN = 0.02  # metres over it that belong to it at most; THICK do at least
GIVEN_MARGIN = 0.005  # metres over a plane that is given
DEVIATIONS = 6.0  # medians of its own points' distances that still belong to it
TILT = math.radians(30)  # between the plane and a given `up`
CLOSE, CLOSER = 0.08, (0.008, 0.005, 0.004)  # metres around an object; from the plane there
FEWEST = 60  # points that a plane is fitted to, and by which its residual is measured
CELL = 0.02  # metres, in which surfaces are counted
BELOW_WORKSPACE = 0.05  # metres, at most, from a given support up to the workspace over it
TRIES, SAMPLE = 150, 1200  # planes tried, and points that judge them
SUPPORT_STREAM = 2  # random stream of one request
# Of depths that a known plane corrects:
NEAR = 0.01  # metres from the plane within which points belong to it
FLAT = 0.35  # of NEAR: largest median distance of a plane's points (a wall's is 0.5)
MIN_SHARE = 0.1  # of the points that the plane must hold


@dataclass(frozen=True)
class Support:
    """A support plane and how well the points agree with it; cloud frame."""

    plane: SupportPlane
    frame: CanonicalFrame  # its z is the height over the plane
    least: float  # metres above it that always belong to it
    residual: float = math.nan  # metres, median distance of its points; NaN where it is not seen
    share: float = 0.0  # of the points that lie in it

    @property
    def normal(self) -> Float64:
        """(3,) unit."""
        return np.asarray(self.frame.T_canonical_cloud[2, :3])

    @property
    def margin(self) -> float:
        """Metres over it that belong to it."""
        if math.isnan(self.residual):
            return self.least
        return max(min(DEVIATIONS * self.residual, MOST_MARGIN), self.least)

    def heights(self, points: Float32) -> Float32:
        """Heights (N,) of points (N, 3) over it, metres."""
        heights: Float32 = points @ self.normal.astype(np.float32)
        return heights + np.float32(self.frame.T_canonical_cloud[2, 3])


def choose_support(
    points: Float32,
    viewpoint: Float64 | None,
    inside: Bools,
    shown: Segmentation | None,
    objects: Bools,
    options: DetectOptions,
    warnings: list[str],
) -> Support | None:
    """The support plane of a request.

    Args:
        points: (N, 3) cloud frame, metres.
        viewpoint: (3,) the camera, or the mean of several; None: unknown.
        inside: (N,) which of them lie in the workspace.
        shown: What the network says of them, where it was asked.
        objects: (N,) which of them are of an object.
        options: support, up, workspace and seed.
        warnings: Gets what is wrong with it, or that there is none.
    """
    request = options.support
    if request is None or len(points) == 0:
        return None
    up = options.known_up
    found: Support | None
    if isinstance(request, SupportPlane):
        # A bin's floor is not measured by the table around it; a followed object's workspace is
        # no bin.
        around = np.inf if options.follows_only else BELOW_WORKSPACE * np.abs(request.normal)
        over = inside_workspace(points, options.workspace, around)
        found = measured(points[over], viewpoint, request, GIVEN_MARGIN)
    else:
        rng = np.random.default_rng([options.seed, SUPPORT_STREAM])
        if isinstance(request, RansacPlane):
            weight = by_surface(points) * inside
            plane = fit_plane(points, viewpoint, weight, rng, up, request.max_tilt)
            found = None if plane is None else measured(points, viewpoint, plane, request.distance)
            found = None if found is None or found.share < request.min_share else found
        else:
            assert shown is not None
            found = _fitted(points, viewpoint, shown, objects, up, rng)
        if found is None:
            warnings.append(
                "no support plane is seen: objects are returned without one. Send support, or the "
                "true up, if there is one in view."
            )
    if found is not None and viewpoint is not None and found.plane.heights(viewpoint) < 0:
        warnings.append(
            "the viewpoint lies below the support plane: check viewpoint, up and support."
        )
    return found


def _fitted(
    points: Float32,
    viewpoint: Float64 | None,
    shown: Segmentation,
    objects: Bools,
    up: Float64 | None,
    rng: np.random.Generator,
) -> Support | None:
    """The plane of the points classified as support."""
    on, held = np.flatnonzero(shown.support > 0.5), np.flatnonzero(objects)
    part, around = points[on[thinned(len(on))]], points[held[thinned(len(held), 500)]]
    weight, up = np.ones(len(part)), shown.up if up is None else up
    plane = fit_plane(part, viewpoint, weight, rng, up)
    if plane is not None and len(held) and np.median(plane.heights(around)) < -MOST_MARGIN:
        # This plane is the top of something larger, and the objects stand below it.
        weight[plane.heights(part) > -MOST_MARGIN] = 0.0
        plane = fit_plane(part, viewpoint, weight, rng, up)
    if plane is None:
        return None
    return measured(part, viewpoint, _close_to(plane, part, around), THICK)


def _close_to(plane: SupportPlane, points: Float32, objects: Float32) -> SupportPlane:
    """The plane of the points (N, 3) close to objects (M, 3): of a bin's floor, not the table's."""
    if len(objects) == 0:
        return plane
    apart, _ = cKDTree(objects).query(points, distance_upper_bound=CLOSE)
    held = np.isfinite(apart) & (np.abs(plane.heights(points)) < MOST_MARGIN)
    near, normal, offset = points[held].astype(np.float64), np.array(plane.normal), plane.offset
    if len(near) < FEWEST:
        return plane
    for within in CLOSER:
        height = near @ normal - offset
        near = near[np.abs(height - np.median(height)) < within]
        if len(near) < FEWEST:
            break
        normal, offset = _least_squares(near, normal)
    x, y, z = normal.tolist()
    return SupportPlane(normal=(x, y, z), offset=offset)


def _least_squares(points: Float64, toward: Float64) -> tuple[Float64, float]:
    """Normal (3,), on the side of `toward` (3,), and offset of the plane through points (N, 3)."""
    middle = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - middle).T))  # ascending
    normal = vectors[:, 0] if vectors[:, 0] @ toward >= 0 else -vectors[:, 0]
    return normal, float(normal @ middle)


def by_surface(points: Float32) -> Float64:
    """Weight of each point (N, 3), so that equal areas count alike."""
    cell = np.floor(points / CELL).astype(np.int64)
    _, which, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / count[which.reshape(-1)])


def fit_plane(
    points: Float32,
    viewpoint: Float64 | None,
    weight: Floats,
    rng: np.random.Generator,
    up: Float64 | None = None,
    max_tilt: float = TILT,
) -> SupportPlane | None:
    """The plane that holds the most of weighted points, facing the camera (RANSAC).

    Args:
        points: (N, 3) that may belong to it.
        viewpoint: (3,) the camera; None: unknown.
        weight: (N,) what each counts.
        rng: Source of the samples.
        up: (3,) unit; None: any tilt will do.
        max_tilt: Radians from `up`.

    Returns:
        The plane; None where there are too few points, or none of it is level enough.
    """
    held = np.flatnonzero(weight > 0)
    if len(held) < FEWEST:
        return None
    chosen = rng.choice(
        held, min(SAMPLE, len(held)), replace=False, p=weight[held] / weight[held].sum()
    )
    points = points[chosen].astype(np.float64)
    corners = points[rng.integers(len(points), size=(TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    wide = length > 1e-6
    normals, origin = normals[wide] / length[wide, None], corners[wide, 0]
    toward = _toward(viewpoint, origin, up)
    normals = np.where((np.einsum("td,td->t", normals, toward) < 0)[:, None], -normals, normals)
    if up is not None:
        level = normals @ up >= math.cos(max_tilt + 1e-9)
        normals, origin = normals[level], origin[level]
    if len(normals) == 0:
        return None
    heights = points @ normals.T - np.einsum("td,td->t", normals, origin)
    worth = (np.abs(heights) < THICK).sum(axis=0)
    best = int(worth.argmax())
    normal, offset = normals[best], float(normals[best] @ origin[best])
    for within in (1.0, 0.7, 0.5):
        near = np.abs(points @ normal - offset) < within * THICK
        if near.sum() < FEWEST // 2:
            break
        normal, offset = _least_squares(points[near], normal)
    if up is not None and normal @ up < math.cos(max_tilt + 1e-9):
        return None
    x, y, z = normal.tolist()
    return SupportPlane(normal=(x, y, z), offset=offset)


def _toward(viewpoint: Float64 | None, origin: Float64, up: Float64 | None) -> Float64:
    """Directions (T, 3) that normals should point toward: the camera, else up, else +z."""
    if viewpoint is not None:
        return np.asarray(viewpoint - origin)
    return np.broadcast_to(np.array([0.0, 0.0, 1.0]) if up is None else up, origin.shape)


def measured(
    points: Float32, viewpoint: Float64 | None, plane: SupportPlane, least: float
) -> Support:
    """The support of a plane, and how well points (N, 3) agree with it where it is seen.

    Args:
        points: Cloud frame.
        viewpoint: (3,) the camera; None: unknown.
        plane: Of the same frame.
        least: Metres over it that belong to it anyway.
    """
    sample = points[thinned(len(points))]
    frame = CanonicalFrame.of_scene(sample, plane.normal, viewpoint)
    frame.T_canonical_cloud[2, 3] = -plane.offset / np.linalg.norm(plane.normal)
    height = frame.points(sample)[:, 2]
    near = np.abs(height) < THICK
    # If the cloud was cut off above the plane, only objects on it are near.
    if near.sum() < FEWEST or (height[near] < 1e-4).mean() < 0.2:
        return Support(plane, frame, least)
    return Support(plane, frame, least, float(np.median(np.abs(height[near]))), float(near.mean()))


def correct_depth_scale(
    sent: CheckedCloud, plane: SupportPlane, viewpoints: Float64 | None, warnings: list[str]
) -> CheckedCloud:
    """Scale every view about its camera so that its support lies in the given plane.

    Args:
        sent: N points, in which the plane is seen.
        plane: The support plane, and the greatest depth error (max_depth_error).
        viewpoints: (W, 3) the cameras, metres; the cloud's `view_ids` are their rows.
        warnings: Gets the correction made, or why none was.

    Raises:
        InvalidRequest: There is no viewpoint to scale about.
    """
    if viewpoints is None:
        fix = "Send the camera's position: depths are corrected along its rays."
        raise InvalidRequest("options.viewpoint", "nothing", fix)
    several = len(viewpoints) > 1 and sent.view_ids is not None
    points = sent.points.copy()
    for number, viewpoint in enumerate(viewpoints):
        rows = np.flatnonzero(sent.view_ids == number) if several else slice(None)
        which = f"the depths of view {number}" if several else "the depths"
        scale = depth_scale(points[rows], viewpoint, plane)
        if scale is None:
            warnings.append(
                f"{which} are taken as they are: no support plane is seen within "
                f"options.support.max_depth_error ({plane.max_depth_error:g}) of its place."
            )
        elif round(scale, 3) != 1.0:
            warnings.append(f"{which} were multiplied by {scale:.3f}, as the support plane shows.")
            points[rows] = viewpoint + scale * (points[rows] - viewpoint)
    return replace(sent, points=points)


def depth_scale(points: Floats, viewpoint: Float64, plane: SupportPlane) -> float | None:
    """The factor on a view's depths that moves its points of the support into the plane.

    If several factors fit (the table, or the flat top of an object), the smallest one is taken, as
    nothing is seen below the table.

    Args:
        points: (N, 3) metres.
        viewpoint: (3,) metres.
        plane: The plane and the greatest depth error.

    Returns:
        The factor; None if the camera is not above the plane, is too high, or sees too little.
    """
    height = float(plane.heights(viewpoint))
    falls = height - plane.heights(points.astype(np.float64))
    if not NEAR < height < MAX_DISTANCE:
        return None
    # A scaled point lies in the plane if it is as far below the camera as the plane.
    factors = np.sort(height / falls[falls > 0.5 * height])
    reach = NEAR / height
    tried = np.arange(1.0 - plane.max_depth_error, 1.0 + plane.max_depth_error, reach / 10)
    held = np.searchsorted(factors, tried + reach) - np.searchsorted(factors, tried - reach)
    enough = max(MIN_SHARE * len(points), FEWEST)
    start, width = 0, 21  # number of factors from the rise of a peak to past it
    while start < len(tried):
        window = held[start : start + width]
        if window.max() >= enough:
            scale = _middle(factors, float(tried[start + int(window.argmax())]), reach)
            if scale is not None:
                return scale
            start += width - 1
        start += 1
    return None


def _middle(factors: Float64, scale: float, reach: float) -> float | None:
    """The median of the factors around one; None if they spread too much for a plane."""
    for _ in range(20):
        within = factors[np.abs(factors - scale) <= reach]
        scale = float(np.median(within))
    spread = float(np.median(np.abs(within - scale)))
    return scale if spread <= FLAT * reach else None
