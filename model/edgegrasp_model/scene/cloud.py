"""From the caller's array to the small, clean cloud with normals that the network sees."""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Array, Bools, Float32, Float64, Floats, Int64
from edgegrasp_camera.clouds import CloudInput as CloudInput
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.kernels import compiled
from edgegrasp_model.options import DetectOptions, SupportPlane, Workspace

MAX_CLOUD_EXTENT = 20.0  # metres; if most of a cloud is wider, it is probably in millimetres
MIN_CLOUD_EXTENT = 0.01  # metres; a narrower cloud is probably in kilometres
MAX_DISTANCE = 1000.0  # metres from the origin; beyond, float32 rounds by more than 0.03 mm
UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)  # of the canonical frame
MAX_VIEW_TANGENT = 1.2  # of half a depth camera's field of view
MAX_WIDE_TANGENT = 2.0  # of half a wide-angle camera's field of view
USUAL_DISTANCE = 0.8  # metres from an unknown camera to objects, and around them
SUBSAMPLE_SIZE = 6000  # points that represent a cloud in fits, means and views
LARGE_IMAGE = 704, 960  # rows and columns of an image from which every second one may be enough
HAND_REACH = 0.25  # metres around an object within which a hand that grasps it may collide
OUTLIER_PERCENT = 0.5  # of the points, cut off at each end of a range

Vectors = TypeVar("Vectors", bound=Floats)
Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class CheckedCloud:
    """The finite points of a cloud, and the per-point arrays sent with them."""

    points: Float32  # (N, 3) metres
    row: Int64  # (N,) each point's row in the cloud as sent
    rows_sent: int
    normals: Float32 | None = None  # (N, 3)
    segment_ids: Int64 | None = None  # (N,)
    view_ids: Int64 | None = None  # (N,)
    image_size: tuple[int, int] | None = None  # (H, W) of an organised cloud as sent
    step: int = 1  # every `step`-th row and column of it is kept
    warnings: tuple[str, ...] = ()

    def take(self, kept: Bools | Int64) -> "CheckedCloud":
        """Some of the points, by mask (N,) or indices; `row` still refers to the cloud as sent."""
        place = np.flatnonzero(kept) if kept.dtype == np.bool_ else kept
        beside = {name: getattr(self, name) for name in ("normals", "segment_ids", "view_ids")}
        arrays = {name: array[place] for name, array in beside.items() if array is not None}
        points = self.points.take(place, axis=0)  # many times faster than indexing
        return replace(self, points=points, row=self.row[place], **arrays)

    def looks_along_z(self) -> bool:
        """Whether it is an image whose columns run along x and rows along y, seen from the origin.

        The image of a camera above a table looks mirrored from a robot's base below the table.
        """
        if self.image_size is None:
            return False
        down, right = np.divmod(subsample(self.row), self.image_size[1])
        x, y, z = subsample(self.points).T
        with np.errstate(all="ignore"):  # NaN of a single row or column, which is false
            along = np.corrcoef(right, x / z)[0, 1], np.corrcoef(down, y / z)[0, 1]
        return bool(np.min(along) > 0.9)

    def projection(self, frame: "CanonicalFrame", eyes: Float64) -> Float64 | None:
        """The projection (3, 4) of canonical points into the image that was sent.

        Found by direct linear transformation; None without an image of a single camera. `eyes`
        (W, 3) are the cameras, canonical frame.
        """
        if self.image_size is None or len(eyes) > 1:
            return None
        row, (height, width) = subsample(self.row, 1000), self.image_size
        x = (2 * (row % width) + 1)[:, None] / width - 1
        y = (2 * (row // width) + 1)[:, None] / height - 1
        sight = unit(frame.points_from_cloud(subsample(self.points, 1000)) - eyes)
        none = np.zeros_like(sight)
        equations = np.block([[sight, none, -x * sight], [none, sight, -y * sight]])
        P = np.linalg.eigh(equations.T @ equations)[1][:, 0].reshape(3, 3)
        P *= np.sign((sight @ P[2]).sum())
        return np.column_stack([P, -P @ eyes[0]])


def check_cloud(cloud: object, num_approach_points: int = 1, thin: bool = False) -> CheckedCloud:
    """Check a caller's CloudInput or array of points, and drop holes: 0, 0, 0, or NaN in images.

    With `thin`, a large image whose pixels lie at most 1.25 mm apart loses every second row and
    column. InvalidRequest names `cloud`, `normals`, `colors`, `segment_ids` or `view_ids`.
    """
    sent = cloud if isinstance(cloud, CloudInput) else CloudInput(cloud)
    points: Any = sent.points
    if isinstance(points, np.ma.MaskedArray):
        points = points.filled(np.nan)
    is_array = isinstance(points, np.ndarray) and points.dtype in (np.float32, np.float64)
    if not is_array or points.ndim not in (2, 3) or points.shape[-1] != 3:
        fix = "Send float32 or float64 metres, (N, 3) or (H, W, 3), or depth_images."
        raise wrong_array("cloud", points, fix)
    size, said, image_size, step = points.size // 3, sent.warnings, None, 1
    row = np.arange(size)
    if holes := points.ndim == 3:
        # A single row of points, such as fused images, is not an image.
        image_size = None if 1 in points.shape[:2] else points.shape[:2]
        large = image_size is not None and np.greater_equal(image_size, LARGE_IMAGE).all()
        step = 2 if thin and large and _pixel_spacing(points) <= 0.00125 else 1
        row = row.reshape(points.shape[:2])[::step, ::step].reshape(-1)
        points = points[::step, ::step].reshape(-1, 3)
    if len(kept := _readings(points, holes)) < len(points):
        row, points = row[kept], points.take(kept, axis=0)
    if len(points) == 0:
        value = "no points" if size == 0 else "no finite points beside 0, 0, 0"
        raise InvalidRequest("cloud", value, "Send an image or points in metres.")
    low, high = (np.array([end(axis) for axis in points.T]) for end in (np.min, np.max))
    if not np.isfinite([low, high]).all():
        raise _not_finite(points, row)
    if (extent := float((high - low).max())) < MIN_CLOUD_EXTENT:
        said += (f"the cloud is {extent:.2g} m wide: send metres, or another depth_scale.",)
    if extent > MAX_CLOUD_EXTENT:
        near = _without_far_points(points)
        said += (
            f"{len(points) - len(near)} points are left out: they lie more than "
            f"{MAX_CLOUD_EXTENT / 2:g} m from the middle of the cloud.",
        )
        points, row = points[near], row[near]
        low, high = points.min(axis=0), points.max(axis=0)
    if (furthest := float(np.maximum(-low, high).max())) > MAX_DISTANCE:
        value = f"points {furthest:.4g} m from the origin, where float32 is too coarse"
        fix = "Subtract an origin near the cloud from all positions, and add it to the grasps."
        raise InvalidRequest("cloud", value, fix)
    if len(points) < num_approach_points:
        value = f"{len(points)} points for num_approach_points = {num_approach_points}"
        fix = "Send more points or lower options.num_approach_points."
        raise InvalidRequest("cloud", value, fix)
    if sent.colors is not None:
        _checked_array("colors", sent.colors, size, row[:0])  # no grasp depends on them
    arrays = {
        name: _checked_array(name, array, size, row)
        for name in ("normals", "segment_ids", "view_ids")
        if (array := getattr(sent, name)) is not None
    }
    points = np.require(points, np.float32, ("C", "W"))  # compiled loops need writable ones
    return CheckedCloud(
        points, row, size, **arrays, image_size=image_size, step=step, warnings=said
    )


def _readings(points: Floats, holes: bool) -> Int64:
    """Rows of the points (N, 3) that are readings; with `holes`, NaN and infinity are not."""
    x, y, z = points.T
    seen = (x != 0) | (y != 0) | (z != 0)  # many drivers send 0, 0, 0 where there is no reading
    if holes:
        seen &= np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    return np.flatnonzero(seen)


def _pixel_spacing(image: Floats) -> float:
    """Median distance, metres, between neighbouring pixels of an image (H, W, 3); NaN if none."""
    with np.errstate(invalid="ignore"):  # holes may be infinite
        apart = np.linalg.norm(image[::16, 1::8] - image[::16, :-1:8], axis=-1)
    apart = apart[(apart > 0) & (apart < np.inf)]  # holes may be equal, too
    return float(np.median(apart)) if len(apart) else math.nan


def subsample(rows: NDArray[Scalar], most: int = SUBSAMPLE_SIZE) -> NDArray[Scalar]:
    """Rows spread evenly over all of an array, `most` of them or a few more."""
    return rows[:: max(len(rows) // most, 1)]


def grid_cells(points: Floats, side: float) -> tuple[Int64, Int64]:
    """The cell (N,), from 0, of each point (N, D), and the number (C,) of points in each cell.

    Cells are `side` metres wide.
    """
    # Comparing numbers is many times faster than comparing rows.
    keys = np.floor(points / side) @ 10.0 ** (5.0 * np.arange(points.shape[1]))
    _, cell, count = np.unique(keys, return_inverse=True, return_counts=True)
    return cell, count


def inside_workspace(points: Float32, box: Workspace | None, around: Floats | float = 0.0) -> Bools:
    """Which points (N, 3) lie in a box grown by `around` metres; all if there is no box."""
    if box is None:
        return np.ones(len(points), dtype=bool)
    low, high = np.asarray(box.min) - around, np.asarray(box.max) + around
    x, y, z = ((axis >= a) & (axis <= b) for axis, a, b in zip(points.T, low, high, strict=True))
    return np.asarray(x & y & z)


def unit(vectors: Vectors) -> Vectors:
    """Scale vectors (..., 3) to length 1; those of almost zero length stay short."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return cast("Vectors", vectors / np.maximum(length, 1e-9))


def pose_matrix(turn: Floats, place: ArrayLike) -> Float64:
    """The pose T (..., 4, 4) of a rotation (..., 3, 3) and a translation (..., 3)."""
    T = np.zeros((*turn.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = turn, place, 1.0
    return T


def assumed_viewpoint(
    sent: CheckedCloud, options: DetectOptions, warnings: list[str]
) -> tuple[float, float, float] | None:
    """The assumed position of the camera that saw a cloud, if a request does not give it.

    None: no single position sees all of it.

    InvalidRequest: an option needs the position to the millimetre.
    """
    points, wide = sent.points, sent.looks_along_z()
    if seen_from_origin(points, options.known_up, MAX_WIDE_TANGENT if wide else MAX_VIEW_TANGENT):
        warnings.append(
            "viewpoint is not given: the camera is assumed at the origin, as the whole cloud "
            "lies in front of it; if the camera is elsewhere, send its position."
        )
        return 0.0, 0.0, 0.0
    if isinstance(options.support, SupportPlane) and options.support.max_depth_error > 0.0:
        fix = "Send the camera's position: depths are corrected along its rays."
        raise InvalidRequest("options.viewpoint", "nothing", fix)
    if options.robot is not None and options.robot.avoid_unseen:
        fix = "Send the option viewpoint, or depth images with their poses."
        raise InvalidRequest("options.robot.avoid_unseen", "true, without a camera's position", fix)
    inside = inside_workspace(points, options.workspace, HAND_REACH)
    up = UP if options.known_up is None else options.known_up
    eye = likely_viewpoint(points[inside] if inside.any() else points, up)
    if eye is None:
        warnings.append(
            "viewpoint is not given, and no position sees all of the cloud: send the camera's "
            "position; if there are several cameras, their positions and view_ids."
        )
        return None
    x, y, z = eye.tolist()
    warnings.append(
        f"viewpoint is not given: the camera is assumed at ({x:.2f}, {y:.2f}, {z:.2f}), from where "
        "the fewest points are hidden; send its position."
    )
    return x, y, z


def seen_from_origin(
    points: Float32, up: ArrayLike | None, max_tangent: float = MAX_VIEW_TANGENT
) -> bool:
    """Whether a camera at the origin that looks along +z may have seen the points (N, 3).

    If `up` (3,) is known, the camera must look at most 30 degrees upward.
    """
    x, y, z = points.T
    if len(points) == 0 or z.min() <= 0 or np.quantile(np.hypot(x, y) / z, 0.99) > max_tangent:
        return False
    middle = points.mean(axis=0, dtype=np.float64)
    upward = 0.0 if up is None else np.dot(up, middle) / np.linalg.norm(up)
    return bool(upward <= 0.5 * np.linalg.norm(middle))


def likely_viewpoint(points: Float32, up: ArrayLike) -> Float64 | None:
    """The probable camera position (3,): above points (N, 3), where the fewest are hidden.

    Of the positions from which nothing is hidden, it is the one nearest to USUAL_DISTANCE and to 30
    degrees off `up` (3,). It turns with the cloud, up to rounding. None: several cameras saw the
    points, as some are hidden from every position.
    """
    some = subsample(points, 20_000)
    apart = np.linalg.norm(some - np.median(some, axis=0), axis=1)
    beside = np.linalg.norm(some - some[apart.argmin()], axis=1)
    near = subsample(some[beside < USUAL_DISTANCE])
    frame = CanonicalFrame.from_scene(near, up, None)
    seen = frame.points_from_cloud(near)
    middle = np.median(seen, axis=0)

    def hidden(eyes: Float64, edge: int) -> Float64:
        ahead = unit(middle - eyes)
        across = unit(np.cross(ahead, (0.0, 1e-3, 1.0)))  # not zero where `ahead` is vertical
        turn = np.stack([across, np.cross(ahead, across), ahead], axis=2)
        return _hidden_share(seen, eyes, turn, np.linalg.norm(middle - eyes, axis=1), edge)

    def best(eyes: Float64) -> Float64:
        distance = np.linalg.norm(eyes - middle, axis=1)
        tilt = np.arccos(np.clip((eyes - middle)[:, 2] / distance, -1.0, 1.0))
        unusual = (tilt - 0.5) ** 2 + np.log(distance / USUAL_DISTANCE) ** 2
        return np.asarray(eyes[np.argmin(hidden(eyes, 0) + 0.012 * unusual)])

    # Positions spread evenly over half of a sphere, then around the best one.
    z, turn = 1.0 - (np.arange(60) + 0.5) / 60, np.pi * (3.0 - np.sqrt(5.0)) * np.arange(60)
    level = np.sqrt(1.0 - z * z)
    ways = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)
    eye, step = best(middle + USUAL_DISTANCE * ways), 0.2
    around = np.indices((3, 3, 3)).reshape(3, -1).T - 1.0
    while step > 0.01:
        eye, step = best(eye + step * around), 0.7 * step
    # Near edges, points behind show through sparse and noisy ones.
    several = hidden(eye[None], 1)[0] > 0.003
    return None if several else frame.points_to_cloud(eye).astype(np.float64)


@compiled("contract")
def _hidden_share(
    points: Float64, eyes: Float64, turn: Float64, distance: Float64, edge: int
) -> Float64:
    """Share (K,) of points (N, 3) that lie behind others as seen from each of the eyes (K, 3).

    Columns of `turn` (K, 3, 3) are the axes of cameras; cells are 11 mm wide at a `distance` (K,).
    Points up to 15 mm behind others count as seen, from 45 mm as hidden, between that in part. A
    point must lie behind the first point of each occupied cell up to `edge` cells from its own.
    """
    share, half = np.zeros(len(eyes)), 72
    cell, away = np.empty((len(points), 2), np.int64), np.empty(len(points))
    for k in range(len(eyes)):
        nearest, cells = np.full((2 * half, 2 * half), np.inf), distance[k] / 0.011
        in_view = (points - eyes[k]) @ turn[k]
        for n in range(len(points)):
            x, y, z = in_view[n]
            cell[n, 0], cell[n, 1], away[n] = -1, -1, np.sqrt(x * x + y * y + z * z)
            if z < 0.05:  # behind the camera
                share[k] += 1.0
                continue
            i, j = np.floor(x / z * cells) + half, np.floor(y / z * cells) + half
            if edge <= i < 2 * half - edge and edge <= j < 2 * half - edge:
                cell[n, 0], cell[n, 1] = int(i), int(j)
                nearest[int(i), int(j)] = min(nearest[int(i), int(j)], away[n])
        for n in range(len(points)):
            i, j, first = cell[n, 0], cell[n, 1], 0.0
            if i >= 0:
                for a in range(i - edge, i + edge + 1):
                    for b in range(j - edge, j + edge + 1):
                        first = max(first, nearest[a, b]) if nearest[a, b] < np.inf else first
                share[k] += min(max((away[n] - first - 0.015) / 0.03, 0.0), 1.0)
    return share / len(points)


def usual_up(forward: Float64) -> Float64:
    """The up direction (3,) in most clouds of a camera that looks along `forward` (3,), unit.

    It is -y in a camera's frame, whose z points forward, and +z in the frames of robots.
    """
    return np.array([0.0, -1.0, 0.0]) if abs(forward[2]) > 0.7 else np.array([0.0, 0.0, 1.0])


def _checked_array(field: str, array: object, size: int, row: Int64) -> Array:
    """The given rows of a per-point array, which has one integer or three floats for each point."""
    width = 1 if field.endswith("_ids") else 3
    kinds, kind = ("iu", "one integer") if width == 1 else ("fui", "three numbers")
    if (
        not isinstance(array, np.ndarray)
        or array.dtype.kind not in kinds
        or array.size != width * size
        or (width > 1 and array.shape[-1:] != (width,))
    ):
        raise wrong_array(field, array, f"Send {kind} for each of the cloud's {size} points.")
    if width == 1:
        ids = array.reshape(-1)[row]
        for end in (int(ids.min(initial=0)), int(ids.max(initial=0))):
            if not -(2**31) <= end < 2**31:
                raise InvalidRequest(field, f"the number {end}", "Send 32-bit numbers.")
        return ids.astype(np.int64)
    values = np.ascontiguousarray(array.reshape(-1, width)[row], dtype=np.float32)
    if not np.isfinite(values).all():
        bad = int(row[np.argmin(np.isfinite(values).all(axis=1))])
        raise InvalidRequest(field, f"NaN or infinity in row {bad}", "Send finite numbers.")
    return values


@dataclass(frozen=True)
class Cloud:
    """Points and their unit normals, metres."""

    points: Float32  # (N, 3)
    normals: Float32  # (N, 3)


def wrong_array(field: str, array: object, fix: str) -> InvalidRequest:
    """The error for a value that is not an array, or is an array of the wrong type or shape."""
    value = f"a {type(array).__name__}"
    if isinstance(array, np.ndarray):
        value = f"dtype {array.dtype}, shape {array.shape}"
    return InvalidRequest(field, value, fix)


def _not_finite(points: Floats, row: Int64) -> InvalidRequest:
    finite = np.isfinite(points).all(axis=1)
    bad = f"the first in row {row[np.argmin(finite)]}"
    value = f"{int((~finite).sum())} points with NaN or infinity, {bad}"
    return InvalidRequest("cloud", value, "Remove points without a finite x, y, z.")


def _without_far_points(points: Floats) -> Int64:
    """Rows of the points (N, 3) without stray readings far away."""
    distance = np.abs(points.astype(np.float64) - np.median(points, axis=0)).max(axis=1)
    bulk = 2 * float(np.median(distance))
    if bulk > MAX_CLOUD_EXTENT:
        value = f"an extent of {bulk:.4g} m, which suggests millimetres"
        fix = "Send metres: divide by 1000, or send a depth image with depth_scale 0.001."
        raise InvalidRequest("cloud", value, fix)
    return np.flatnonzero(distance <= MAX_CLOUD_EXTENT / 2)


class Voxels(NamedTuple):
    """The occupied voxels of a cloud, sorted by position: the order of the points has no effect."""

    of_point: Int64  # (N,) voxel of each point
    counts: Int64  # (V,) points in each

    def mean(self, values: Floats) -> Float32:
        """Mean (V, 3) of a vector of each point (N, 3)."""
        sums = [np.bincount(self.of_point, values[:, axis], len(self.counts)) for axis in range(3)]
        return (np.stack(sums, axis=1) / self.counts[:, None]).astype(np.float32)

    def commonest(self, labels: NDArray[np.integer]) -> Int64:
        """Most common label (V,) in each voxel, from labels (N,); the lowest one on ties."""
        low, one = labels.min(), np.ones(len(labels), dtype=np.int64)
        tally = coo_array((one, (self.of_point, labels - low))).tocsr()  # (V, labels); few labels
        voxel = np.repeat(np.arange(len(self.counts)), np.diff(tally.indptr))
        order = np.lexsort((-tally.indices, tally.data, voxel))
        return np.asarray(tally.indices[order[tally.indptr[1:] - 1]] + low, dtype=np.int64)


def voxelise(points: Floats, voxel_size: float, most: float = math.inf) -> Voxels:
    """Sort points (N, 3) into voxels with edges of `voxel_size` metres.

    InvalidRequest: there are more than `most`.
    """
    # Axis by axis is three times as fast as all at once.
    cells = [((axis - float(axis.min())) / voxel_size).astype(np.int64) for axis in points.T]
    # Sorted by cubes of 8 voxels a side, so loops over hands skip many distant points at a time.
    keys, cube = np.zeros(len(points), dtype=np.int64), 8
    for cell in cells:
        keys = keys * (cell.max() // cube + 1) + cell // cube
    for cell in cells:
        keys = keys * cube + cell % cube
    _, voxel, count = np.unique(keys, return_inverse=True, return_counts=True)
    if len(count) > most:
        size = " x ".join(f"{length:.2g}" for length in np.ptp(points, axis=0))
        value = f"{len(count)} voxels of {1000 * voxel_size:g} mm around objects, in {size} m"
        fix = "Send a workspace around the objects, or a support plane: at most "
        fix += f"{most} are accepted, fewer where the deadline is near."
        raise InvalidRequest("options.workspace", value, fix)
    return Voxels(voxel, count)


def clean_cloud(
    sent: CheckedCloud,  # N points
    voxels: Voxels,  # of these points
    middles: Float32,  # (V, 3) the voxels' mean points, canonical frame, metres
    frame: "CanonicalFrame",
    eyes: Float64,  # (W, 3) the cameras, canonical frame
) -> tuple["Cloud", Bools]:
    """The voxels without outliers, and a mask (V,) of these.

    Normals are those that were sent, else estimates that are turned toward the camera.
    """
    tree = cKDTree(middles, balanced_tree=False)  # faster for one round of queries
    distance, near = map(np.asarray, tree.query(middles, k=range(1, min(20, len(middles)) + 1)))
    kept = np.ones(len(middles), dtype=bool)
    if len(middles) > 8:  # outliers lie unusually far from their 8 nearest points
        mean = distance[:, 1:9].mean(axis=1)
        kept = mean <= mean.mean() + 2.5 * mean.std()
    points, normals = middles[kept], smallest_variance_directions(middles, near)[kept]
    seen_from = eyes.astype(np.float32)
    if len(eyes) > 1 and sent.view_ids is not None:
        seen_from = seen_from[voxels.commonest(sent.view_ids)[kept]]
    away = np.einsum("nd,nd->n", normals, seen_from - points) < 0
    normals = np.where(away[:, None], -normals, normals)
    if sent.normals is not None:
        given = frame.directions_from_cloud(voxels.mean(unit(sent.normals))[kept])
        none = np.linalg.norm(given, axis=1) < 1e-3  # opposite normals in a voxel
        normals = np.where(none[:, None], normals, unit(given)).astype(np.float32)
    return Cloud(points, normals), kept


@compiled("contract")
def smallest_variance_directions(points: Float32, rows: Int64) -> Float32:
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
        for _ in range(6):  # rounds of Jacobi's method; more change nothing
            for turn in range(3):
                _jacobi_rotation(spread, axes, turn % 2, 1 if turn == 0 else 2)
            off = abs(spread[0, 1]) + abs(spread[0, 2]) + abs(spread[1, 2])
            if off <= 1e-12 * (spread[0, 0] + spread[1, 1] + spread[2, 2]):
                break
        least = 0
        for d in range(1, 3):
            least = d if spread[d, d] < spread[least, least] else least
        for d in range(3):
            direction[m, d] = axes[d, least]
    return direction


@compiled("contract")
def _jacobi_rotation(matrix: Float64, axes: Float64, p: int, q: int) -> None:
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


@dataclass(frozen=True)
class CanonicalFrame:
    """z is up, x points horizontally toward the camera, the origin is the points' mean."""

    T_canonical_cloud: Float64  # (4, 4)

    @classmethod
    def from_scene(
        cls,
        points: Float32,  # (N, 3) metres; without any, the origin stays
        up: ArrayLike,  # (3,) of any length but zero
        # (3,); if unknown or straight above, x points to the farthest point
        viewpoint: ArrayLike | None,
    ) -> Self:
        """The frame of a scene; it rotates and moves with the scene."""
        points = points if len(points) else np.zeros((1, 3), dtype=np.float32)
        origin = points.mean(axis=0, dtype=np.float64)
        z = np.asarray(up, dtype=np.float64)
        z = z / np.linalg.norm(z)
        eyes = np.empty((0, 3)) if viewpoint is None else np.asarray([viewpoint])
        for offsets in (eyes - origin, points - origin, np.eye(3)):
            level = offsets - (offsets @ z)[:, None] * z  # as seen from above
            length = np.linalg.norm(level, axis=1)
            if length.max(initial=0.0) >= 1e-3:  # metres; shorter ones have no direction
                x = level[length.argmax()] / length.max()
                break
        turn = np.stack([x, np.cross(z, x), z])
        return cls(pose_matrix(turn, -turn @ origin))

    def points_from_cloud(self, points: ArrayLike) -> Float64:
        """Transform points (..., 3) from the cloud's frame to this one."""
        return self.directions_from_cloud(points) + self.T_canonical_cloud[:3, 3]

    def directions_from_cloud(self, directions: ArrayLike) -> Float64:
        """Transform directions (..., 3) from the cloud's frame to this one."""
        return np.asarray(directions, dtype=np.float64) @ self.T_canonical_cloud[:3, :3].T

    def poses_from_cloud(self, T_cloud_hand: ArrayLike) -> Float32:
        """Transform poses (..., 4, 4) from the cloud's frame to this one."""
        return (self.T_canonical_cloud @ np.asarray(T_cloud_hand, np.float64)).astype(np.float32)

    def points_to_cloud(self, points: ArrayLike) -> Float32:
        """Transform points (..., 3) from this frame to the cloud's."""
        return self.directions_to_cloud(np.asarray(points) - self.T_canonical_cloud[:3, 3])

    def directions_to_cloud(self, directions: ArrayLike) -> Float32:
        """Transform directions (..., 3) from this frame to the cloud's."""
        turned = np.asarray(directions, dtype=np.float64) @ self.T_canonical_cloud[:3, :3]
        return turned.astype(np.float32)

    def poses_to_cloud(self, T_canonical_hand: ArrayLike) -> Float32:
        """Transform poses (..., 4, 4) from this frame to the cloud's."""
        T_cloud_canonical = np.linalg.inv(self.T_canonical_cloud)
        return (T_cloud_canonical @ np.asarray(T_canonical_hand, np.float64)).astype(np.float32)
