"""ROS point clouds, as the wire takes them; ROS itself is not needed."""

from collections.abc import Sequence
from typing import Any, Protocol, TypeGuard

import numpy as np


class PointField(Protocol):
    """The attributes of sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


class PointCloud2(Protocol):
    """The attributes of sensor_msgs/PointCloud2, metres."""

    height: int
    width: int
    fields: Sequence[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Any  # bytes, or a sequence of their values


def is_point_cloud2(cloud: object) -> TypeGuard[PointCloud2]:
    """Whether an object has the attributes of sensor_msgs/PointCloud2."""
    names = PointCloud2.__annotations__
    return all(hasattr(cloud, name) for name in names)


def point_cloud2_fields(cloud: PointCloud2) -> dict[str, Any]:
    """The fields of edgegrasp.v1.PointCloud2; `data` as bytes.

    Args:
        cloud: Any object with those attributes, such as a message of rclpy.
    """
    data = cloud.data
    if not isinstance(data, bytes):
        data = np.asarray(data, dtype=np.uint8).tobytes()
    return {
        "height": int(cloud.height),
        "width": int(cloud.width),
        "fields": [
            {
                "name": str(field.name),
                "offset": int(field.offset),
                "datatype": int(field.datatype),
                "count": int(field.count),
            }
            for field in cloud.fields
        ],
        "is_bigendian": bool(cloud.is_bigendian),
        "point_step": int(cloud.point_step),
        "row_step": int(cloud.row_step),
        "data": data,
    }
