"""A request's scene: the small clean cloud in the canonical frame, and what else is there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions, Region, SupportPlane, Workspace
from edgegrasp_model.scene.cloud import (
    UP,
    CanonicalFrame,
    CheckedCloud,
    Cloud,
    Voxels,
    assumed_viewpoint,
    estimate_normals,
    orient_normals,
    statistical_outlier_removal,
    voxelise,
)
from edgegrasp_model.scene.obstacles import SolidBoxes
from edgegrasp_model.scene.regions import check_region, inside_region
from edgegrasp_model.scene.support import SUPPORT_MARGIN, correct_depth_scale, find_support_plane

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

MIN_POINTS = 4  # fewer make no surface
MIN_NORMAL = 1e-3  # a voxel's mean normal shorter than this has no direction
SIDE_DEPTH = 0.006  # metres inside a side of the workspace where an object may be cut off
MAX_VOXELS = 200_000  # some seconds of work; a tabletop has 3,000 to 30,000
SUPPORT_STREAM = 2  # random stream of one request


@dataclass(frozen=True)
class Scene:
    """What grasps are looked for in; canonical frame. V points are left of the cloud."""

    frame: CanonicalFrame
    cloud: Cloud  # V points
    points_in_cloud: Float32  # (V, 3) the same in the cloud's frame
    point_of_row: Int64  # (R,) point that each row of the cloud as sent went into; -1: none
    approach_allowed: Bools  # (V,) in the approach region
    contact_allowed: Bools  # (V,) in the contact region
    object_of_point: Int64  # (V,) number of the object that each point is of; -1: of none
    support: SupportPlane | None
    obstacles: SolidBoxes | None  # beside the cloud; None: there are none
    viewpoint: Float32 | None = None  # (3,) the camera, where there is one and only one
    at_side: Bools | None = None  # (V,) where a side of the workspace cuts the cloud off


def build_scene(
    sent: CheckedCloud,
    options: DetectOptions,
    voxel_size: float,
    counts: dict[str, int],
    warnings: list[str],
    max_voxels: int = MAX_VOXELS,
) -> Scene | None:
    """Correct depths, crop, remove the support, voxelise, estimate normals, find the regions.

    Args:
        sent: N points.
        options: workspace, support, viewpoint, up, regions and obstacles.
        voxel_size: Metres.
        counts: Gets the number of points left after each step.
        warnings: Gets what the caller should know.
        max_voxels: Most voxels that the cloud may have where grasps are looked for.

    Returns:
        The scene, or None where too few points are left to make a surface.

    Raises:
        InvalidRequest: A region speaks of rows or segments that the cloud does not have, or the
            views do not suit the viewpoints, or there are none to correct depths from, or the
            cloud has too many voxels.
    """
    viewpoints = camera_positions(sent, options)
    sent, support = crop_cloud(sent, viewpoints, options, counts, warnings)
    if len(sent.points) == 0:
        counts |= {"voxels": 0, "kept": 0}
        return None
    first_viewpoint = None if viewpoints is None else viewpoints[0]
    frame = CanonicalFrame.of_scene(sent.points, options.up, first_viewpoint)
    points = frame.points(sent.points)
    voxels = voxelise(points, voxel_size)
    counts["voxels"] = len(voxels.size)
    if counts["voxels"] > max_voxels:
        raise _too_many_voxels(counts["voxels"], max_voxels, voxel_size, sent, options)
    middles = voxels.mean(points)
    kept = statistical_outlier_removal(middles)
    counts["kept"] = int(kept.sum())
    if counts["kept"] < MIN_POINTS:
        return None
    cloud = Cloud(middles[kept], _normals(sent, middles, kept, voxels, frame, viewpoints))
    in_cloud = frame.points_in_cloud(middles)

    def allowed(region: Region | None) -> Bools:
        if region is None:
            return np.ones(counts["kept"], dtype=bool)
        return inside_region(region, in_cloud, voxels, sent)[kept]

    approach = allowed(options.approach_region)
    counts["in_approach_region"] = int(approach.sum())
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    point_of_row = np.full(sent.rows_sent, -1, dtype=np.int64)
    point_of_row[sent.row] = number[voxels.voxel]
    obstacles = options.collision.obstacles
    return Scene(
        frame=frame,
        cloud=cloud,
        points_in_cloud=in_cloud[kept],
        point_of_row=point_of_row,
        approach_allowed=approach,
        contact_allowed=allowed(options.contact_region),
        object_of_point=np.zeros(counts["kept"], dtype=np.int64),
        support=None if support is None else plane_in_frame(support, frame),
        at_side=near_workspace_side(in_cloud[kept], options.workspace, options.up),
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


def crop_cloud(
    sent: CheckedCloud,
    viewpoints: NDArray[np.float64] | None,
    options: DetectOptions,
    counts: dict[str, int],
    warnings: list[str],
) -> tuple[CheckedCloud, SupportPlane | None]:
    """Correct the depths, crop to the workspace and remove the support plane; returns both.

    Raises:
        InvalidRequest: A region speaks of rows or segments that the cloud does not have, or there
            are no viewpoints (W, 3) to correct depths from.
    """
    for field in ("approach_region", "contact_region"):
        if (region := getattr(options, field)) is not None:
            check_region(region, sent, field)
    counts["points"] = len(sent.points)
    support = options.support
    if isinstance(support, SupportPlane) and support.max_depth_error > 0.0:
        sent = correct_depth_scale(sent, support, viewpoints, warnings)
    sent = crop_to_workspace(sent, options)
    counts["in_workspace"] = len(sent.points)
    support, sent = remove_support_plane(sent, options, warnings)
    counts["above_support"] = len(sent.points)
    return sent, support


def near_workspace_side(points: Float32, workspace: Workspace | None, up: ArrayLike) -> Bools:
    """Which points (N, 3), in the cloud's frame, lie at a side of the workspace.

    An object there may be cut off, and wider than it seems. Floor and ceiling do not count.
    """
    if workspace is None:
        return np.zeros(len(points), dtype=bool)
    level = np.abs(np.asarray(up)) < np.linalg.norm(up) / 2
    beyond_low = points < np.asarray(workspace.min) + SIDE_DEPTH
    beyond_high = points > np.asarray(workspace.max) - SIDE_DEPTH
    return np.asarray(((beyond_low | beyond_high) & level).any(axis=1))


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


def crop_to_workspace(sent: CheckedCloud, options: DetectOptions) -> CheckedCloud:
    """The part of a cloud within the workspace."""
    if options.workspace is None:
        return sent
    box = options.workspace
    inside = (sent.points >= np.asarray(box.min)) & (sent.points <= np.asarray(box.max))
    return sent.take(np.asarray(inside.all(axis=1)))


def remove_support_plane(
    sent: CheckedCloud, options: DetectOptions, warnings: list[str]
) -> tuple[SupportPlane | None, CheckedCloud]:
    """The support plane, given or found, and the cloud above it."""
    request = options.support
    if request is None:
        return None, sent
    if isinstance(request, SupportPlane):
        return request, _above(sent, request, SUPPORT_MARGIN)
    rng = np.random.default_rng([options.seed, SUPPORT_STREAM])
    found = find_support_plane(sent.points, request, options.up, rng)
    if found is None:
        warnings.append("no support plane was found: the cloud is taken as it is.")
        return None, sent
    return found, _above(sent, found, request.distance)


def _above(sent: CheckedCloud, plane: SupportPlane, margin: float) -> CheckedCloud:
    return sent.take(np.asarray(plane.heights(sent.points) > margin))


def _normals(
    sent: CheckedCloud,
    middles: Float32,
    kept: Bools,
    voxels: Voxels,
    frame: CanonicalFrame,
    viewpoints: NDArray[np.float64] | None,
) -> Float32:
    """Unit normals of the kept voxels: those given, else estimated and turned to the camera."""
    points = middles[kept]
    seen_from = assumed_viewpoint(points, UP)
    if viewpoints is not None:
        seen_from = frame.points(viewpoints).astype(np.float32)
        if len(viewpoints) > 1 and sent.view_ids is not None:
            seen_from = seen_from[voxels.commonest(sent.view_ids, len(viewpoints))[kept]]
    normals = orient_normals(points, estimate_normals(points), seen_from)
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
