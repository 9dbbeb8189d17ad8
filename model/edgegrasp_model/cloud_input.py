"""A caller's cloud and what comes with it: normals, segments, which camera saw each point."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.cloud import Float32, validate_cloud
from edgegrasp_model.errors import InvalidRequest


@dataclass(frozen=True)
class CloudInput:
    """A cloud as a caller sends it; rows are counted row-major where it is organised.

    Per-point arrays have one entry for each point, in the shape of the cloud or flat.
    """

    points: object  # (N, 3), or (H, W, 3) with NaN where there is no point; float32/64, metres
    normals: object | None = None  # like points, outward, any length; used as they are
    colors: object | None = None  # like points; checked, and not used by any network so far
    segment_ids: object | None = None  # (N,) or (H, W) integers
    view_ids: object | None = None  # (N,) or (H, W) integers: which of options.viewpoint saw it


@dataclass(frozen=True)
class CheckedCloud:
    """The finite points of a cloud, and what comes with them."""

    points: Float32  # (N, 3) metres
    row: NDArray[np.int64]  # (N,) each point's row in the cloud as sent
    rows_sent: int
    normals: Float32 | None = None  # (N, 3)
    segment_ids: NDArray[np.int64] | None = None  # (N,)
    view_ids: NDArray[np.int64] | None = None  # (N,)

    def take(self, kept: NDArray[np.bool_]) -> "CheckedCloud":
        """The points for which `kept` (N,) holds; rows are counted as before."""
        return CheckedCloud(
            self.points[kept],
            self.row[kept],
            self.rows_sent,
            None if self.normals is None else self.normals[kept],
            None if self.segment_ids is None else self.segment_ids[kept],
            None if self.view_ids is None else self.view_ids[kept],
        )


def check_cloud(cloud: object, num_approach_points: int = 1) -> CheckedCloud:
    """Check a caller's cloud, and drop the holes of an organised one.

    Args:
        cloud: A CloudInput, or an array of points alone.
        num_approach_points: How many of its points the caller wants as approach points.

    Raises:
        InvalidRequest: An array is of the wrong type, dtype or shape, or holds what it must not;
            names `cloud`, `normals`, `colors`, `segment_ids` or `view_ids`.
    """
    sent = cloud if isinstance(cloud, CloudInput) else CloudInput(cloud)
    points = sent.points
    kept = None
    if isinstance(points, np.ndarray) and points.ndim == 3 and points.shape[2] == 3:
        points = points.reshape(-1, 3)
        if points.dtype in (np.float32, np.float64):
            kept = np.flatnonzero(np.isfinite(points).all(axis=1))
            points = points[kept]
            if len(points) == 0:
                raise InvalidRequest("cloud", "holes only", "Send finite points among the holes.")
    valid = validate_cloud(points, num_approach_points)
    row = np.arange(len(valid)) if kept is None else kept
    size = len(sent.points.reshape(-1, 3)) if isinstance(sent.points, np.ndarray) else len(valid)
    _floats("colors", sent.colors, size, None)
    return CheckedCloud(
        valid,
        row.astype(np.int64),
        size,
        _floats("normals", sent.normals, size, row),
        _integers("segment_ids", sent.segment_ids, size, row),
        _integers("view_ids", sent.view_ids, size, row),
    )


def _floats(
    field: str, array: object | None, size: int, row: NDArray[np.int64] | None
) -> Float32 | None:
    """The given rows of an (N, 3) or (H, W, 3) array beside the cloud; None: only check it."""
    if array is None:
        return None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fui":
        raise InvalidRequest(field, _kind(array), "Send an array of numbers, three for each point.")
    if array.shape[-1:] != (3,) or array.size != 3 * size:
        fix = f"Send three numbers for each of the cloud's {size} points."
        raise InvalidRequest(field, f"shape {array.shape}", fix)
    if row is None:
        return None
    values = np.ascontiguousarray(array.reshape(-1, 3)[row], dtype=np.float32)
    if not np.isfinite(values).all():
        bad = int(row[np.argmin(np.isfinite(values).all(axis=1))])
        raise InvalidRequest(field, f"NaN or infinity in row {bad}", "Send finite numbers.")
    return values


def _integers(
    field: str, array: object | None, size: int, row: NDArray[np.int64]
) -> NDArray[np.int64] | None:
    """The given rows of an (N,) or (H, W) array beside the cloud."""
    if array is None:
        return None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iu":
        raise InvalidRequest(field, _kind(array), "Send an array of integers, one for each point.")
    if array.size != size:
        fix = f"Send one integer for each of the cloud's {size} points."
        raise InvalidRequest(field, f"shape {array.shape}", fix)
    return array.reshape(-1)[row].astype(np.int64)


def _kind(array: object) -> str:
    return f"dtype {array.dtype}" if isinstance(array, np.ndarray) else f"a {type(array).__name__}"
