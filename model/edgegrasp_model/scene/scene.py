"""A request's scene: the small, clean cloud in the canonical frame, its support and obstacles."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats, Int64
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import (
    AutoPlane,
    Box,
    DetectOptions,
    HalfSpace,
    Indices,
    Mask,
    ObjectChoice,
    OrientedBox,
    Region,
    Rows,
    Segments,
    Shape,
    Sphere,
    SupportPlane,
    Workspace,
)
from edgegrasp_model.results import OBSTACLE, SUPPORT, UNLABELLED
from edgegrasp_model.scene.cloud import (
    HAND_REACH,
    UP,
    USUAL_DISTANCE,
    CanonicalFrame,
    CheckedCloud,
    Cloud,
    Voxels,
    clean_cloud,
    inside_workspace,
    subsample,
    unit,
    voxelise,
)
from edgegrasp_model.scene.network import NEAREST_DEPTH
from edgegrasp_model.scene.obstacles import SolidBoxes, box_pose
from edgegrasp_model.scene.segment import (
    BACKGROUND,
    UNDECIDED,
    Segmentation,
    drop_long_objects,
    objects_above,
    segment_cloud,
)
from edgegrasp_model.scene.support import (
    Support,
    ViewedPoints,
    correct_depth_scale,
    find_support,
    has_camera_at_origin,
    plane_in,
    up_of_cropped,
)
from edgegrasp_model.unseen import DepthMap

MAX_VOXELS = 200_000  # some seconds of work; a tabletop has 3,000 to 30,000
FOLLOWED_REACH = 0.16  # metres; replaces HAND_REACH if only known grasps are checked
OUTLINE_READINGS = 20_000  # readings that show what a camera's image contains
FOUND_PLANE_CLEARANCE = 0.0015  # metres that hands stay above a plane that was not given
NO_OBJECT = (
    "no object was recognised above the support plane. Send objects: off to look for grasps on "
    "everything above it."
)


@dataclass(frozen=True)
class Surroundings:
    """The surroundings of hands, in one frame, metres: N points and what is known about them."""

    cloud: Cloud  # N points
    up: Float32  # (3,) away from gravity
    support: SupportPlane | None
    viewpoints: Float32  # (W, 3) the cameras; none if they are unknown
    at_side: Bools  # (N,) where a side of the workspace cuts the cloud off
    object_of_point: Int64  # (N,) number of each point's object, or BACKGROUND or UNDECIDED
    # Some (M, 3) of each camera's readings, which show its image; none if there is one camera.
    readings_by_camera: list[Float32] = field(default_factory=list, kw_only=True)

    @cached_property
    def depths(self) -> list[DepthMap]:
        """The depth map of each camera; none if the cameras are unknown."""
        eyes = self.viewpoints if len(self.cloud.points) else ()
        own: list[Float32 | None] = [*self.readings_by_camera] or [None] * len(eyes)
        return [
            DepthMap.of_cloud(self.cloud.points, eye, self.up, readings)
            for eye, readings in zip(eyes, own, strict=False)
        ]


@dataclass(frozen=True)
class Scene(Surroundings):
    """The scene in which grasps are searched: the N voxels left of the cloud; canonical frame."""

    frame: CanonicalFrame
    points_in_cloud: Float32  # (N, 3) the points in the cloud's frame
    point_of_row: Int64  # (R,) voxel of each row of the cloud as sent; -1: none
    approach_allowed: Bools  # (N,) in the approach region
    contact_allowed: Bools  # (N,) in the contact region
    obstacles: SolidBoxes | None  # in addition to the cloud; None: there are none
    confidence: dict[int, float] = field(default_factory=dict)  # of each object, if found
    # (3, 4) projects points into the image that was sent, with sides at -1 and 1; None: unknown
    P_image_cloud: Float64 | None = None
    # (M, 3) points that an arm has to avoid: all readings, inside the workspace or not; cloud frame
    readings: Float32 = field(default_factory=lambda: np.empty((0, 3), np.float32))


@dataclass(frozen=True)
class SelectedPoints:
    """The selected points of a cloud: M points of objects and their surroundings."""

    cloud: CheckedCloud  # M points
    object_of_point: Int64  # (M,) number of each point's object, or BACKGROUND or UNDECIDED
    support: Support | None
    up: Float64  # (3,) unit, away from gravity, cloud frame
    viewpoints: Float64  # (W, 3) the cameras
    labels: Int64  # (R,) of the rows of the cloud as sent, as in `DebugInfo`
    confidence: dict[int, float]  # of each object that the network found
    readings: CheckedCloud  # all readings


def select_points(
    sent: CheckedCloud,
    options: DetectOptions,
    further: float,  # metres beyond HAND_REACH that a hand may reach
    counts: dict[str, int],
    warnings: list[str],
) -> SelectedPoints:
    """Correct depths, segment, remove the support, and drop what no hand at an object can reach."""
    viewpoints, found = camera_positions(sent, options), None
    given = sent.segment_ids is not None or options.objects == "off"
    check_regions(options, sent)
    readings = sent = correct_depth_scale(sent, options.support, viewpoints, warnings)
    if options.workspace is not None:
        reach = further + (FOLLOWED_REACH if options.follows_only else HAND_REACH)
        sent = sent.take(inside_workspace(sent.points, options.workspace, reach))
    rows: Int64 | slice = slice(None)
    if len(viewpoints) == 0 and len(sent.points) > 0:
        rows, viewpoints = _seen_from_above(sent.points, options.known_up)
    inside = inside_workspace(sent.points, options.workspace)
    counts["in_workspace"] = int(inside.sum())
    number = callers_objects(sent)
    needed = isinstance(options.support, AutoPlane) or not given or options.known_up is None
    if needed and options.support is not None and len(sent.points) > 0:
        found = segment_cloud(sent, viewpoints, options.known_up, rows)
        found = found if sent.segment_ids is None else found._replace(object_of_point=number)
    seen = ViewedPoints.by_cameras(sent, viewpoints)
    support = find_support(seen, inside, found, options, warnings)
    above_all = np.ones(len(inside), np.float32), np.zeros(len(inside), np.float32)
    height, margin = above_all if support is None else support.heights(seen)
    labels = np.full(sent.rows_sent, UNLABELLED, dtype=np.int64)
    labels[sent.row[np.abs(height) <= margin]] = SUPPORT
    above = np.flatnonzero(height > margin)
    sent, inside = sent.take(above), inside[above]
    counts["above_support"] = int(inside.sum())
    plan = (support.frame.points_from_cloud(sent.points) if support else sent.points)[:, :2]
    number, certain = number[above], np.empty(0)
    if found is not None and not given:
        if support is not None:
            is_cropped = math.isnan(support.growth)
            number, certain = objects_above(found, above, plan, height, margin, is_cropped)
        elif options.viewpoint is not None and (
            (found.object_of_point >= 0).any() or np.median(seen.away) < NEAREST_DEPTH
        ):
            number, certain = found.object_of_point, found.confidence
    confidence = dict(enumerate(certain.tolist()))
    if not given:
        number = drop_long_objects(number, sent.points, options.max_object_size)
        number = add_marked(number, len(confidence), sent, options)
        if counts["above_support"] and not (inside & (number >= 0)).any():
            warnings.append(NO_OBJECT)
    number = np.where(inside | (number == BACKGROUND), number, UNDECIDED)
    labels[sent.row] = np.where(number >= 0, number, OBSTACLE)
    labels = labels_of_all_pixels(sent, labels) if options.debug else labels
    if options.at or options.near or isinstance(options.objects, ObjectChoice):
        number = keep_chosen_objects(number, sent, options, warnings)
    kept = near_objects_along(plan, number, HAND_REACH + further)
    near, number = sent.take(kept), number[kept]
    up = _up(options, seen, support, None if options.viewpoint is None else found)
    return SelectedPoints(near, number, support, up, viewpoints, labels, confidence, readings)


def callers_objects(sent: CheckedCloud) -> Int64:
    """The caller's segments (N,), 0 and below meaning none; else all points are one object."""
    ids = sent.segment_ids
    return np.zeros(len(sent.points), int) if ids is None else np.where(ids > 0, ids, UNDECIDED)


def add_marked(number: Int64, count: int, sent: CheckedCloud, options: DetectOptions) -> Int64:
    """Objects (N,), numbered below `count`; the rows that regions include may be one more.

    They are if no object has most of its points among them: the network did not recognise the
    object that the caller marked.
    """
    regions = filter(None, (options.approach_region, options.contact_region))
    shapes = [shape for region in regions for shape in region.include if isinstance(shape, Rows)]
    if not shapes:
        return number
    rows = np.any([_listed(shape, sent) for shape in shapes], axis=0)
    size = np.bincount(number[number >= 0], minlength=count)
    marked = np.bincount(number[rows & (number >= 0)], minlength=len(size))
    return number if (2 * marked > size).any() else np.where(rows, len(size), number)


def labels_of_all_pixels(sent: CheckedCloud, labels: Int64) -> Int64:
    """Labels (R,) of the rows sent; pixels that were left out get the label of a kept neighbour."""
    if sent.image_size is None or sent.step == 1:
        return labels
    height, width = sent.image_size
    kept = labels.reshape(height, width)[:: sent.step, :: sent.step]
    wide = kept.repeat(sent.step, axis=0).repeat(sent.step, axis=1)
    return np.ascontiguousarray(wide[:height, :width]).reshape(-1)


def build_scene(
    selected: SelectedPoints,  # M points
    options: DetectOptions,
    voxel_size: float,  # metres
    counts: dict[str, int],  # gets the number of points left after each step
    max_voxels: int = MAX_VOXELS,  # most that the cloud may have where grasps are searched
) -> Scene | None:
    """Voxelise the selected points, remove outliers, estimate normals, and find the regions.

    None if there is no object; InvalidRequest: there are too many voxels.
    """
    sent, support, viewpoints = selected.cloud, selected.support, selected.viewpoints
    obstacles, readings = options.collision.obstacles, selected.readings.points
    if not (selected.object_of_point >= 0).any():
        counts |= {"voxels": 0, "kept": 0}
        return None
    frame = CanonicalFrame.from_scene(sent.points, selected.up, viewpoints[0])
    eyes = frame.points_from_cloud(viewpoints)
    projection = None if options.viewpoint is None else sent.projection(frame, eyes)
    voxels = voxelise(canonical := frame.points_from_cloud(sent.points), voxel_size, max_voxels)
    middles = voxels.mean(canonical)
    cloud, kept = clean_cloud(sent, voxels, middles, frame, eyes)
    counts |= {"voxels": len(kept), "kept": len(cloud.points)}
    in_cloud = frame.points_to_cloud(middles)
    number = voxels.commonest(selected.object_of_point)[kept]
    held = inside_workspace(in_cloud, options.workspace)[kept] & (number >= 0)
    approach, contact = (
        held if region is None else held & inside_region(region, in_cloud, voxels, sent)[kept]
        for region in (options.approach_region, options.contact_region)
    )
    counts["in_approach_region"] = int(approach.sum())
    point_of_row = np.full(sent.rows_sent, -1, dtype=np.int64)
    point_of_row[sent.row] = np.where(kept, np.cumsum(kept) - 1, -1)[voxels.of_point]
    spare = 0.0 if isinstance(options.support, SupportPlane) else FOUND_PLANE_CLEARANCE
    objects = in_cloud[kept][number >= 0]
    return Scene(
        cloud=cloud,
        up=UP,
        frame=frame,
        points_in_cloud=in_cloud[kept],
        point_of_row=point_of_row,
        approach_allowed=approach,
        contact_allowed=contact,
        object_of_point=number,
        support=None if support is None else plane_in(frame, support.plane_under(objects, spare)),
        at_side=near_workspace_side(in_cloud[kept], options.workspace, selected.up, readings),
        viewpoints=(eyes[:0] if options.viewpoint is None else eyes).astype(np.float32),
        confidence=selected.confidence,
        P_image_cloud=projection,
        obstacles=SolidBoxes.from_shapes(obstacles, frame) if obstacles else None,
        readings=readings,
        readings_by_camera=_readings_by_camera(selected.readings, frame, len(eyes)),
    )


def _readings_by_camera(sent: CheckedCloud, frame: CanonicalFrame, cameras: int) -> list[Float32]:
    """Some of each camera's readings, (M, 3) in the frame; none if there is one camera."""
    if sent.view_ids is None or cameras < 2:
        return []
    own = (sent.points[sent.view_ids == number] for number in range(cameras))
    some = (frame.points_from_cloud(subsample(points, OUTLINE_READINGS)) for points in own)
    return [points.astype(np.float32) for points in some]


def _seen_from_above(points: Float32, up: Float64 | None) -> tuple[Int64, Float64]:
    """Rows (M,) near the middle, as a whole room has too few pixels, and an eye (1, 3) above it."""
    over = np.array([0.0, 0.0, 1.0]) if up is None else up
    beside = points - np.median(points, axis=0)
    beside -= (beside @ over)[:, None] * over
    beside -= beside[np.linalg.norm(beside, axis=1).argmin()]  # the median may be in a gap
    near = np.flatnonzero(np.linalg.norm(beside, axis=1) < USUAL_DISTANCE)
    return near, (points[near].mean(axis=0, dtype=np.float64) + USUAL_DISTANCE * over)[None]


def _up(
    options: DetectOptions,
    seen: ViewedPoints,
    support: Support | None,
    segmentation: Segmentation | None,
) -> Float64:
    """Unit vector (3,) away from gravity: as sent, else the support's normal, else estimated."""
    if options.up is not None:
        return unit(np.asarray(options.up, dtype=np.float64))
    if support is not None:
        return np.asarray(support.frame.T_canonical_cloud[2, :3])
    if segmentation is not None:
        return segmentation.up
    if has_camera_at_origin(options) and len(seen.points) > 0:
        return up_of_cropped(seen.points, seen.viewpoint, None)
    return np.array([0.0, 0.0, 1.0])


def near_objects_along(plan: Floats, number: Int64, reach: float) -> Bools:
    """Which points (M,) a hand at any object could reach; `plan` (M, 2) is along the support."""
    if not (number >= 0).any():
        return np.zeros(len(plan), dtype=bool)
    x, y = (((axis - axis.min()) / (HAND_REACH / 5)).astype(np.int64) for axis in plan.T)
    held = np.zeros((x.max() + 1, y.max() + 1), dtype=bool)
    held[x[number >= 0], y[number >= 0]] = True
    square = np.ones((3, 3), dtype=bool)
    near = ndimage.binary_dilation(held, square, iterations=math.ceil(5 * reach / HAND_REACH))
    return np.asarray(near[x, y])


def near_workspace_side(
    points: Float32, workspace: Workspace | None, up: ArrayLike, seen: Float32
) -> Bools:
    """Which points (V, 3) lie within 6 mm of a side of the workspace beyond which nothing was seen.

    An object there may be cut off and wider than it looks. Floor and ceiling do not count. `seen`
    (N, 3) are the points of the whole cloud, some of which may lie outside of the workspace.
    """
    if workspace is None:
        return np.zeros(len(points), dtype=bool)
    level, depth = np.abs(np.asarray(up)) < np.linalg.norm(up) / 2, 0.006
    low, high = np.asarray(workspace.min), np.asarray(workspace.max)
    cut_low = level & (seen.min(axis=0) >= low)
    cut_high = level & (seen.max(axis=0) <= high)
    at_low, at_high = (points < low + depth) & cut_low, (points > high - depth) & cut_high
    return np.asarray((at_low | at_high).any(axis=1))


def camera_positions(sent: CheckedCloud, options: DetectOptions) -> Float64:
    """The camera positions (W, 3) of the request, none if they are unknown."""
    known = () if options.viewpoint is None else options.viewpoint
    viewpoints = np.reshape(np.asarray(known, dtype=np.float64), (-1, 3))
    if len(viewpoints) < 2:
        return viewpoints
    if sent.view_ids is None:
        fix = "Send one number for each point: which of options.viewpoint saw it, from 0."
        raise InvalidRequest("view_ids", f"nothing, for {len(viewpoints)} viewpoints", fix)
    low, high = int(sent.view_ids.min()), int(sent.view_ids.max())
    if low < 0 or high >= len(viewpoints):
        fix = f"Send numbers from 0 to {len(viewpoints) - 1}, rows of options.viewpoint."
        raise InvalidRequest("view_ids", f"values from {low} to {high}", fix)
    return viewpoints


# Regions, and objects that a request names


def check_regions(options: DetectOptions, cloud: CheckedCloud) -> None:
    """Check that the rows and segments of the regions exist; InvalidRequest names the field."""
    for name, part in product(("approach_region", "contact_region"), ("include", "exclude")):
        for place, shape in enumerate(getattr(getattr(options, name), part, ())):
            here, rows = f"options.{name}.{part}.{place}", cloud.rows_sent
            if isinstance(shape, Indices) and max(shape.indices, default=0) >= rows:
                value = f"row {max(shape.indices)} of a cloud of {rows} rows"
                raise InvalidRequest(f"{here}.indices", value, f"Send rows from 0 to {rows - 1}.")
            if isinstance(shape, Mask) and len(shape.mask) != rows:
                value = f"{len(shape.mask)} values for a cloud of {rows} rows"
                raise InvalidRequest(f"{here}.mask", value, "Send one value for each row.")
            if isinstance(shape, Segments) and cloud.segment_ids is None:
                fix = f"Send one id for each point with the cloud: {here} asks for segments."
                raise InvalidRequest("segment_ids", "nothing", fix)


def keep_chosen_objects(
    number: Int64, cloud: CheckedCloud, options: DetectOptions, warnings: list[str]
) -> Int64:
    """The object (N,) of each point, but BACKGROUND if the request does not choose that object.

    `number` (N,) is the object of each point; negative numbers, no object, stay. `warnings` gets
    objects that are named but not found.
    """
    if cloud.segment_ids is None and options.objects == "off":
        fix = "Leave one of the two out: with off, everything is one object."
        raise InvalidRequest("options.objects", "'off' and at or near", fix)
    held = number[number >= 0]
    # Counting is many times faster, but its memory grows with the caller's highest number.
    found = np.flatnonzero(np.bincount(held)) if cloud.segment_ids is None else np.unique(held)
    wanted = resolve_object_choice(found, options.objects, warnings)
    for name, target in (("at", options.at), ("near", options.near)):
        if target is None:
            continue
        place: Floats = cloud.points
        most = 0.1  # metres
        if name == "at":
            width = _image_width(target, cloud)
            place = np.stack([cloud.row % width, cloud.row // width], axis=1)
            most = max(0.02 * width, 1.0)  # pixels
        on = np.flatnonzero(np.isin(number, wanted))
        distance = np.linalg.norm(place[on] - np.asarray(target), axis=1)
        if distance.min(initial=np.inf) <= most:
            wanted = number[on[[distance.argmin()]]]
        else:
            wanted = wanted[:0]
            place_sent = ", ".join(f"{value:g}" for value in target)
            warnings.append(f"{name}: there is no object to grasp at {place_sent}.")
    return np.where((number >= 0) & ~np.isin(number, wanted), BACKGROUND, number)


def _image_width(pixel: tuple[float, ...], cloud: CheckedCloud) -> int:
    """The width of a cloud's image; InvalidRequest unless it has the pixel of `at`."""
    if cloud.image_size is None:
        fix = "Send near: x, y, z; or one depth image, or an organised cloud."
        raise InvalidRequest("options.at", "a pixel of a cloud that is not an image", fix)
    (column, row), (height, width) = pixel, cloud.image_size
    if column > width - 0.5 or row > height - 0.5:
        value = f"{column:g}, {row:g} of an image of {width} x {height} pixels"
        raise InvalidRequest("options.at", value, "Send column, row, counted from 0.")
    return width


def resolve_object_choice(found: Int64, choice: ObjectChoice | str, warnings: list[str]) -> Int64:
    """The numbers in `found` of the objects that a choice names; all if the choice is a word."""
    if isinstance(choice, str):
        return found
    if unknown := sorted({*choice.include, *choice.exclude} - {*found.tolist()}):
        here = ", ".join(map(str, found[:10])) or "none"
        warnings.append(f"objects: there is no object {unknown[0]}; there are: {here}.")
    wanted = found[np.isin(found, choice.include)] if choice.include else found
    return wanted[~np.isin(wanted, choice.exclude)]


def inside_region(
    region: Region,
    points: Float32,  # (V, 3) the voxels' mean points, cloud frame
    voxels: Voxels,
    cloud: CheckedCloud,  # the points in `voxels`, of the cloud as sent
) -> Bools:
    """Which voxels (V,) of the processed cloud a region contains."""
    nowhere, arrays = np.zeros(len(points), dtype=bool), (points, voxels, cloud)
    included, excluded = (
        np.any([nowhere, *(_inside_shape(shape, *arrays) for shape in shapes)], axis=0)
        for shapes in (region.include, region.exclude)
    )
    return np.asarray((included | (not region.include)) & ~excluded)


def _inside_shape(shape: Shape, points: Float32, voxels: Voxels, cloud: CheckedCloud) -> Bools:
    """Which voxels (V,) a shape contains, by their mean points or by the rows that it lists."""
    match shape:
        case Box():
            return inside_workspace(points, shape)
        case OrientedBox():
            T_cloud_box, half = box_pose(shape)
            within = np.abs((points - T_cloud_box[:3, 3]) @ T_cloud_box[:3, :3])
            return np.asarray((within <= half).all(axis=1))
        case Sphere():
            apart = np.linalg.norm(points - np.asarray(shape.center), axis=1)
            return np.asarray(apart <= shape.radius)
        case HalfSpace():
            return np.asarray(points @ np.asarray(shape.normal) >= shape.offset)
    listed = _listed(shape, cloud)
    return np.asarray(np.bincount(voxels.of_point, listed, len(voxels.counts)) >= voxels.counts / 2)


def _listed(shape: Rows, cloud: CheckedCloud) -> Bools:
    """Which points (N,) a shape lists by their rows."""
    match shape:
        case Indices():
            return np.isin(cloud.row, np.asarray(shape.indices, dtype=np.int64))
        case Mask():
            return np.frombuffer(shape.mask, dtype=bool)[cloud.row]
        case Segments():
            assert cloud.segment_ids is not None
            return np.isin(cloud.segment_ids, shape.ids)
