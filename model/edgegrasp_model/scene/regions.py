"""Which points of a cloud lie in a request's regions, or on the objects it names."""

import numpy as np
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Bools, Float32, Floats, Int64
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import (
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
    Workspace,
)
from edgegrasp_model.scene.cloud import CheckedCloud, Voxels
from edgegrasp_model.scene.segment import FIXED

HELD_SHARE = 0.5  # share of a voxel's points that must be listed for rows to hold the voxel
NEAR_POINT = 0.1  # most metres from a position to the object it names
NEAR_PIXEL = 0.02  # the same from a pixel, as a share of the image's width


def check_regions(cloud: CheckedCloud, options: DetectOptions) -> None:
    """Raise InvalidRequest if `at` or a region refers to something that the cloud does not have."""
    if options.at is not None:
        if cloud.image_size is None:
            fix = "Send near: x, y, z; or one depth image, or an organised cloud."
            raise InvalidRequest("options.at", "a pixel of a cloud that is not an image", fix)
        (column, row), (height, width) = options.at, cloud.image_size
        if column > width - 0.5 or row > height - 0.5:
            value = f"{column:g}, {row:g} of an image of {width} x {height} pixels"
            raise InvalidRequest("options.at", value, "Send column, row, counted from 0.")
    for name in ("approach_region", "contact_region"):
        if (region := getattr(options, name)) is not None:
            check_region(region, cloud, name)


def check_region(region: Region, cloud: CheckedCloud, field: str) -> None:
    """Check that the rows and segments of a region exist; InvalidRequest names its `field`."""
    for part in ("include", "exclude"):
        for place, shape in enumerate(getattr(region, part)):
            here, rows = f"options.{field}.{part}.{place}", cloud.rows_sent
            if isinstance(shape, Indices) and max(shape.indices, default=0) >= rows:
                value = f"row {max(shape.indices)} of a cloud of {rows} rows"
                raise InvalidRequest(f"{here}.indices", value, f"Send rows from 0 to {rows - 1}.")
            if isinstance(shape, Mask) and len(shape.mask) != rows:
                value = f"{len(shape.mask)} values for a cloud of {rows} rows"
                raise InvalidRequest(f"{here}.mask", value, "Send one value for each row.")
            if isinstance(shape, Segments) and cloud.segment_ids is None:
                fix = f"Send one id for each point with the cloud: {here} asks for segments."
                raise InvalidRequest("segment_ids", "nothing", fix)


def chosen_objects(
    number: Int64, cloud: CheckedCloud, options: DetectOptions, warnings: list[str]
) -> Int64:
    """The object (N,) of each point if the request names that object; FIXED otherwise.

    `number` (N,) is the object of each point, negative: none. `warnings` gets objects that are
    named but not there.
    """
    held = number[number >= 0]
    # Counting is many times faster, but takes as much memory as the caller's numbers are high.
    found = np.flatnonzero(np.bincount(held)) if cloud.segment_ids is None else np.unique(held)
    wanted = numbers_chosen(found, options.objects, warnings)
    for name, target in (("at", options.at), ("near", options.near)):
        if target is None:
            continue
        place: Floats = cloud.points
        most = NEAR_POINT
        if name == "at" and cloud.image_size is not None:
            width = cloud.image_size[1]
            place = np.stack([cloud.row % width, cloud.row // width], axis=1)
            most = max(NEAR_PIXEL * width, 1.0)
        on = np.flatnonzero(np.isin(number, wanted))
        distance = np.linalg.norm(place[on] - np.asarray(target), axis=1)
        if distance.min(initial=np.inf) <= most:
            wanted = number[on[[distance.argmin()]]]
        else:
            wanted = wanted[:0]
            shown = ", ".join(f"{value:g}" for value in target)
            warnings.append(f"{name}: there is no object to grasp at {shown}.")
    return np.where((number >= 0) & ~np.isin(number, wanted), FIXED, number)


def numbers_chosen(found: Int64, choice: ObjectChoice | str, warnings: list[str]) -> Int64:
    """Those of the objects numbered `found` that a choice names; all if it is in a word."""
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
    """Which voxels (V,) of the processed cloud a region holds."""

    def in_any(shapes: tuple[Shape, ...]) -> Bools:
        found = np.zeros(len(points), dtype=bool)
        for shape in shapes:
            if isinstance(shape, Rows):
                found |= voxels.share(_in_rows(shape, cloud)) >= HELD_SHARE
            else:
                found |= inside_shape(shape, points)
        return found

    wanted = in_any(region.include) if region.include else np.ones(len(points), dtype=bool)
    return wanted & ~in_any(region.exclude)


def inside_workspace(points: Float32, box: Workspace | None, around: Floats | float = 0.0) -> Bools:
    """Which points (N, 3) lie in a box grown by `around` metres; all if there is no box."""
    if box is None:
        return np.ones(len(points), dtype=bool)
    low, high = np.asarray(box.min) - around, np.asarray(box.max) + around
    x, y, z = ((axis >= a) & (axis <= b) for axis, a, b in zip(points.T, low, high, strict=True))
    return np.asarray(x & y & z)


def inside_shape(shape: Box | OrientedBox | Sphere | HalfSpace, points: Float32) -> Bools:
    """Which points (V, 3), in the shape's frame, lie in it.  # (V,)."""
    match shape:
        case Box():
            return inside_workspace(points, shape)
        case OrientedBox():
            turn = Rotation.from_quat(shape.quaternion).as_matrix()
            within = np.abs((points - np.asarray(shape.center)) @ turn)
            return np.asarray((within <= np.asarray(shape.half_extents)).all(axis=1))
        case Sphere():
            apart = np.linalg.norm(points - np.asarray(shape.center), axis=1)
            return np.asarray(apart <= shape.radius)
        case HalfSpace():
            return np.asarray(points @ np.asarray(shape.normal) >= shape.offset)


def _in_rows(shape: Rows, cloud: CheckedCloud) -> Bools:
    """Which points of the cloud are listed by rows, a mask or segments.  # (N,)."""
    match shape:
        case Indices():
            return np.isin(cloud.row, np.asarray(shape.indices, dtype=np.int64))
        case Mask():
            return np.frombuffer(shape.mask, dtype=bool)[cloud.row]
        case Segments():
            assert cloud.segment_ids is not None
            return np.isin(cloud.segment_ids, shape.ids)
