"""Clouds as bytes for the wire."""

import io
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_client.errors import invalid
from edgegrasp_client.point_cloud2 import PointCloud2

FILE_FORMATS = ("npy", "npz", "ply", "pcd", "xyz")

Cloud = NDArray[Any] | str | PathLike[str] | PointCloud2


@dataclass(frozen=True)
class CloudFile:
    """A point cloud file."""

    format: str  # one of FILE_FORMATS
    data: bytes


def packable(cloud: Cloud) -> NDArray[np.float32] | None:
    """The cloud as (N, 3) float32 if it is an array of N points; None if it is not."""
    if not isinstance(cloud, np.ndarray) or cloud.dtype not in (np.float32, np.float64):
        return None
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        return None
    with np.errstate(over="ignore"):  # the server refuses infinity
        return np.ascontiguousarray(cloud, dtype=np.float32)


def cloud_file(cloud: Cloud) -> CloudFile:
    """The cloud as a file; an array that is no cloud goes as it is, for the server to refuse.

    Raises:
        InvalidRequestError: It is neither an array of numbers nor a readable file of a known
            format.
    """
    if isinstance(cloud, np.ndarray):
        points = packable(cloud)
        return _npy(cloud if points is None else points)
    if not isinstance(cloud, str | PathLike):
        kind = type(cloud).__name__
        fix = "Give an (N, 3) array in metres, a file's path, or a PointCloud2."
        raise invalid("cloud", f"a {kind}", fix)
    path = Path(cloud)
    file_format = path.suffix[1:].lower()
    if file_format not in FILE_FORMATS:
        raise invalid("cloud", repr(path.name), f"Give one of: {', '.join(FILE_FORMATS)}.")
    try:
        return CloudFile(file_format, path.read_bytes())
    except OSError as error:
        raise invalid("cloud", f"{path} ({error.strerror})", "Give a readable file.") from None


def _npy(array: NDArray[Any]) -> CloudFile:
    try:
        return CloudFile("npy", npy_bytes(array))
    except ValueError:
        raise invalid("cloud", f"dtype {array.dtype}", "Send float32 or float64 metres.") from None


def npy_bytes(array: NDArray[Any]) -> bytes:
    """An array as an .npy file; raises ValueError for one of objects."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()
