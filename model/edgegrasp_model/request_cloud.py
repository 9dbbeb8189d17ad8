"""Decode the cloud of a request, in any of its forms, into arrays, and options that are text.

Both transports pass the fields of the JSON body. A value is JSON, a `File` from a form or a
message, or bytes of little-endian numbers from a message. The detector checks the arrays.
"""

import base64
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, SkipValidation, StrictBool

from edgegrasp_camera.arrays import Array
from edgegrasp_camera.clouds import CloudInput, read_point_cloud2, too_many
from edgegrasp_camera.depth import ENCODINGS, fuse_depth_images, to_intrinsics
from edgegrasp_camera.files import read_file, read_npy, read_png
from edgegrasp_model.errors import InvalidRequest, brief, parse
from edgegrasp_model.options import (
    FARTHEST,
    MAX_VIEWS,
    DetectOptions,
    Finite,
    Integer,
    Strict,
    numeric,
    rigid,
)

# Packed points and per-point arrays: numbers per row, and their type.
PACKED = dict.fromkeys(("points", "normals", "colors"), (3, "float32"))
PACKED |= dict.fromkeys(("segment_ids", "view_ids"), (1, "int32"))
PER_POINT = tuple(PACKED)[1:]
GIVEN = ("edges", "hand_poses")  # what a caller may have scored
SOURCES = ("points", "cloud", "point_cloud2", "depth_images")  # `cloud` is a File


class File(NamedTuple):
    """A file in a request."""

    format: str  # such as "npy"; not checked yet
    data: bytes


def decode_cloud(fields: Mapping[str, Any], options: DetectOptions, max_points: int) -> CloudInput:
    """Decode the cloud of a request, one of SOURCES, and its per-point arrays, any of PER_POINT."""
    sources = [name for name in SOURCES if fields.get(name) is not None]
    if not sources:
        fix = "Send points in metres, point_cloud2, depth_images or a file."
        raise InvalidRequest("cloud", "nothing", fix)
    if len(sources) > 1:
        raise InvalidRequest(sources[1], f"a cloud beside {sources[0]}", "Send one cloud.")
    (source,) = sources
    if source == "depth_images":
        if options.viewpoint is not None:
            fix = "Leave it out: the viewpoints are the cameras of depth_images."
            raise InvalidRequest("options.viewpoint", brief(options.viewpoint), fix)
        if fields.get("view_ids") is not None:
            fix = "Leave it out: it follows from depth_images."
            raise InvalidRequest("view_ids", "an array beside depth_images", fix)
        cloud = read_depth_images(fields[source], max_points)
    elif source == "point_cloud2":
        layout: Any = parse(PointCloud2, fields[source], "point_cloud2")
        cloud = read_point_cloud2(layout, max_points)
    elif source == "cloud":
        file: File = fields[source]
        cloud = read_file(file.format, file.data, max_points)
    else:
        cloud = CloudInput(decode_points(fields[source], max_points))
    arrays: dict[str, Any] = {}
    for name in PER_POINT:
        if fields.get(name) is None:
            continue
        if getattr(cloud, name) is not None:
            raise InvalidRequest(name, "an array beside the one in the cloud", "Send it once.")
        arrays[name] = decode_array(name, fields[name], max_points)
    return replace(cloud, **arrays)


# Points and arrays beside them


def decode_points(points: object, max_points: int) -> Array:
    """Read points (N, 3) from bytes, or from lists, in which rows of null in images are holes."""
    array = decode_array("points", points, max_points)
    if array.size // 3 > max_points:
        raise too_many(array.size // 3, max_points)
    if not array.size:
        return np.empty((0, 3))
    return array if isinstance(points, bytes) else array.astype(np.float64)


def decode_array(field: str, value: object, max_points: int) -> Array:
    """Read an array: packed numbers, an .npy or .png file, or lists.

    From bytes (N, 3) float32 or (N,) int32, as PACKED says; from lists int64 if all numbers are
    whole, else float64; from a file whatever it contains.
    """
    if isinstance(value, File):
        read = read_png if value.format == "png" else read_npy
        return read(value.data, max_points, field)
    if isinstance(value, bytes):
        width, kind = PACKED[field]
        if len(value) % (4 * width):
            found = f"{len(value)} bytes, which are not a whole number of rows"
            fix = f"Send {4 * width} bytes a row: little-endian {kind}."
            raise InvalidRequest(field, found, fix)
        array = np.frombuffer(value, np.dtype(kind).newbyteorder("<"))
        return array.reshape(-1, 3) if width == 3 else array
    if not isinstance(value, list):
        raise InvalidRequest(field, brief(value), "Send a list of numbers, or of lists of them.")
    return _numbers(field, value, holes=field == "points") if value else np.empty(0)


def _numbers(field: str, values: list[Any], holes: bool) -> Array:
    """Lists as an array: int64 or float64; with `holes`, None is NaN in lists three deep."""
    # As objects, since a text array gives every element the size of the longest.
    try:
        array = np.array(values, dtype=object)
        numbers = array.ravel().tolist()
        kinds = set(map(type, numbers))
        if list in kinds:
            raise ValueError("a ragged list")
    except ValueError:
        fix = "Send [x, y, z] rows." if field == "points" else "Send rows of one length."
        raise InvalidRequest(field, "rows of different lengths", fix) from None
    allowed = {int, float} | ({type(None)} if holes and array.ndim == 3 else set())
    with suppress(OverflowError):
        if kinds <= allowed:
            return array.astype(np.int64 if kinds == {int} else np.float64)
    bad = next(
        place
        for place, number in enumerate(numbers)
        if type(number) not in allowed or (type(number) is int and abs(number) >= 2**63)
    )
    row = values[bad * len(values) // len(numbers)]
    raise InvalidRequest(field, brief(row), "Send numbers only; integers must fit in 64 bits.")


# Schemas of what requests contain besides arrays


Bytes = Annotated[  # plain over gRPC, base64 in JSON
    bytes,
    BeforeValidator(
        lambda sent: base64.b64decode(sent, validate=True) if isinstance(sent, str) else sent,
        json_schema_input_type=str,
    ),
]
Size = Annotated[int, Field(ge=0, lt=2**31), numeric]


class PointField(Strict):
    """One field of every point."""

    name: str
    offset: Size = Field(description="bytes from the start of the point")
    datatype: Integer = Field(ge=1, le=8, description="as in sensor_msgs/PointField; 7 is float32")
    count: Size = Field(default=1, description="numbers in the field; 0 means 1")


class PointCloud2(Strict):
    """A cloud in the layout of sensor_msgs/PointCloud2, metres."""

    height: Size
    width: Size
    fields: tuple[PointField, ...] = Field(min_length=3, max_length=64)
    is_bigendian: StrictBool = False
    point_step: Size = Field(description="bytes from point to point")
    row_step: Size = Field(description="bytes from row to row")
    data: Bytes = Field(description="height * row_step bytes, as base64 in JSON")


FocalLength = Annotated[float, Field(gt=0.0, le=FARTHEST), numeric]
PoseRow = tuple[Finite, Finite, Finite, Finite]
CameraPose = Annotated[tuple[PoseRow, PoseRow, PoseRow, PoseRow], AfterValidator(rigid)]


class Intrinsics(Strict):
    """A pinhole camera without distortion; the centre of the top left pixel is (0, 0)."""

    fx: FocalLength = Field(description="pixels")
    fy: FocalLength = Field(description="pixels")
    cx: Finite = Field(description="pixels")
    cy: Finite = Field(description="pixels")


class Depth(Strict):
    """An image of depths, row by row from the top left pixel; 0 or NaN: no reading."""

    height: Size = Field(default=0, description="pixels; a PNG needs neither height nor width")
    width: Size = 0
    encoding: Literal["32FC1", "64FC1", "16UC1", "png"]
    """32FC1 or 64FC1, metres; 16UC1 or a 16-bit PNG file, millimetres"""
    data: Bytes = Field(description="packed little-endian pixels or the file, as base64 in JSON")


class DepthImage(Strict):
    """An image of a depth camera. Camera frame: x right, y down, z forward."""

    intrinsics: Annotated[
        Intrinsics,
        BeforeValidator(
            lambda sent: sent if isinstance(sent, Mapping) else to_intrinsics(sent)._asdict(),
            json_schema_input_type=Intrinsics | list[float] | list[list[float]],
        ),
    ]
    """by name, or fx, fy, cx, cy, or the 3 x 3 matrix"""
    T_cloud_camera: CameraPose = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    """maps camera coordinates to cloud coordinates, metres"""
    depth_scale: Annotated[float, Field(gt=0.0, le=1.0), numeric] | None = None
    """metres for one unit of depth; null: 0.001 for integers, 1 for floats"""
    depth: SkipValidation[list[list[float]] | Depth]
    """rows of metres, or an object as Depth"""


CAMERA = tuple(DepthImage.model_fields)  # fields of one image, which a form may have as parts


# Depth images


def read_depth_images(images: object, max_points: int) -> CloudInput:
    """Read DepthImages, plain values whose `depth` may also be a File, and fuse them."""
    if not isinstance(images, list) or not 1 <= len(images) <= MAX_VIEWS:
        count = f"{len(images)} images" if isinstance(images, list) else brief(images)
        raise InvalidRequest("depth_images", count, f"Send a list of 1 to {MAX_VIEWS} images.")
    views = [parse(DepthImage, image, f"depth_images.{row}") for row, image in enumerate(images)]
    depths: list[Array] = []
    for row, view in enumerate(views):
        depths.append(_depth(view.depth, max_points, f"depth_images.{row}.depth"))
        pixels = sum(depth.size for depth in depths)
        if pixels > max_points:
            raise too_many(pixels, max_points, "depth_images")
    return fuse_depth_images(depths, views)


def _depth(depth: object, max_points: int, field: str) -> Array:
    if isinstance(depth, File):
        return decode_array(field, depth, max_points)
    if isinstance(depth, list):
        rows: Array = _numbers(field, [depth], holes=True)[0]
        return rows.astype(np.float64)
    if not isinstance(depth, Mapping):
        fix = "Send a .png or .npy file (depth=@FILE), rows of metres, or an object as Depth."
        raise InvalidRequest(field, brief(depth), fix)
    image = parse(Depth, depth, field)
    if image.encoding == "png":
        return read_png(image.data, max_points, f"{field}.data")
    dtype = np.dtype(ENCODINGS[image.encoding])
    expected = image.height * image.width * dtype.itemsize
    if len(image.data) != expected:
        value = f"{len(image.data)} bytes where height, width and encoding ask for {expected}"
        raise InvalidRequest(f"{field}.data", value, "Send the whole image.")
    return np.frombuffer(image.data, dtype).reshape(image.height, image.width)


# Options as text


def options_of_texts(items: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """Decode query parameters or command line values, one per option.

    A value is JSON (`seed=3`, `suppression=null`, `workspace={"min":[0,0,0],"max":[1,1,1]}`),
    numbers between commas (`viewpoint=0.1,0.2,0.3`), or else the text itself
    (`sampling=uniform`).

    Raises:
        InvalidRequest: A parameter occurs twice.
    """
    options: dict[str, Any] = {}
    for name, text in items:
        if name in options:
            raise InvalidRequest(f"options.{name}", "two values", "Send it once.")
        options[name] = value_of_text(name, text)
    return options


def value_of_text(name: str, text: str) -> object:
    """One value of an option or form part, as `options_of_texts` reads it."""
    field = DetectOptions.model_fields.get(name)
    if field is not None and field.annotation is str and not text.startswith('"'):
        return text  # a model may be named 7 or null
    if name == "gripper" and not text.startswith(("{", "[", '"')) and text != "null":
        return text  # as may grippers
    with suppress(ValueError, RecursionError):
        return json.loads(text, object_pairs_hook=partial(unique_keys, f"options.{name}"))
    if "," in text:
        with suppress(ValueError):
            return [float(part) for part in text.split(",")]
    return text


def unique_keys(field: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build an object of JSON; raises InvalidRequest if a key occurs more than once."""
    found = dict(pairs)
    if len(found) < len(pairs):
        ((name, count),) = Counter(name for name, _ in pairs).most_common(1)
        raise InvalidRequest(field, f"{count} times the key {brief(name)}", "Send it once.")
    return found
