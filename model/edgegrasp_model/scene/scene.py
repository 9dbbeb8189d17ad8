"""A request's scene: the small clean cloud in the canonical frame, and what else is there."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import (
    DetectOptions,
    RansacPlane,
    Region,
    SupportPlane,
    Workspace,
)
from edgegrasp_model.results import OBSTACLE, SUPPORT, UNLABELLED
from edgegrasp_model.scene.cloud import (
    UP,
    CanonicalFrame,
    CheckedCloud,
    Cloud,
    Neighbors,
    Voxels,
    assumed_viewpoint,
    estimate_normals,
    orient_normals,
    statistical_outlier_removal,
    voxelise,
)
from edgegrasp_model.scene.depth_scale import correct_depth_scale
from edgegrasp_model.scene.obstacles import SolidBoxes
from edgegrasp_model.scene.regions import (
    check_pixel,
    check_region,
    chosen_objects,
    has_rows,
    inside_region,
)
from edgegrasp_model.scene.support import Seen, Support, find_support, measured, raised
from edgegrasp_model.scene.things import (
    BOX_FLOOR,
    CELL,
    FINE_CELL,
    FIXED,
    UNKNOWN,
    PlaneView,
    find_things,
    without_speckles,
)

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

MIN_POINTS = 4  # fewer make no surface
MIN_NORMAL = 1e-3  # a voxel's mean normal shorter than this has no direction
SIDE_DEPTH = 0.006  # metres inside a side of the workspace where an object may be cut off
MAX_VOXELS = 200_000  # some seconds of work; a tabletop has 3,000 to 30,000
SUPPORT_STREAM = 2  # random stream of one request
REACH = 0.25  # metres around a thing in which a hand at it may meet something
PLAN_CELL = 0.05  # metres
WALL = 0.008  # metres, at least, inside a side of the workspace where a wall at it is seen
BELOW_WORKSPACE = 0.05  # metres, at most, from a given support up to the workspace over it
MIN_BOX_FLOOR = 500  # points of a box's floor that make it the support of what is in the box
ON = 10_000  # points of the support, at least, that tell its outline


@dataclass(frozen=True)
class Scene:
    """What grasps are looked for in; canonical frame. V points are left of the cloud."""

    frame: CanonicalFrame
    cloud: Cloud  # V points
    points_in_cloud: Float32  # (V, 3) the same in the cloud's frame
    point_of_row: Int64  # (R,) point that each row of the cloud as sent went into; -1: none
    approach_allowed: Bools  # (V,) in the approach region
    contact_allowed: Bools  # (V,) in the contact region
    object_of_point: Int64  # (V,) number of the object that each point is of; FIXED; UNKNOWN
    support: SupportPlane | None
    obstacles: SolidBoxes | None  # beside the cloud; None: there are none
    viewpoint: Float32 | None = None  # (3,) the camera, where there is one and only one
    at_side: Bools | None = None  # (V,) where a side of the workspace cuts the cloud off


@dataclass(frozen=True)
class SelectedPoints:
    """What is left of a cloud: M points of things and of what is around them."""

    sent: CheckedCloud  # M points
    number: Int64  # (M,) the object that each is of; FIXED: of furniture; UNKNOWN: of neither
    support: Support | None
    up: Float64  # (3,) unit, away from gravity, cloud frame
    viewpoints: Float64 | None  # (W, 3) the cameras
    labels: Int64  # (R,) of the rows of the cloud as sent, as in `DebugInfo`


def select_points(
    sent: CheckedCloud,
    options: DetectOptions,
    counts: dict[str, int],
    warnings: list[str],
) -> SelectedPoints:
    """Correct depths, remove the support, number the objects, drop what no hand can meet.

    Raises:
        InvalidRequest: A region speaks of rows or segments that the cloud does not have, or the
            views do not suit the viewpoints, or there are none to correct depths from.
    """
    viewpoints = camera_positions(sent, options)
    check_pixel(sent, options)
    for field in ("approach_region", "contact_region"):
        if (region := getattr(options, field)) is not None:
            check_region(region, sent, field)
    counts["points"] = len(sent.points)
    if isinstance(options.support, SupportPlane) and options.support.max_depth_error > 0.0:
        sent = correct_depth_scale(sent, options.support, viewpoints, warnings)
    sent = near_workspace(sent, options.workspace, REACH)
    inside = inside_workspace(sent.points, options.workspace)
    counts["in_workspace"] = int(inside.sum())
    camera = None if viewpoints is None else viewpoints.mean(axis=0)
    seen = Seen(sent.points, camera, sent.at_border())
    support = choose_support(seen, inside, options, warnings)
    up = _up(options, support)
    if support is None:
        counts["above_support"] = int(inside.sum())
        number = np.where(inside, _given_numbers(sent), UNKNOWN)
        labels = _labels(sent, number)
        number = chosen_objects(number, sent, options, warnings)
        return SelectedPoints(sent, number, None, up, viewpoints, labels)
    said: list[str] = []
    standing = _standing_on(support, sent, seen, inside, options, said)
    floor = standing.number == BOX_FLOOR
    if floor.sum() > MIN_BOX_FLOOR and not isinstance(options.support, SupportPlane):
        # Things in an open box stand on its floor.
        walls = standing.sent.row[standing.number == FIXED]
        support, said = raised(support, standing.seen.take(np.flatnonzero(floor))), []
        standing = _standing_on(support, sent, seen, inside, options, said, walls)
    warnings += said
    counts["above_support"] = int(standing.inside.sum())
    labels = _labels(standing.sent, standing.number)
    labels[standing.on] = SUPPORT
    number = chosen_objects(standing.number, standing.sent, options, warnings)
    kept = near_things(standing.plan, number)
    near, number = standing.sent.take(kept), number[kept]
    return SelectedPoints(near, number, support, up, viewpoints, labels)


def _labels(sent: CheckedCloud, number: Int64) -> Int64:
    """Labels (R,) of the rows of a cloud as sent, of which M are numbered."""
    labels = np.full(sent.rows_sent, UNLABELLED, dtype=np.int64)
    labels[sent.row] = np.where(number >= 0, number, OBSTACLE)
    labels[sent.row[number == BOX_FLOOR]] = SUPPORT
    return labels


class _Standing(NamedTuple):
    """M points over the support."""

    sent: CheckedCloud
    seen: Seen
    inside: Bools  # (M,) in the workspace
    plan: Float64  # (M, 2) metres along the support
    number: Int64  # (M,) as from `find_things`
    on: Int64  # rows of the cloud as sent that belong to the support


def _standing_on(
    support: Support,
    sent: CheckedCloud,
    seen: Seen,
    inside: Bools,
    options: DetectOptions,
    warnings: list[str],
    walls: Int64 | None = None,
) -> _Standing:
    """What stands on a support; of points that are known as walls, nothing does."""
    height, margin, thick = support.heights(seen)
    # Where the cloud was cut off above the support, what is near it does not tell its outline.
    near = (np.abs(height) < thick) & math.isfinite(support.spread)
    on, above = np.flatnonzero(near), np.flatnonzero(height > margin)
    each = max(len(on) // ON, 1)
    on_plan = support.plan(sent.points[on[::each]])
    belongs = sent.row[np.abs(height) <= margin]
    sent, seen, inside = sent.take(above), seen.take(above), inside[above]
    plan = support.plan(sent.points)
    height, margin = height[above], margin[above]
    number = np.full(len(plan), FIXED)
    rest = np.flatnonzero(~np.isin(sent.row, [] if walls is None else walls))
    border = None if seen.at_border is None else seen.at_border[rest]
    view = PlaneView(plan[rest], height[rest], margin[rest], on_plan, border, each)
    number[rest] = _numbers(view, sent.take(rest), seen.take(rest), inside[rest], options, warnings)
    return _Standing(sent, seen, inside, plan, number, belongs)


def build_scene(
    selected: SelectedPoints,
    options: DetectOptions,
    voxel_size: float,
    counts: dict[str, int],
    max_voxels: int = MAX_VOXELS,
) -> Scene | None:
    """Voxelise what is left of a cloud, clean it, estimate its normals, find the regions.

    Args:
        selected: M points.
        options: workspace, regions and obstacles.
        voxel_size: Metres.
        counts: Gets the number of points left after each step.
        max_voxels: Most voxels that the cloud may have where grasps are looked for.

    Returns:
        The scene, or None where too few points are left to make a surface.

    Raises:
        InvalidRequest: The cloud has too many voxels.
    """
    sent, support, viewpoints = selected.sent, selected.support, selected.viewpoints
    if len(sent.points) == 0 or not (selected.number >= 0).any():
        counts |= {"voxels": 0, "kept": 0}
        return None
    first_viewpoint = None if viewpoints is None else viewpoints[0]
    frame = CanonicalFrame.of_scene(sent.points, selected.up, first_viewpoint)
    canonical = frame.points(sent.points)
    voxels = voxelise(canonical, voxel_size)
    counts["voxels"] = len(voxels.size)
    if counts["voxels"] > max_voxels:
        raise _too_many_voxels(counts["voxels"], max_voxels, voxel_size, sent, options)
    middles = voxels.mean(canonical)
    near = Neighbors.within(middles)
    kept = statistical_outlier_removal(near)
    counts["kept"] = int(kept.sum())
    if counts["kept"] < MIN_POINTS:
        return None
    normals = estimate_normals(middles, near)[kept]
    normals = _turned_normals(sent, middles[kept], normals, kept, voxels, frame, viewpoints)
    cloud = Cloud(middles[kept], normals)
    in_cloud = frame.points_in_cloud(middles)
    number = voxels.commonest(selected.number)[kept]

    def allowed(region: Region | None) -> Bools:
        if region is None:
            return np.asarray(number >= 0)
        return inside_region(region, in_cloud, voxels, sent)[kept] & (number >= 0)

    approach = allowed(options.approach_region)
    counts["in_approach_region"] = int(approach.sum())
    place = np.where(kept, np.cumsum(kept) - 1, -1)
    point_of_row = np.full(sent.rows_sent, -1, dtype=np.int64)
    point_of_row[sent.row] = place[voxels.voxel]
    obstacles = options.collision.obstacles
    return Scene(
        frame=frame,
        cloud=cloud,
        points_in_cloud=in_cloud[kept],
        point_of_row=point_of_row,
        approach_allowed=approach,
        contact_allowed=allowed(options.contact_region),
        object_of_point=number,
        support=None if support is None else plane_in_frame(support.plane, frame),
        at_side=near_workspace_side(in_cloud[kept], options.workspace, selected.up, sent.points),
        viewpoint=single_viewpoint(viewpoints, frame),
        obstacles=SolidBoxes.from_shapes(obstacles, frame) if obstacles else None,
    )


def _too_many_voxels(
    count: int, most: int, voxel_size: float, sent: CheckedCloud, options: DetectOptions
) -> InvalidRequest:
    size = " x ".join(f"{length:.2g}" for length in np.ptp(sent.points, axis=0))
    cropped = "no workspace" if options.workspace is None else "the workspace"
    return InvalidRequest(
        "options.workspace",
        f"{cropped}, which leaves {count} voxels of {1000 * voxel_size:g} mm in {size} m",
        f"Send a workspace around the objects, or a support plane: at most {most} are accepted.",
    )


def choose_support(
    seen: Seen, inside: Bools, options: DetectOptions, warnings: list[str]
) -> Support | None:
    """The support plane, given or found."""
    request = options.support
    if request is None or len(seen.points) == 0:
        return None
    up = None if options.up is None else np.asarray(options.up, dtype=np.float64)
    if isinstance(request, SupportPlane):
        # A bin's floor is not measured by the table around it.
        around = BELOW_WORKSPACE * np.abs(request.normal)
        over = inside_workspace(seen.points, options.workspace, around)
        found: Support | None = measured(seen.take(np.flatnonzero(over)), request)
    else:
        where = seen.take(np.flatnonzero(inside)) if isinstance(request, RansacPlane) else seen
        rng = np.random.default_rng([options.seed, SUPPORT_STREAM])
        found = find_support(where, request, up, options.max_object_size, rng, warnings)
    if found is not None and seen.viewpoint is not None and found.plane.heights(seen.viewpoint) < 0:
        warnings.append(
            "the viewpoint lies below the support plane: check viewpoint, up and support."
        )
    return found


def _up(options: DetectOptions, support: Support | None) -> Float64:
    """Unit vector (3,) away from gravity: as sent, else the support's normal, else +z."""
    given = options.up
    if given is None:
        given = (0.0, 0.0, 1.0) if support is None else support.plane.normal
    up = np.asarray(given, dtype=np.float64)
    return np.asarray(up / np.linalg.norm(up))


def _given_numbers(sent: CheckedCloud) -> Int64:
    """The segments (N,) that a caller sent, 0 and less none; else all points are one object."""
    if sent.segment_ids is None:
        return np.zeros(len(sent.points), dtype=np.int64)
    return np.where(sent.segment_ids > 0, sent.segment_ids, UNKNOWN)


def _numbers(
    view: PlaneView,
    sent: CheckedCloud,
    seen: Seen,
    inside: Bools,
    options: DetectOptions,
    warnings: list[str],
) -> Int64:
    """The object (M,) of each point over the support; FIXED: furniture; UNKNOWN: neither.

    What the caller says are objects are: segments, or regions by rows.
    """
    by_rows = has_rows(options.approach_region) or has_rows(options.contact_region)
    if sent.segment_ids is not None or by_rows or options.objects == "off":
        return np.where(inside, _given_numbers(sent), UNKNOWN)
    if options.workspace is not None:
        beyond = beyond_workspace(view, sent.points, options.workspace)
        view = view._replace(beyond=beyond)
    # Things that touch furniture may be told from it more finely.
    for cell, strict in ((CELL, True), (FINE_CELL, True), (CELL, False)):
        number = find_things(view, options.max_object_size, cell, strict)
        number = np.where((number >= 0) & ~inside, UNKNOWN, number)
        if sent.image_size is not None:
            number = without_speckles(number, sent.row, sent.image_size, seen.distance())
        if (number >= 0).any() or not inside.any():
            break
    if strict:
        return number
    said = "nothing over the support plane looks like a thing (longer than max_object_size, "
    said += "cut off by the image, or not on the plane)"
    if (number >= 0).any():
        said += ": what the image cuts off is taken for things"
    warnings.append(f"{said}. Send objects: off to look for grasps on all that is over it.")
    return number


def beyond_workspace(view: PlaneView, points: Float32, box: Workspace) -> Int64:
    """Which side of the workspace points are beyond, or at, beside something beyond it.

    The walls of a bin whose inside is the workspace are seen partly in it: as far as their points
    may lie off them.

    Args:
        view: M points.
        points: (M, 3) the same, cloud frame, metres.
        box: The workspace.

    Returns:
        (M,) number of the side, from 1; 0: in it.
    """
    low, high = np.asarray(box.min), np.asarray(box.max)
    outside = np.concatenate([points < low, points > high], axis=1)  # (M, 6)
    wall = np.maximum(view.margin, WALL)[:, None]
    at_side = np.concatenate([points < low + wall, points > high - wall], axis=1)
    inside = ~outside.any(axis=1)
    beside = np.flatnonzero(inside & at_side.any(axis=1))
    if not inside.all() and len(beside):
        around = cKDTree(view.plan[~inside])
        apart, _ = around.query(view.plan[beside], distance_upper_bound=2 * WALL)
        outside[beside] = at_side[beside] & np.isfinite(apart)[:, None]
    return np.where(outside.any(axis=1), outside.argmax(axis=1) + 1, 0)


def near_things(plan: Float64, number: Int64) -> Bools:
    """Which points (M,), with places (M, 2) along the support, a hand at any thing could meet."""
    if not (number >= 0).any():
        return np.zeros(len(plan), dtype=bool)
    x, y = (((axis - axis.min()) / PLAN_CELL).astype(np.int64) for axis in plan.T)
    held = np.zeros((x.max() + 1, y.max() + 1), dtype=bool)
    held[x[number >= 0], y[number >= 0]] = True
    square = np.ones((3, 3), dtype=bool)
    near = ndimage.binary_dilation(held, square, iterations=math.ceil(REACH / PLAN_CELL))
    return np.asarray(near[x, y])


def near_workspace_side(
    points: Float32, workspace: Workspace | None, up: ArrayLike, seen: Float32
) -> Bools:
    """Which points (V, 3) lie at a side of the workspace beyond which nothing was seen.

    An object there may be cut off, and wider than it seems. Floor and ceiling do not count.

    Args:
        points: Cloud frame, metres.
        workspace: In the same frame.
        up: (3,) away from gravity, of any length.
        seen: (N, 3) the points of the cloud, some of which may lie outside of the workspace.
    """
    if workspace is None:
        return np.zeros(len(points), dtype=bool)
    level = np.abs(np.asarray(up)) < np.linalg.norm(up) / 2
    low, high = np.asarray(workspace.min), np.asarray(workspace.max)
    cut_low = level & (seen.min(axis=0) >= low)
    cut_high = level & (seen.max(axis=0) <= high)
    at_low = (points < low + SIDE_DEPTH) & cut_low
    at_high = (points > high - SIDE_DEPTH) & cut_high
    return np.asarray((at_low | at_high).any(axis=1))


def camera_positions(sent: CheckedCloud, options: DetectOptions) -> NDArray[np.float64] | None:
    """The camera positions (W, 3) that the request gives, if any."""
    if options.viewpoint is None:
        return None
    viewpoints = np.asarray(options.viewpoint, dtype=np.float64).reshape(-1, 3)
    if len(viewpoints) == 1:
        return viewpoints
    if sent.view_ids is None:
        fix = "Send one number for each point: which of options.viewpoint saw it, from 0."
        raise InvalidRequest("view_ids", f"nothing, for {len(viewpoints)} viewpoints", fix)
    low, high = int(sent.view_ids.min()), int(sent.view_ids.max())
    if low < 0 or high >= len(viewpoints):
        fix = f"Send numbers from 0 to {len(viewpoints) - 1}, rows of options.viewpoint."
        raise InvalidRequest("view_ids", f"values from {low} to {high}", fix)
    return viewpoints


def single_viewpoint(
    viewpoints: NDArray[np.float64] | None, frame: CanonicalFrame
) -> Float32 | None:
    """The camera (3,) in the canonical frame, if there is exactly one."""
    if viewpoints is None or len(viewpoints) != 1:
        return None
    return frame.points(viewpoints[0]).astype(np.float32)


def inside_workspace(
    points: Float32, box: Workspace | None, around: NDArray[np.floating] | float = 0.0
) -> Bools:
    """Which points (N, 3) lie in a box grown by `around` metres; all where there is none."""
    if box is None:
        return np.ones(len(points), dtype=bool)
    inside = (points >= np.asarray(box.min) - around) & (points <= np.asarray(box.max) + around)
    return np.asarray(inside.all(axis=1))


def near_workspace(sent: CheckedCloud, box: Workspace | None, around: float) -> CheckedCloud:
    """The part of a cloud that a hand in the workspace could meet."""
    return sent if box is None else sent.take(inside_workspace(sent.points, box, around))


def _turned_normals(
    sent: CheckedCloud,
    points: Float32,
    normals: Float32,
    kept: Bools,
    voxels: Voxels,
    frame: CanonicalFrame,
    viewpoints: NDArray[np.float64] | None,
) -> Float32:
    """Unit normals of the kept voxels: those given, else the estimated, turned to the camera."""
    seen_from = assumed_viewpoint(points, UP)
    if viewpoints is not None:
        seen_from = frame.points(viewpoints).astype(np.float32)
        if len(viewpoints) > 1 and sent.view_ids is not None:
            seen_from = seen_from[voxels.commonest(sent.view_ids)[kept]]
    normals = orient_normals(points, normals, seen_from)
    if sent.normals is None:
        return normals
    given = frame.directions(voxels.mean(_unit(sent.normals))[kept])
    length = np.linalg.norm(given, axis=1, keepdims=True)
    given = given / np.maximum(length, MIN_NORMAL)
    return np.where(length >= MIN_NORMAL, given, normals).astype(np.float32)


def _unit(vectors: Float32) -> Float32:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-12))


def plane_in_frame(plane: SupportPlane, frame: CanonicalFrame) -> SupportPlane:
    """A plane of the cloud's frame in the canonical one."""
    normal = np.asarray(plane.normal)
    length = float(np.linalg.norm(normal))
    foot = frame.points(normal * (plane.offset / length**2))
    x, y, z = (frame.directions(normal) / length).tolist()
    return SupportPlane(normal=(x, y, z), offset=float(foot @ np.array([x, y, z])))
