"""What a caller asks, checked as far as it can be without the server.

Also what makes a request of a segmenter's mask, or of an object's cloud and its scene's.
"""

from collections.abc import AsyncIterable, AsyncIterator, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Unpack

from edgegrasp_camera.arrays import Array, Float32
from edgegrasp_client.clouds import Cloud, DepthImage
from edgegrasp_client.errors import invalid
from edgegrasp_client.options import DetectOptions

SAME_POINT = 0.005  # metres: the side of a cell in which the scene repeats the object


class StreamRequest:
    """One request of a stream; arguments as of `GraspClient.detect`.

    Attributes:
        request: The cloud and what comes with it.
        request_id: What the answer is called; empty: the number of the request, from 0.
        timeout: Seconds until nobody wants the answer any more; None: the stream's.

    Raises:
        InvalidRequestError: There is no cloud, or more than one; an array or an option is wrong.
    """

    def __init__(
        self,
        cloud: Cloud | None = None,
        *,
        request_id: str = "",
        timeout: float | None = None,
        depth_images: Sequence[DepthImage] | None = None,
        normals: Array | None = None,
        colors: Array | None = None,
        segment_ids: Array | None = None,
        view_ids: Array | None = None,
        **options: Unpack[DetectOptions],
    ) -> None:
        plain = plain_options(options)
        arrays = (normals, colors, segment_ids, view_ids)
        self.request = Request(cloud, depth_images, *arrays, options=plain)
        self.request_id = request_id
        self.timeout = timeout

    def name(self, number: int) -> str:
        """Its own name, or its number in the stream."""
        return self.request_id or str(number)


@dataclass(frozen=True)
class Request:
    """A cloud or depth images, arrays with an entry for each row of the cloud, and options.

    Raises:
        InvalidRequestError: There is no cloud, or more than one; an array is of a wrong kind.
    """

    cloud: Cloud | None = None
    depth_images: Sequence[DepthImage] | None = None
    normals: Array | None = None
    colors: Array | None = None
    segment_ids: Array | None = None
    view_ids: Array | None = None
    options: Mapping[str, Any] = field(default_factory=dict)  # as of `plain_options`

    def __post_init__(self) -> None:
        if (self.cloud is None) == (self.depth_images is None):
            value = "nothing" if self.cloud is None else "a cloud beside depth_images"
            raise invalid("cloud", value, "Give a cloud or depth_images.")
        self.row_arrays()

    def row_arrays(self) -> dict[str, Array]:
        """The arrays beside the cloud: (N, 3) float32 or (N,) int32."""
        vectors = {"normals": self.normals, "colors": self.colors}
        integers = {"segment_ids": self.segment_ids, "view_ids": self.view_ids}
        return {
            **{name: _vectors(name, a) for name, a in vectors.items() if a is not None},
            **{name: _integers(name, a) for name, a in integers.items() if a is not None},
        }


@dataclass(frozen=True)
class ScoreRequest(Request):
    """A request, and the edges (M, 2) or hand poses (M, 4, 4) to score in its cloud."""

    edges: Array | None = None
    hand_poses: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.edges is None) == (self.hand_poses is None):
            value = "nothing" if self.edges is None else "edges beside hand_poses"
            raise invalid("edges", value, "Give edges or hand_poses.")
        rows, poses = "an array (M, 2) of rows of the cloud", "an array (M, 4, 4) of T_cloud_hand"
        if self.edges is not None:
            _check("edges", self.edges, "iu", lambda shape: shape[1:] == (2,), rows)
        else:
            _check("hand_poses", self.hand_poses, "f", lambda shape: shape[1:] == (4, 4), poses)


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as JSON has them: lists instead of arrays, and those left out that are None.

    Masks stay arrays, which each transport packs: (N,) bool.

    `suppression` and `support` alone have a None of their own: none.

    Raises:
        InvalidRequestError: An option has no such name.
    """
    known = DetectOptions.__annotations__
    for name in options:
        if name not in known:
            fix = f"Remove it; the options are: {', '.join(known)}."
            raise invalid(f"options.{name}", "an unknown field", fix)
    return {
        name: _plain(value)
        for name, value in options.items()
        if value is not None or name in ("suppression", "support")
    }


def on_mask(mask: Array, options: Mapping[str, Any] | None = None) -> DetectOptions:
    """Options that allow approach and contact points only where a mask is not 0.

    Args:
        mask: (H, W) or (H, W, C), a value for each pixel of the depth image or row of the cloud,
            as a segmentation network gives it; any channel but a fourth, which is transparency.
        options: What else is asked; regions in it are narrowed.

    Returns:
        The options with both regions. What lies outside of the mask stays an obstacle.
    """
    kept = mask[..., :3].any(axis=2) if mask.ndim == 3 else mask != 0
    asked = dict(options or {})
    for name in ("approach_region", "contact_region"):
        region = asked.get(name) or {}
        outside = {"kind": "mask", "mask": ~kept}
        asked[name] = {**region, "exclude": [*region.get("exclude", ()), outside]}
    return cast("DetectOptions", asked)


def object_in_scene(
    object_points: ArrayLike, scene_points: ArrayLike
) -> tuple[Float32, NDArray[np.int32]]:
    """One cloud of an object and of the scene around it, which are sent apart.

    Args:
        object_points: (N, 3) metres, what is to be grasped.
        scene_points: (M, 3) metres, the same frame; with the object or without it.

    Returns:
        `cloud` (K, 3) and `segment_ids` (K,) for `GraspClient.detect`: 1 the object, 0 the rest,
        without the points of the scene that repeat the object.
    """
    clouds = [np.asarray(each, np.float32).reshape(-1, 3) for each in (object_points, scene_points)]
    wanted, scene = (each[np.isfinite(each).all(axis=1)] for each in clouds)
    digits = np.array([2**42, 2**21, 1])  # one number of three, each below 5 km
    cells = [np.floor(each / SAME_POINT).astype(np.int64) @ digits for each in (wanted, scene)]
    rest = scene[~np.isin(cells[1], cells[0])]
    segment_ids = np.repeat(np.array([1, 0], np.int32), [len(wanted), len(rest)])
    return np.concatenate([wanted, rest]), segment_ids


async def async_enumerate(
    requests: AsyncIterable[StreamRequest] | Iterable[StreamRequest],
) -> AsyncIterator[tuple[int, StreamRequest]]:
    """The requests with their numbers, from 0."""
    if isinstance(requests, AsyncIterable):
        number = 0
        async for request in requests:
            yield number, request
            number += 1
    else:
        for numbered in enumerate(requests):
            yield numbered


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype == bool:
        return value.ravel()
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value


def _vectors(name: str, array: Array) -> Array:
    rows = "an array of numbers, three for each row of the cloud"
    _check(name, array, "iuf", lambda shape: shape[-1:] == (3,), rows)
    return np.ascontiguousarray(array.reshape(-1, 3), dtype=np.float32)


def _integers(name: str, array: Array) -> Array:
    rows = "an array of integers, one for each row of the cloud, within 32 bits"
    _check(name, array, "iu", lambda _: True, rows)
    if array.size and (array.max() >= 2**31 or array.min() < -(2**31)):
        raise invalid(name, f"values from {array.min()} to {array.max()}", f"Give {rows}.")
    return np.ascontiguousarray(array.reshape(-1), dtype=np.int32)


def _check(
    name: str, array: object, kinds: str, fits: Callable[[tuple[int, ...]], bool], wanted: str
) -> None:
    """Raise InvalidRequestError unless it is an array of such dtype kinds and a shape that fits."""
    if not isinstance(array, np.ndarray):
        raise invalid(name, f"a {type(array).__name__}", f"Give {wanted}.")
    if array.dtype.kind not in kinds:
        raise invalid(name, f"dtype {array.dtype}", f"Give {wanted}.")
    if not fits(array.shape):
        raise invalid(name, f"shape {array.shape}", f"Give {wanted}.")
