"""Turn what arrived on the wire into arrays; whether they suit is the detector's part.

Nothing is unpickled, and no count in a header is trusted before it is compared with the bytes at
hand: a short body cannot make the server allocate a large array.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest, brief
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.errors import UnsupportedMediaType
from edgegrasp_service.npy_file import check_count, read_npy, read_npz
from edgegrasp_service.pcd_file import read_pcd
from edgegrasp_service.ply_file import read_ply
from edgegrasp_service.sent_arrays import numbers_from_lists
from edgegrasp_service.xyz_file import read_xyz

Array = NDArray[Any]


def decode_packed(data: bytes, max_points: int) -> Array:
    """Read packed little-endian float32 x, y, z.

    Returns:
        (N, 3) float32, metres.

    Raises:
        InvalidRequest: The bytes are no whole number of points.
        PayloadTooLarge: More than `max_points` points.
    """
    if len(data) % 12:
        raise InvalidRequest(
            "points",
            f"{len(data)} bytes, which are no whole number of points",
            "Send 12 bytes a point: little-endian float32 x, y, z.",
        )
    check_count(len(data) // 12, max_points)
    return np.frombuffer(data, dtype="<f4").reshape(-1, 3)


def decode_list(points: object, max_points: int) -> Array:
    """Read the lists of a JSON body; a hole of an organised cloud is [null, null, null].

    Returns:
        The same numbers as float64, of the shape they came in.

    Raises:
        InvalidRequest: No list, rows of different lengths, or something other than numbers.
        PayloadTooLarge: More than `max_points` points.
    """
    if not isinstance(points, list):
        raise InvalidRequest("points", brief(points), "Send a list of [x, y, z] in metres.")
    check_count(len(points), max_points)
    if not points:
        return np.empty((0, 3))
    array = numbers_from_lists("points", points, holes=True)
    check_count(array.size // 3, max_points)
    return array.astype(np.float64)


def decode_file(file_format: str, data: bytes, max_points: int) -> CloudInput:
    """Read a point cloud file.

    Args:
        file_format: One of FILE_FORMATS.
        data: The file's bytes.
        max_points: Most points accepted.

    Returns:
        The arrays in the file, of whatever shape and dtype; points (N, 3) for ply, pcd and xyz.

    Raises:
        InvalidRequest: The file is truncated, or no file of that format.
        PayloadTooLarge: More than `max_points` points.
        DecoderMissing: The reader of this format is not installed.
        UnsupportedMediaType: No such format.
    """
    if file_format not in _DECODERS:
        known = ", ".join(FILE_FORMATS)
        raise UnsupportedMediaType("format", repr(file_format), f"Send one of: {known}.")
    return _DECODERS[file_format](data, max_points)


def _decode_npy(data: bytes, max_points: int) -> CloudInput:
    return CloudInput(read_npy(data, max_points))


def _decode_npz(data: bytes, max_points: int) -> CloudInput:
    return CloudInput(**read_npz(data, max_points))


def _decode_ply(data: bytes, max_points: int) -> CloudInput:
    return read_ply(data, lambda count: check_count(count, max_points))


def _decode_pcd(data: bytes, max_points: int) -> CloudInput:
    return read_pcd(data, lambda count: check_count(count, max_points))


def _decode_xyz(data: bytes, max_points: int) -> CloudInput:
    return read_xyz(data, lambda count: check_count(count, max_points))


_DECODERS: dict[str, Callable[[bytes, int], CloudInput]] = {
    "npy": _decode_npy,
    "npz": _decode_npz,
    "ply": _decode_ply,
    "pcd": _decode_pcd,
    "xyz": _decode_xyz,
}

FILE_FORMATS = tuple(_DECODERS)
