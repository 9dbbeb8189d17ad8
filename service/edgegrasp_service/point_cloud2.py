"""Read the layout of sensor_msgs/PointCloud2."""

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import Strict
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.npy_file import check_count
from edgegrasp_service.point_records import columns, unpacked_colors
from edgegrasp_service.sent_fields import Bytes, parse_fields

FIELD = "point_cloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
NORMALS = ("normal_x", "normal_y", "normal_z")
COLORS = ("rgb", "rgba")  # packed in 4 bytes


Size = Annotated[int, Field(ge=0, lt=2**31)]


class PointField(Strict):
    """One field of every point."""

    name: str
    offset: Size = Field(description="bytes from the start of the point")
    datatype: int = Field(ge=1, le=8, description="as in sensor_msgs/PointField; 7 is float32")
    count: Size = Field(default=1, description="numbers in the field; 0 means 1")


class PointCloud2(Strict):
    """A cloud in the layout of sensor_msgs/PointCloud2, metres."""

    height: Size
    width: Size
    fields: tuple[PointField, ...] = Field(min_length=3, max_length=64)
    is_bigendian: bool = False
    point_step: Size = Field(description="bytes from point to point")
    row_step: Size = Field(description="bytes from row to row")
    data: Bytes = Field(description="height * row_step bytes, as base64 in JSON")


def read_point_cloud2(fields: object, max_points: int) -> CloudInput:
    """Read x, y, z of a cloud, and normals and colours where there are any.

    Args:
        fields: As PointCloud2; `data` as bytes or base64.
        max_points: Most points accepted.

    Returns:
        Points (N, 3), or (H, W, 3) where the height is 2 or more.

    Raises:
        InvalidRequest: A field is missing, unknown or wrong, or they contradict each other.
        PayloadTooLarge: More than `max_points` points.
    """
    layout = parse_fields(PointCloud2, fields, FIELD)
    check_count(layout.height * layout.width, max_points, FIELD)
    record = _record(layout)
    if layout.row_step < layout.width * layout.point_step:
        value = f"{layout.row_step} for {layout.width} points of {layout.point_step} bytes"
        raise InvalidRequest(f"{FIELD}.row_step", value, "Send width * point_step or more.")
    expected = layout.height * layout.row_step
    if len(layout.data) != expected:
        value = f"{len(layout.data)} bytes where height * row_step is {expected}"
        raise InvalidRequest(f"{FIELD}.data", value, "Send the whole cloud.")
    shape, strides = (layout.height, layout.width), (layout.row_step, layout.point_step)
    if 0 in shape:
        return CloudInput(np.empty((0, 3), np.float32))
    rows = np.ndarray(shape, record, layout.data, strides=strides).astype(record.newbyteorder("="))
    if layout.height == 1:
        rows = rows[0]
    return CloudInput(
        points=columns(rows, ("x", "y", "z")),
        normals=columns(rows, NORMALS),
        colors=_colors(rows),
    )


def _record(layout: PointCloud2) -> np.dtype[Any]:
    """The layout of a point, of the fields that are read."""
    order = ">" if layout.is_bigendian else "<"
    found: dict[str, tuple[str, int]] = {}
    for row, field in enumerate(layout.fields):
        kind = order + TYPES[field.datatype]
        size = np.dtype(kind).itemsize * max(1, field.count)
        if field.offset + size > layout.point_step:
            value = f"{field.name!r} of {size} bytes at {field.offset}"
            fix = f"Send fields within point_step = {layout.point_step}."
            raise InvalidRequest(f"{FIELD}.fields.{row}.offset", value, fix)
        if field.name in found:
            raise InvalidRequest(f"{FIELD}.fields.{row}.name", repr(field.name), "Send it once.")
        if field.name in ("x", "y", "z") and (field.datatype not in (7, 8) or field.count > 1):
            value = f"{field.datatype} with count {field.count} for {field.name!r}"
            fix = "Send one 7 (float32) or 8 (float64), metres."
            raise InvalidRequest(f"{FIELD}.fields.{row}.datatype", value, fix)
        if field.count <= 1:
            found[field.name] = (kind, field.offset)
    missing = [axis for axis in "xyz" if axis not in found]
    if missing:
        value = ", ".join(found)[:80] or "no single numbers"
        raise InvalidRequest(f"{FIELD}.fields", value, f"Send {', '.join(missing)} too.")
    names = [name for name in ("x", "y", "z", *NORMALS, *COLORS) if name in found]
    return np.dtype(
        {
            "names": names,
            "formats": [found[name][0] for name in names],
            "offsets": [found[name][1] for name in names],
            "itemsize": layout.point_step,
        }
    )


def _colors(rows: NDArray[np.void]) -> NDArray[np.uint8] | None:
    for name in COLORS:
        if name in (rows.dtype.names or ()) and rows.dtype[name].itemsize == 4:
            return unpacked_colors(rows[name])
    return None
