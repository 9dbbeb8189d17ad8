"""Bodies of the HTTP API: the JSON objects of requests and answers, and their OpenAPI document."""

import base64
import binascii
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, StrictBool

from edgegrasp_model.options import FARTHEST, DetectOptions, Finite, Integer, Strict, numeric
from edgegrasp_model.results import NoGrasp, Outcome

KIND_PREFIX = "urn:edgegrasp:error:"
TIMEOUT = "X-Request-Timeout"

FILE_TYPES = {f"application/x-{name}": name for name in ("npy", "npz", "ply", "pcd", "xyz")}
# Arrays beside a cloud: numbers for each of its rows, their type where they come packed, and what
# they are.
PER_POINT = {
    "normals": (3, "<f4", "for each row of the cloud, outward, any length"),
    "colors": (3, "<f4", "for each row of the cloud"),
    "segment_ids": (1, "<i4", "for each row of the cloud"),
    "view_ids": (1, "<i4", "for each row of the cloud: which of options.viewpoint saw it"),
}
GIVEN = ("edges", "hand_poses")  # what a caller may want scored

# Requests: what stands beside the options


def _from_base64(value: object) -> object:
    """JSON has no bytes; gRPC does."""
    if not isinstance(value, str):
        return value
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        raise ValueError("must be base64") from None


Bytes = Annotated[bytes, BeforeValidator(_from_base64, json_schema_input_type=str)]
Size = Annotated[int, Field(ge=0, lt=2**31), numeric]
Pixels = Annotated[int, Field(ge=1, le=65536), numeric]
FocalLength = Annotated[float, Field(gt=0.0, le=FARTHEST), numeric]
PoseRow = tuple[Finite, Finite, Finite, Finite]


def _rigid(pose: tuple[PoseRow, ...]) -> tuple[PoseRow, ...]:
    matrix = np.array(pose)
    rotation = matrix[:3, :3]
    turned = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not turned or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError("must be a rotation and a translation, row-major, with last row 0 0 0 1")
    return pose


Pose = Annotated[tuple[PoseRow, PoseRow, PoseRow, PoseRow], AfterValidator(_rigid)]


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


class Depth(Strict):
    """An image of depths, row by row from the top left pixel; 0 or NaN: no reading."""

    height: Pixels
    width: Pixels
    encoding: str = Field(description="32FC1 or 64FC1, metres; 16UC1, millimetres")
    data: Bytes = Field(description="packed little-endian pixels, as base64 in JSON")


class Intrinsics(Strict):
    """A pinhole camera without distortion; the centre of the top left pixel is (0, 0)."""

    fx: FocalLength = Field(description="pixels")
    fy: FocalLength = Field(description="pixels")
    cx: Finite = Field(description="pixels")
    cy: Finite = Field(description="pixels")


class DepthImage(Strict):
    """What a camera saw. Camera frame: x right, y down, z forward."""

    depth: Any = Field(description="rows of metres, or an object as Depth")
    intrinsics: Intrinsics
    T_cloud_camera: Pose = Field(description="maps camera coordinates to cloud coordinates, metres")


# Answers


Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid")


class GraspBody(_Body):
    """One grasp: move to T_cloud_hand along approach_direction, then close."""

    score: float = Field(description="probability that the grasp holds")
    T_cloud_hand: Matrix = Field(
        description="row-major; hand frame: z out of the palm, y the closing direction"
    )
    T_cloud_tcp: Matrix = Field(description="row-major; tool centre point, same axes")
    width: float = Field(description="opening to command before closing, metres")
    approach_point: Vector = Field(description="p_a, metres, cloud frame")
    contact_point: Vector = Field(description="p_c, metres, cloud frame")
    approach_direction: Vector = Field(description="unit, the direction the hand moves; its +z")
    collision_free: bool = Field(
        description="whether the open hand meets nothing at the grasp and on its ways"
    )
    clearance: float = Field(
        description="metres from the open hand at the grasp to the nearest thing; 0 or less: within"
    )


class DebugBody(_Body):
    """The processed cloud and every candidate, whatever became of it."""

    points: list[Vector] = Field(description="metres, cloud frame")
    normals: list[Vector] = Field(description="unit")
    approach_index: list[int] = Field(description="p_a of each candidate, rows of points")
    contact_index: list[int] = Field(description="p_c of each candidate, rows of points")
    T_cloud_hand: list[Matrix] = Field(description="of each candidate")
    score: list[float | None] = Field(description="of each candidate; null: not scored")
    outcome: list[Outcome] = Field(description="of each candidate")
    support_plane: Row | None = Field(description="unit normal and offset, metres")


class DetectionBody(_Body):
    """Ranked grasps of one cloud, and how they came about."""

    grasps: list[GraspBody] = Field(description="best first")
    counts: dict[str, int] = Field(description="what passed each stage")
    seconds: dict[str, float] = Field(description="spent in each stage, and their total")
    model: str = Field(description="name of the weights used")
    warnings: list[str]
    debug: DebugBody | None = Field(description="null but where options.debug is set")


class EvaluationBody(_Body):
    """What the network says of one edge or hand pose."""

    grasp: GraspBody | None = Field(description="null where it defines none")
    reason: NoGrasp | None = Field(description="why it defines none")


class ScoringBody(_Body):
    """Evaluations of what the caller gave."""

    evaluations: list[EvaluationBody] = Field(description="in the order of the request")
    counts: dict[str, int] = Field(description="what passed each stage")
    seconds: dict[str, float] = Field(description="spent in each stage, and their total")
    model: str = Field(description="name of the weights used")
    warnings: list[str]


class ModelBody(_Body):
    """Loaded weights."""

    name: str
    architecture: str
    digest: str
    parameters: int
    crop_radius: float = Field(description="metres")
    voxel_size: float = Field(description="metres")
    gripper: str
    default: bool = Field(description="whether a request that names no model gets these")
    hand_description: bool = Field(
        description="whether the network sees the hand-frame description"
    )
    device: str = Field(description='where it computes: "cpu", or a GPU such as "cuda:0"')


class ModelsBody(_Body):
    """The weights a request can name."""

    models: list[ModelBody]


class HealthBody(_Body):
    """State of the server."""

    status: str


class ProblemBody(_Body):
    """An error (RFC 9457)."""

    type: str = Field(description=f"{KIND_PREFIX} and the kind, e.g. invalid-request")
    title: str
    status: int
    detail: str
    field: str = Field(description="request field at fault; empty if none is")
    value: str = Field(description="what was received")
    fix: str = Field(description="what to send instead")
    retry_after: float | None = Field(
        description="seconds until another try is worth it, as in Retry-After; null: unknown"
    )


# The OpenAPI document of the request bodies, which the service reads itself

NUMBER, INTEGER = {"type": "number"}, {"type": "integer"}
FILE = {"type": "string", "format": "binary"}
AS_TEXT = "With a point cloud file as body. As JSON; lists of numbers also as 0.1,0.2,0.3."


def openapi_detect() -> dict[str, Any]:
    """Parameters and body of `POST /v1/grasps`, as FastAPI's `openapi_extra`."""
    options = _inline_schema(DetectOptions)
    parameters = [
        {
            "name": name,
            "in": "query",
            "required": False,
            "description": f"{schema.get('description', '')}. {AS_TEXT}",
            "content": {"application/json": {"schema": schema}},
        }
        for name, schema in options["properties"].items()
    ]
    body = _request_body(options, {}, files=True)
    return body | {"parameters": [*parameters, _TIMEOUT_HEADER]}


def openapi_score() -> dict[str, Any]:
    """Parameters and body of `POST /v1/grasps:score`, as FastAPI's `openapi_extra`."""
    edges = _list(_list(INTEGER, 2), description="approach and contact point, rows of the cloud")
    poses = _list(_list(_list(NUMBER, 4), 4), description="T_cloud_hand")
    given = dict(zip(GIVEN, (edges, poses), strict=True))
    body = _request_body(_inline_schema(DetectOptions), given, files=False)
    return body | {"parameters": [_TIMEOUT_HEADER]}


_TIMEOUT_HEADER = {
    "name": TIMEOUT,
    "in": "header",
    "required": False,
    "description": "Seconds from now until nobody wants the answer any more.",
    "schema": {"type": "number", "exclusiveMinimum": 0},
}


def _request_body(
    options: dict[str, Any], given: dict[str, Any], files: bool
) -> dict[str, dict[str, Any]]:
    points = _list(_list(NUMBER, 3), description="x, y, z in metres; organised: rows of points")
    beside = {
        name: _list(_list(NUMBER, 3) if width == 3 else INTEGER, description=description)
        for name, (width, _, description) in PER_POINT.items()
    }
    shared = _clouds() | beside | given | {"options": options}
    body = {
        "type": "object",
        "additionalProperties": False,
        "properties": {"points": points} | shared,
    }
    arrays = {name: {"anyOf": [FILE, schema]} for name, schema in (beside | given).items()}
    form = {
        "type": "object",
        "additionalProperties": False,
        "properties": {"cloud": FILE} | shared | arrays,
    }
    content: dict[str, Any] = {"application/json": {"schema": body}}
    if files:
        content |= {media_type: {"schema": FILE} for media_type in FILE_TYPES}
    content["multipart/form-data"] = {
        "schema": form,
        "encoding": {"options": {"contentType": "application/json"}},
    }
    return {"requestBody": {"required": True, "content": content}}


def _clouds() -> dict[str, Any]:
    image = _inline_schema(DepthImage)
    rows = _list(_list(NUMBER), description="metres")
    image["properties"]["depth"] = {"anyOf": [rows, _inline_schema(Depth)]}
    text = "views to fuse; their cameras are the viewpoints"
    return {
        "point_cloud2": _inline_schema(PointCloud2),
        "depth_images": _list(image, description=text),
    }


def _list(items: dict[str, Any], size: int | None = None, description: str = "") -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "array", "items": items}
    if size is not None:
        schema |= {"minItems": size, "maxItems": size}
    return schema | ({"description": description} if description else {})


def _inline_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Without references: the document then needs no component that FastAPI does not know of."""
    schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
    definitions = schema.pop("$defs", {})
    inlined: dict[str, Any] = _inlined(schema, definitions)
    return inlined


def _inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(schema, list):
        return [_inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        target = definitions[schema["$ref"].rpartition("/")[2]]
        rest = {name: value for name, value in schema.items() if name != "$ref"}
        return _inlined(target | rest, definitions)
    if "discriminator" in schema:  # it maps to components; every `kind` has its const anyway
        schema = {name: value for name, value in schema.items() if name != "discriminator"}
    return {name: _inlined(value, definitions) for name, value in schema.items()}
