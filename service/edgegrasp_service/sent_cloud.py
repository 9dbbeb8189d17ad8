"""A cloud as it arrived, whatever transport it came by, and what came with it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.cloud_decoding import decode_file, decode_list, decode_packed
from edgegrasp_service.depth_images import FIELD as DEPTH_IMAGES
from edgegrasp_service.depth_images import fuse_depth_images
from edgegrasp_service.point_cloud2 import read_point_cloud2
from edgegrasp_service.sent_arrays import SentArray


class Source(Protocol):
    """Points, not decoded yet."""

    def decode(self, max_points: int) -> CloudInput:
        """The points as arrays; raises an error of the table in `edgegrasp_service.errors`."""


@dataclass(frozen=True)
class PackedCloud:
    """Little-endian float32 x, y, z."""

    data: bytes

    def decode(self, max_points: int) -> CloudInput:
        """The points as an array."""
        return CloudInput(decode_packed(self.data, max_points))


@dataclass(frozen=True)
class ListCloud:
    """Points as the lists of a JSON body."""

    points: object

    def decode(self, max_points: int) -> CloudInput:
        """The points as an array."""
        return CloudInput(decode_list(self.points, max_points))


@dataclass(frozen=True)
class FileCloud:
    """A point cloud file."""

    format: str
    data: bytes

    def decode(self, max_points: int) -> CloudInput:
        """The arrays in the file."""
        return decode_file(self.format, self.data, max_points)


@dataclass(frozen=True)
class RosCloud:
    """The layout of sensor_msgs/PointCloud2, as plain values."""

    fields: object

    def decode(self, max_points: int) -> CloudInput:
        """The fields that are read, as arrays."""
        return read_point_cloud2(self.fields, max_points)


@dataclass(frozen=True)
class DepthCloud:
    """Depth images, as plain values."""

    images: object


@dataclass(frozen=True)
class SentCloud:
    """One cloud."""

    source: Source | DepthCloud
    beside: Mapping[str, SentArray] = field(default_factory=dict)  # of PER_POINT


def decode_cloud(
    sent: SentCloud, options: DetectOptions, max_points: int
) -> tuple[CloudInput, DetectOptions]:
    """Decode a cloud, and what its source says of the options: the cameras of depth images.

    Raises:
        InvalidRequest: It cannot be decoded, or the same thing is sent twice.
        PayloadTooLarge: More than `max_points` points.
        DecoderMissing: Its reader is not installed.
        UnsupportedMediaType: There is no reader for the file's format.
    """
    if isinstance(sent.source, DepthCloud):
        if options.viewpoint is not None:
            fix = f"Leave it out: the viewpoints are the cameras of {DEPTH_IMAGES}."
            raise InvalidRequest("options.viewpoint", repr(options.viewpoint)[:80], fix)
        if "view_ids" in sent.beside:
            fix = f"Leave it out: it follows from {DEPTH_IMAGES}."
            raise InvalidRequest("view_ids", f"an array beside {DEPTH_IMAGES}", fix)
        cloud, cameras = fuse_depth_images(sent.source.images, max_points)
        viewpoint = cameras[0] if len(cameras) == 1 else tuple(cameras)
        options = options.model_copy(update={"viewpoint": viewpoint})
    else:
        cloud = sent.source.decode(max_points)
    arrays: dict[str, Any] = {}
    for name, array in sent.beside.items():
        if getattr(cloud, name) is not None:
            value = "an array beside the one in the cloud"
            raise InvalidRequest(name, value, "Send it once.")
        arrays[name] = array.decode(name, max_points)
    return replace(cloud, **arrays) if arrays else cloud, options
