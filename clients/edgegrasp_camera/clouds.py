"""Clouds as arrays, from records with named fields and from sensor_msgs/PointCloud2."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from edgegrasp_camera import InvalidRequest, PayloadTooLarge
from edgegrasp_camera.arrays import Array

Records = NDArray[np.void]


@dataclass(frozen=True)
class CloudInput:
    """A cloud as the caller sends it; rows of an organised cloud are counted row-major.

    Per-point arrays have one entry for each point, in the shape of the cloud or flat.
    """

    points: object  # (N, 3), or (H, W, 3) with NaN where there is no point; float32/64, metres
    normals: object | None = None  # like points, outward, any length; used as given
    colors: object | None = None  # like points; checked, but not used by any network
    segment_ids: object | None = None  # (N,) or (H, W) integers
    view_ids: object | None = None  # (N,) or (H, W) integers: index into options.viewpoint
    viewpoint: Any = None  # (x, y, z) of the camera or of several, from images or the file
    warnings: tuple[str, ...] = ()  # warnings from reading it, for the answer


class PointField(Protocol):
    """The attributes of sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


@runtime_checkable
class PointCloud2(Protocol):
    """The attributes of sensor_msgs/PointCloud2, metres; ROS itself is not needed."""

    height: int
    width: int
    fields: Sequence[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Any  # bytes, or a sequence of their values


def too_many(count: int, max_points: int, field: str = "cloud") -> PayloadTooLarge:
    """The error for more than `max_points` points."""
    fix = f"Send at most {max_points} points, e.g. downsampled."
    return PayloadTooLarge(field, f"{count} points", fix)


# Records of numbers: points of PLY and PCD files and of PointCloud2

PCL_FIELDS = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", "rgba")  # all fields read


def cloud_from_records(rows: Records) -> CloudInput:
    """A cloud of points whose fields have the names of PCL and ROS.

    Args:
        rows: (N,) or (H, W) with fields x, y, z; normal_x, normal_y, normal_z, and rgb or rgba
            (packed in 4 bytes) or red, green, blue, if present.
    """
    colors = _stacked(rows, "red", "green", "blue")
    for name in ("rgb", "rgba"):
        if colors is None and name in (rows.dtype.names or ()) and rows.dtype[name].itemsize == 4:
            # 0x00RRGGBB, kept in a float32 or uint32
            packed = np.ascontiguousarray(rows[name]).view(np.uint32)
            colors = np.stack([packed >> shift & 255 for shift in (16, 8, 0)], axis=-1)
            colors = colors.astype(np.uint8)
    normals = _stacked(rows, "normal_x", "normal_y", "normal_z")
    return CloudInput(points=_stacked(rows, "x", "y", "z"), normals=normals, colors=colors)


def _stacked(rows: Records, *names: str) -> Array | None:
    """Fields of the rows, stacked along a new last axis; None if one is missing."""
    if not {*names} <= {*(rows.dtype.names or ())}:
        return None
    return np.stack([rows[name] for name in names], axis=-1)


# sensor_msgs/PointCloud2

POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def read_point_cloud2(cloud: PointCloud2, max_points: int = sys.maxsize) -> CloudInput:
    """Read x, y, z of a cloud, and normals and colours if present.

    Points are (N, 3), or (H, W, 3) where the height is 2 or more. Sizes are checked before anything
    is allocated, since the message is untrusted.

    Raises:
        InvalidRequest: A field is missing, unknown or wrong, or they contradict each other.
        PayloadTooLarge: More than `max_points` points.
    """
    if cloud.height * cloud.width > max_points:
        raise too_many(cloud.height * cloud.width, max_points, "point_cloud2")
    record = _record(cloud)
    if cloud.row_step < cloud.width * cloud.point_step:
        value = f"{cloud.row_step} for {cloud.width} points of {cloud.point_step} bytes"
        raise InvalidRequest("point_cloud2.row_step", value, "Send width * point_step or more.")
    expected = cloud.height * cloud.row_step
    if len(cloud.data) != expected:
        value = f"{len(cloud.data)} bytes where height * row_step is {expected}"
        raise InvalidRequest("point_cloud2.data", value, "Send the whole cloud.")
    shape, strides = (cloud.height, cloud.width), (cloud.row_step, cloud.point_step)
    if 0 in shape:
        return CloudInput(np.empty((0, 3), np.float32))
    data = bytes(cloud.data) if isinstance(cloud.data, (list, tuple)) else cloud.data
    rows = np.ndarray(shape, record, data, strides=strides).astype(record.newbyteorder("="))
    return cloud_from_records(rows[0] if cloud.height == 1 else rows)


def _record(cloud: PointCloud2) -> np.dtype[Any]:
    """The dtype of a point, with the fields that are read."""
    fix = f"Send each field once, of a type from 1 to 8, within {cloud.point_step} bytes."
    order = ">" if cloud.is_bigendian else "<"
    found = [field for field in cloud.fields if field.name in PCL_FIELDS and field.count <= 1]
    kinds = {field.name: field.datatype for field in found}
    if missing := [axis for axis in "xyz" if kinds.get(axis) not in (7, 8)]:
        value = ", ".join(f"{field.name} of type {field.datatype}" for field in cloud.fields)
        wanted = f"Send {', '.join(missing)} too, as 7 (float32) or 8 (float64), metres."
        raise InvalidRequest("point_cloud2.fields", value[:80], wanted)
    for field in found:  # NumPy adds them in 32 bits
        size = np.dtype(POINT_TYPES.get(field.datatype, "V")).itemsize
        if not size or field.offset + size > cloud.point_step:
            value = f"{field.name} of type {field.datatype} at byte {field.offset}"
            raise InvalidRequest("point_cloud2.fields", value, fix)
    formats = [order + POINT_TYPES[field.datatype] for field in found]
    names, offsets = [field.name for field in found], [field.offset for field in found]
    size = cloud.point_step
    try:
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})
    except ValueError as error:  # a duplicate name
        raise InvalidRequest("point_cloud2.fields", str(error), fix) from None
