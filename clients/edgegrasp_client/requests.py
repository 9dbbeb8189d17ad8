"""A caller's request, checked as far as possible without the server, and its wire formats.

Also helpers that build a request from a segmentation mask, or from the clouds of an object and its
scene.
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
from edgegrasp_camera.depth import ENCODINGS, Intrinsics, to_intrinsics
from edgegrasp_camera.files import FILE_FORMATS
from edgegrasp_client.connection import checked_timeout, invalid
from edgegrasp_client.errors import PayloadTooLargeError
from edgegrasp_client.options import DetectOptions

MAX_FILE_BYTES = 2**30  # no server takes more
SCENE_VOXEL = 0.005  # metres, side of a cell: scene points in the object's cells are left out
DEPTH_ENCODINGS = {np.dtype(kind).name: name for name, kind in ENCODINGS.items()}  # by dtype


class DepthImage(TypedDict):
    """An image of a depth camera. Camera frame: x right, y down, z forward."""

    # (H, W), 0 or NaN where there is no reading: metres as float32 or float64, millimetres as
    # uint16. Or the path of a file that contains it: .npy, or a 16-bit .png.
    depth: Array | str | PathLike[str]
    # In pixels, with (0, 0) at the centre of the top left pixel: fx, fy, cx, cy in this order or by
    # name; or the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
    intrinsics: Intrinsics | Mapping[str, float] | Sequence[float] | Array
    # (4, 4) camera to cloud, metres; default: the cloud frame is the camera frame.
    T_cloud_camera: NotRequired[Array | Sequence[Sequence[float]]]
    # Metres per unit of the depth; None: 0.001 for integers, 1 for floats.
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
    """What a request may have besides a cloud of N rows: options and arrays, or depth images."""

    # Views to fuse instead of a cloud; the viewpoints are the cameras' positions, and the rows of
    # the cloud are the pixels, one image after another.
    depth_images: Sequence[DepthImage] | None
    normals: Array | None  # (N, 3) outward, of any length
    colors: Array | None  # (N, 3)
    segment_ids: Array | None  # (N,) integers, used by `segments` of a region
    view_ids: Array | None  # (N,) integers: index into `viewpoint` of the camera that saw each row


class Request:
    """A cloud or depth images, with options and arrays; raises InvalidRequestError."""

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
            value = "nothing" if cloud is None else "a cloud and depth_images"
            raise invalid("cloud", value, "Give a cloud or depth_images.")
        if to_score and (to_score["edges"] is None) == (to_score["hand_poses"] is None):
            value = "nothing" if to_score["edges"] is None else "edges and hand_poses"
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
    """One request of a stream; `cloud` and `fields` are those of `GraspClient.detect`."""

    def __init__(
        self,
        cloud: Cloud | None = None,
        *,
        request_id: str = "",  # of the answer; empty: the number of the request, from 0
        timeout: float | None = None,  # seconds until the answer is too late; None: the stream's
        **fields: Unpack[RequestFields],
    ) -> None:
        super().__init__(cloud, fields)
        self.request_id = request_id
        self.timeout = None if timeout is None else checked_timeout(timeout)


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options in JSON form: lists instead of arrays, without options that are None.

    Masks stay (N,) bool arrays, which each transport packs.

    `suppression` and `support` are kept if None, which disables them.

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
    """The value of an option from another program: text that is valid JSON is parsed."""
    try:
        return json.loads(value) if isinstance(value, str) else value
    except (RecursionError, ValueError):
        return value


def on_mask(mask: Array, options: Mapping[str, Any] | None = None) -> DetectOptions:
    """Options that allow approach and contact points only where a mask is not 0.

    The mask is (H, W) or (H, W, C), for example from a segmentation network, with a value for each
    pixel of the depth image or row of the cloud. The alpha channel of two or four is ignored.
    Regions in `options` are narrowed; points outside stay obstacles.
    """
    colors = mask[..., : 1 if mask.shape[2:] == (2,) else 3]
    kept = colors.any(axis=2) if mask.ndim == 3 else mask != 0
    asked = dict(options or {})
    for name in ("approach_region", "contact_region"):
        region = asked.get(name) or {}
        part, rows = ("exclude", ~kept) if region.get("include") else ("include", kept)
        asked[name] = {**region, part: [*region.get(part, ()), {"kind": "mask", "mask": rows}]}
    return cast("DetectOptions", asked)


def object_in_scene(
    object_points: ArrayLike, scene_points: ArrayLike
) -> tuple[Float32, NDArray[np.int32]]:
    """Merge the cloud (N, 3) of an object with the cloud (M, 3) of its scene.

    Both are in metres and in the same frame. The scene may contain the object.

    Returns:
        `cloud` (K, 3) and `segment_ids` (K,) for `GraspClient.detect`: 1 the object, 0 the rest.
        Points of the scene that repeat the object are left out.
    """
    clouds = [np.asarray(each, np.float32).reshape(-1, 3) for each in (object_points, scene_points)]
    wanted, scene = (each[np.isfinite(each).all(axis=1)] for each in clouds)
    digits = np.array([2**42, 2**21, 1])  # combines three cell indices; coordinates below 5 km
    cells = [np.floor(each / SCENE_VOXEL).astype(np.int64) @ digits for each in (wanted, scene)]
    rest = scene[~np.isin(cells[1], cells[0])]
    segment_ids = np.repeat(np.array([1, 0], np.int32), [len(wanted), len(rest)])
    return np.concatenate([wanted, rest]), segment_ids


# Wire formats


def cloud_file(cloud: Cloud) -> tuple[str, bytes]:
    """The cloud as a file: its format, one of FILE_FORMATS, and its bytes.

    Points (N, 3) become float32. An array of a wrong shape is sent unchanged, and the server
    refuses it.

    Raises:
        InvalidRequestError: It is neither an array of numbers nor a readable file of a known
            format.
    """
    if isinstance(cloud, np.ndarray) and not cloud.dtype.hasobject:
        if cloud.shape[1:] == (3,) and cloud.dtype in (np.float32, np.float64):
            with np.errstate(over="ignore"):  # the server refuses infinity
                cloud = np.asanyarray(cloud, dtype=np.float32, order="C")  # stays masked
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
        if (size := path.stat().st_size) > MAX_FILE_BYTES:
            raise PayloadTooLargeError(f"cloud: {path} has {size:,} bytes: more than servers take.")
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
        fix = "Give a mapping with depth and intrinsics, and optional T_cloud_camera, depth_scale."
        raise invalid(path, found[:80], fix)
    given = image.get("T_cloud_camera", np.eye(4))
    pose = np.asarray(given, dtype=object)  # accepts rows of different lengths
    pose = pose.reshape(4, 4) if pose.shape == (16,) else pose
    if pose.shape != (4, 4) or not all(isinstance(each, Real) for each in pose.flat):
        raise invalid(f"{path}.T_cloud_camera", repr(given)[:80], "Give a 4 x 4 matrix.")
    depth = _depth_fields(image["depth"], f"{path}.depth")
    try:
        intrinsics = to_intrinsics(image["intrinsics"])._asdict()
    except ValueError:
        fix = "Give fx, fy, cx, cy in pixels, or the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."
        raise invalid(f"{path}.intrinsics", repr(image["intrinsics"])[:80], fix) from None
    camera = {"intrinsics": intrinsics, "T_cloud_camera": pose.astype(float)}
    return dict(_plain({"depth": depth, **camera, "depth_scale": image.get("depth_scale")}))


def _depth_fields(depth: object, path: str) -> dict[str, Any]:
    """The fields of edgegrasp.v1.Depth; a .png file is sent unchanged."""
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
    if hasattr(value, "tolist"):  # also array.array, which rclpy uses for parameters
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
    """An array of the request in the form that is sent; raises InvalidRequestError."""
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
