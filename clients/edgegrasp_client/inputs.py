"""What a request is about: a cloud, what comes with it, and what to score in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_client.cloud_encoding import Cloud
from edgegrasp_client.depth_image import DepthImage
from edgegrasp_client.errors import invalid

Array = NDArray[Any]


@dataclass(frozen=True)
class Inputs:
    """A cloud or depth images, and arrays with an entry for each row of it."""

    cloud: Cloud | None = None
    depth_images: Sequence[DepthImage] | None = None
    normals: Array | None = None
    colors: Array | None = None
    segment_ids: Array | None = None
    view_ids: Array | None = None

    def __post_init__(self) -> None:
        """Raise InvalidRequestError unless there is one cloud, and arrays of the right kind."""
        if (self.cloud is None) == (self.depth_images is None):
            value = "nothing" if self.cloud is None else "a cloud beside depth_images"
            raise invalid("cloud", value, "Give a cloud or depth_images.")
        self.beside()

    def beside(self) -> dict[str, Array]:
        """The arrays beside the cloud: (N, 3) float32 or (N,) int32."""
        arrays = {}
        for name in ("normals", "colors"):
            if (array := getattr(self, name)) is not None:
                arrays[name] = _vectors(name, array)
        for name in ("segment_ids", "view_ids"):
            if (array := getattr(self, name)) is not None:
                arrays[name] = _integers(name, array)
        return arrays


@dataclass(frozen=True)
class Given:
    """Edges (M, 2) or hand poses (M, 4, 4) to score."""

    edges: Array | None = None
    hand_poses: Array | None = None

    def __post_init__(self) -> None:
        """Raise InvalidRequestError unless there is one of the two, in its shape."""
        if (self.edges is None) == (self.hand_poses is None):
            value = "nothing" if self.edges is None else "edges beside hand_poses"
            raise invalid("edges", value, "Give edges or hand_poses.")
        if self.edges is not None:
            _check("edges", self.edges, (2,), "iu", "(M, 2) rows of the cloud")
        else:
            _check("hand_poses", self.hand_poses, (4, 4), "f", "(M, 4, 4) matrices T_cloud_hand")


def _vectors(name: str, array: object) -> Array:
    fix = "Give an array of numbers, three for each row of the cloud."
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
        raise invalid(name, _kind(array), fix)
    if array.shape[-1:] != (3,):
        raise invalid(name, f"shape {array.shape}", fix)
    return np.ascontiguousarray(array.reshape(-1, 3), dtype=np.float32)


def _integers(name: str, array: object) -> Array:
    fix = "Give an array of integers, one for each row of the cloud, within 32 bits."
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iu":
        raise invalid(name, _kind(array), fix)
    if array.size and (array.max() >= 2**31 or array.min() < -(2**31)):
        raise invalid(name, f"values from {array.min()} to {array.max()}", fix)
    return np.ascontiguousarray(array.reshape(-1), dtype=np.int32)


def _check(name: str, array: object, shape: tuple[int, ...], kinds: str, fix: str) -> None:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
        raise invalid(name, _kind(array), f"Give an array {fix}.")
    if array.shape[1:] != shape:
        raise invalid(name, f"shape {array.shape}", f"Give an array {fix}.")


def _kind(array: object) -> str:
    return f"dtype {array.dtype}" if isinstance(array, np.ndarray) else f"a {type(array).__name__}"
