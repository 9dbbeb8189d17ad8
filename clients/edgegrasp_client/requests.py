"""The request of a caller, checked as far as possible without the server, in the forms of the wire.

Also helpers that build a request from a segmentation mask, or from an object's cloud and its
scene's.
"""

import io
import json
from collections.abc import Mapping, Sequence
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import NotRequired, TypedDict, Unpack

from edgegrasp_camera import InvalidRequest
from edgegrasp_camera.arrays import Array, Float32
from edgegrasp_camera.clouds import PointCloud2, read_point_cloud2
from edgegrasp_camera.depth import ENCODINGS, Intrinsics, intrinsics_of
from edgegrasp_camera.files import FILE_FORMATS
from edgegrasp_client.connection import invalid, seconds_of
from edgegrasp_client.options import DetectOptions

SCENE_CELL = 0.005  # metres: the side of a cell in which the scene repeats the object
DEPTH_ENCODINGS = {np.dtype(kind).name: name for name, kind in ENCODINGS.items()}  # by dtype


class DepthImage(TypedDict):
    """An image of a depth camera. Camera frame: x right, y down, z forward."""

    # (H, W), 0 or NaN where there is no reading: metres as float32 or float64, millimetres as
    # uint16. Or the path of a file that holds it: .npy, or .png of 16 bits.
    depth: Array | str | PathLike[str]
    # In pixels, the centre of the top left pixel is (0, 0): fx, fy, cx, cy in this order or by
    # name; or the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
    intrinsics: Intrinsics | Mapping[str, float] | Sequence[float] | Array
    # (4, 4) camera to cloud, metres; left out: the cloud's frame is the camera's.
    T_cloud_camera: NotRequired[Array | Sequence[Sequence[float]]]
    # Metres that one unit of the depth is worth; None: 0.001 for integers, 1 for floats.
    depth_scale: NotRequired[float | None]


Cloud = Array | str | PathLike[str] | PointCloud2
PER_POINT_ARRAYS = ("normals", "colors", "segment_ids", "view_ids")
# Of each array: the dtype that is sent, and the shape of a row.
ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "normals": ("float32", (3,)),
    "colors": ("float32", (3,)),
    "segment_ids": ("int32", ()),
    "view_ids": ("int32", ()),
    "edges": ("int32", (2,)),
    "hand_poses": ("float64", (4, 4)),
}


class RequestFields(DetectOptions, total=False):
    """What may come with a cloud: options, arrays, and images in its place; N rows of the cloud."""

    # Views to fuse in place of a cloud; their cameras are the viewpoints, and the rows of the cloud
    # their pixels, one image after the other.
    depth_images: Sequence[DepthImage] | None
    normals: Array | None  # (N, 3) outward, of any length
    colors: Array | None  # (N, 3)
    segment_ids: Array | None  # (N,) integers, which `segments` of a region name
    view_ids: Array | None  # (N,) integers: which of several positions of `viewpoint` saw each row


class Request:
    """A cloud or depth images, with options and arrays; InvalidRequestError: a wrong one."""

    def __init__(
        self,
        cloud: Cloud | None,
        fields: Mapping[str, Any],  # as RequestFields
        # edges and hand_poses, one of them None
        to_score: Mapping[str, Array | None] | None = None,
    ) -> None:
        given, self.scores = dict(fields), to_score is not None
        images: Sequence[DepthImage] | None = given.pop("depth_images", None)
        beside = {name: given.pop(name, None) for name in PER_POINT_ARRAYS} | dict(to_score or {})
        self.options = plain_options(given)
        if (cloud is None) == (images is None):
            value = "nothing" if cloud is None else "a cloud beside depth_images"
            raise invalid("cloud", value, "Give a cloud or depth_images.")
        if to_score and (to_score["edges"] is None) == (to_score["hand_poses"] is None):
            value = "nothing" if to_score["edges"] is None else "edges beside hand_poses"
            raise invalid("edges", value, "Give edges or hand_poses.")
        if isinstance(cloud, PointCloud2):  # points and normals are all that a grasp depends on
            try:
                read: Any = read_point_cloud2(cloud)
            except InvalidRequest as error:
                raise invalid(error.field, error.value, error.fix) from None
            cloud = read.points
            beside["normals"] = read.normals if beside["normals"] is None else beside["normals"]
        self.cloud = cloud
        self.depth_images = [depth_image_fields(one, row) for row, one in enumerate(images or ())]
        self.arrays = {name: _sent(name, one) for name, one in beside.items() if one is not None}


class StreamRequest(Request):
    """One request of a stream; `cloud` and `fields` as of `GraspClient.detect`."""

    def __init__(
        self,
        cloud: Cloud | None = None,
        *,
        request_id: str = "",  # of the answer; empty: the number of the request, from 0
        timeout: float | None = None,  # seconds until it is no longer wanted; None: the stream's
        **fields: Unpack[RequestFields],
    ) -> None:
        super().__init__(cloud, fields)
        self.request_id = request_id
        self.timeout = None if timeout is None else seconds_of(timeout)


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options in JSON form: lists instead of arrays, without those that are None.

    Masks stay (N,) bool arrays, which each transport packs.

    For `suppression` and `support`, None has a meaning of its own: none.

    Raises:
        InvalidRequestError: An option's name is unknown.
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


def option_of_text(value: Any) -> Any:
    """The value of an option that another program gives: text that is JSON stands for its value."""
    try:
        return json.loads(value) if isinstance(value, str) else value
    except (RecursionError, ValueError):
        return value


def on_mask(mask: Array, options: Mapping[str, Any] | None = None) -> DetectOptions:
    """Options that allow approach and contact points only where a mask is not 0.

    The mask is (H, W) or (H, W, C), for each pixel of the depth image or row of the cloud, as a
    segmentation network gives it; transparency, the last of two or four channels, is ignored.
    Regions in `options` are narrowed; points outside stay obstacles.
    """
    colors = mask[..., : 1 if mask.shape[2:] == (2,) else 3]
    kept = colors.any(axis=2) if mask.ndim == 3 else mask != 0
    asked = dict(options or {})
    for name in ("approach_region", "contact_region"):
        region = asked.get(name) or {}
        outside = {"kind": "mask", "mask": ~kept}
        asked[name] = {**region, "exclude": [*region.get("exclude", ()), outside]}
    return cast("DetectOptions", asked)


def object_in_scene(
    object_points: ArrayLike, scene_points: ArrayLike
) -> tuple[Float32, NDArray[np.int32]]:
    """Merge the cloud (N, 3) of an object with that of its scene, (M, 3), with it or without it.

    Both are in metres and in one frame.

    Returns:
        `cloud` (K, 3) and `segment_ids` (K,) for `GraspClient.detect`: 1 the object, 0 the rest,
        without the points of the scene that repeat the object.
    """
    clouds = [np.asarray(each, np.float32).reshape(-1, 3) for each in (object_points, scene_points)]
    wanted, scene = (each[np.isfinite(each).all(axis=1)] for each in clouds)
    digits = np.array([2**42, 2**21, 1])  # one number of three, each below 5 km
    cells = [np.floor(each / SCENE_CELL).astype(np.int64) @ digits for each in (wanted, scene)]
    rest = scene[~np.isin(cells[1], cells[0])]
    segment_ids = np.repeat(np.array([1, 0], np.int32), [len(wanted), len(rest)])
    return np.concatenate([wanted, rest]), segment_ids


# The forms of the wire


def cloud_file(cloud: Cloud) -> tuple[str, bytes]:
    """The cloud as a file, its format first, which is one of FILE_FORMATS.

    Points (N, 3) become float32. An array of a wrong shape is sent as it is, and the server refuses
    it.

    Raises:
        InvalidRequestError: It is neither an array of numbers nor a readable file of a known
            format.
    """
    if isinstance(cloud, np.ndarray) and not cloud.dtype.hasobject:
        if cloud.shape[1:] == (3,) and cloud.dtype in (np.float32, np.float64):
            with np.errstate(over="ignore"):  # the server refuses infinity
                cloud = np.ascontiguousarray(cloud, dtype=np.float32)
        return "npy", npy_bytes(np.ma.filled(cloud, np.nan))
    if not isinstance(cloud, str | PathLike):
        kind = f"a {type(cloud).__name__}"
        value = f"dtype {cloud.dtype}" if isinstance(cloud, np.ndarray) else kind
        fix = "Give an (N, 3) array of floats in metres, a file's path, or a PointCloud2."
        raise invalid("cloud", value, fix)
    path = Path(cloud)
    file_format = path.suffix[1:].lower()
    if file_format not in FILE_FORMATS:
        depth = "a depth image as `depth` with `intrinsics` in depth_images"
        fix = f"Give one of: {', '.join(FILE_FORMATS)}; {depth}."
        raise invalid("cloud", repr(path.name), fix)
    try:
        return file_format, path.read_bytes()
    except OSError as error:
        raise invalid("cloud", f"{path} ({error.strerror})", "Give a readable file.") from None


def npy_bytes(array: Array) -> bytes:
    """An array as an .npy file; raises ValueError for one of objects."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def depth_image_fields(image: DepthImage, number: int) -> dict[str, Any]:
    """The fields of edgegrasp.v1.DepthImage; `data` as bytes, the pose as a (4, 4) list.

    Raises InvalidRequestError, with the image's number, for a field that is missing, unknown or
    wrong.
    """
    path = f"depth_images.{number}"
    needed, known = DepthImage.__required_keys__, DepthImage.__annotations__
    if not isinstance(image, Mapping) or not needed <= set(image) <= set(known):
        found = ", ".join(map(str, image)) if isinstance(image, Mapping) else type(image).__name__
        fix = "Give a mapping with depth and intrinsics, T_cloud_camera and depth_scale or not."
        raise invalid(path, found[:80], fix)
    given = image.get("T_cloud_camera", np.eye(4))
    pose = np.asarray(given, dtype=object)  # also rows of different lengths
    if pose.shape != (4, 4) or not all(isinstance(each, Real) for each in pose.flat):
        raise invalid(f"{path}.T_cloud_camera", repr(given)[:80], "Give a 4 x 4 matrix.")
    depth = _depth_fields(image["depth"], f"{path}.depth")
    try:
        intrinsics = intrinsics_of(image["intrinsics"])._asdict()
    except ValueError:
        fix = "Give fx, fy, cx, cy in pixels, or the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."
        raise invalid(f"{path}.intrinsics", repr(image["intrinsics"])[:80], fix) from None
    camera = {"intrinsics": intrinsics, "T_cloud_camera": pose.astype(float)}
    return dict(_plain({"depth": depth, **camera, "depth_scale": image.get("depth_scale")}))


def _depth_fields(depth: object, path: str) -> dict[str, Any]:
    """The fields of edgegrasp.v1.Depth; a .png file is sent as it is."""
    fix = f"Give an (H, W) array of {', '.join(DEPTH_ENCODINGS)}, or a .png or .npy file of one."
    if isinstance(depth, str | PathLike):
        file = Path(depth)
        try:
            if file.suffix.lower() == ".png":
                return {"encoding": "png", "data": file.read_bytes()}
            if file.suffix.lower() != ".npy":
                raise ValueError("neither .png nor .npy")
            depth = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise invalid(path, f"{file} ({error})", fix) from None
    if not isinstance(depth, np.ndarray):
        raise invalid(path, f"a {type(depth).__name__}", fix)
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    depth = np.ma.filled(depth, 0)
    if depth.ndim != 2 or depth.dtype.name not in DEPTH_ENCODINGS:
        raise invalid(path, f"shape {depth.shape}, dtype {depth.dtype}", fix)
    return {
        "height": depth.shape[0],
        "width": depth.shape[1],
        "encoding": DEPTH_ENCODINGS[depth.dtype.name],
        "data": np.ascontiguousarray(depth, dtype=depth.dtype.newbyteorder("<")).tobytes(),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype == bool:
        return value.ravel()
    if hasattr(value, "tolist"):  # also array.array, as rclpy has parameters
        return value.tolist()
    if isinstance(value, Mapping):
        mask = value.get("mask")
        if isinstance(mask, np.ndarray) and mask.dtype.kind in "iu":  # images of 0 and 255
            value = {**value, "mask": mask != 0}
        return {name: _plain(part) for name, part in value.items() if part is not None}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(part) for part in value]
    return value


def _sent(name: str, array: object) -> Array:
    """An array of the request as it is sent; raises InvalidRequestError where it is none."""
    kind, row = ARRAYS[name]
    fix = f"Give an array of {kind} numbers, of shape ({', '.join(['N', *map(str, row)])})."
    if not isinstance(array, np.ndarray):
        raise invalid(name, f"a {type(array).__name__}", fix)
    rows = array.ndim - len(row)  # 2 where the cloud is organised
    if rows < 1 or array.shape[rows:] != row or not np.can_cast(array.dtype, kind, "same_kind"):
        raise invalid(name, f"shape {array.shape}, dtype {array.dtype}", fix)
    if array.size and kind == "int32" and (array.max() >= 2**31 or array.min() < -(2**31)):
        raise invalid(name, f"values from {array.min()} to {array.max()}", fix)
    return np.ascontiguousarray(array.reshape(-1, *row), dtype=kind)
