"""Bodies of the HTTP API: the JSON objects of requests and answers, and their OpenAPI document."""

import base64
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, SkipValidation, StrictBool

from edgegrasp_model.options import FARTHEST, DetectOptions, Finite, Integer, Strict, numeric
from edgegrasp_model.results import NoGrasp, Outcome

KIND_PREFIX = "urn:edgegrasp:error:"
TIMEOUT = "X-Request-Timeout"

FILE_TYPES = {f"application/x-{name}": name for name in ("npy", "npz", "ply", "pcd", "xyz")}
# Points and arrays beside them, where they come packed: numbers a row, and their type.
PACKED = {
    "points": (3, "float32"),
    "normals": (3, "float32"),
    "colors": (3, "float32"),
    "segment_ids": (1, "int32"),
    "view_ids": (1, "int32"),
}
PER_POINT = tuple(PACKED)[1:]
GIVEN = ("edges", "hand_poses")  # what a caller may want scored

# Requests


def _from_base64(value: object) -> object:
    """JSON has no bytes; gRPC does."""
    return base64.b64decode(value, validate=True) if isinstance(value, str) else value


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
    encoding: Literal["32FC1", "64FC1", "16UC1"] = Field(
        description="32FC1 or 64FC1, metres; 16UC1, millimetres"
    )
    data: Bytes = Field(description="packed little-endian pixels, as base64 in JSON")


class Intrinsics(Strict):
    """A pinhole camera without distortion; the centre of the top left pixel is (0, 0)."""

    fx: FocalLength = Field(description="pixels")
    fy: FocalLength = Field(description="pixels")
    cx: Finite = Field(description="pixels")
    cy: Finite = Field(description="pixels")


class DepthImage(Strict):
    """What a camera saw. Camera frame: x right, y down, z forward."""

    depth: SkipValidation[list[list[float]] | Depth] = Field(
        description="rows of metres, or an object as Depth"
    )
    intrinsics: Intrinsics
    T_cloud_camera: Pose = Field(description="maps camera coordinates to cloud coordinates, metres")


Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]
Edge = Annotated[list[int], Field(min_length=2, max_length=2)]


class DetectRequest(Strict):
    """The JSON body of `POST /v1/grasps`, for its document; the worker reads each field alone."""

    points: list[Vector] | None = Field(None, description="x, y, z in metres, or rows of them")
    point_cloud2: PointCloud2 | None = None
    depth_images: list[DepthImage] | None = Field(None, description="their cameras are viewpoints")
    normals: list[Vector] | None = Field(None, description="of each point, outward, any length")
    colors: list[Vector] | None = Field(None, description="of each point")
    segment_ids: list[int] | None = Field(None, description="of each point")
    view_ids: list[int] | None = Field(None, description="which of options.viewpoint saw a point")
    options: DetectOptions = Field(default_factory=DetectOptions)


class ScoreRequest(DetectRequest):
    """The JSON body of `POST /v1/grasps:score`."""

    edges: list[Edge] | None = Field(None, description="approach and contact points, rows")
    hand_poses: list[Matrix] | None = Field(None, description="T_cloud_hand")


# Answers


class GraspBody(Strict):
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


class DebugBody(Strict):
    """The processed cloud and every candidate, whatever became of it."""

    points: list[Vector] = Field(description="metres, cloud frame")
    normals: list[Vector] = Field(description="unit")
    approach_index: list[int] = Field(description="p_a of each candidate, rows of points")
    contact_index: list[int] = Field(description="p_c of each candidate, rows of points")
    T_cloud_hand: list[Matrix] = Field(description="of each candidate")
    score: list[float | None] = Field(description="of each candidate; null: not scored")
    outcome: list[Outcome] = Field(description="of each candidate")
    support_plane: Row | None = Field(description="unit normal and offset, metres")


class _ResultBody(Strict):
    counts: dict[str, int] = Field(description="what passed each stage")
    seconds: dict[str, float] = Field(description="spent in each stage, and their total")
    model: str = Field(description="name of the weights used")
    warnings: list[str]


class DetectionBody(_ResultBody):
    """Ranked grasps of one cloud, and how they came about."""

    grasps: list[GraspBody] = Field(description="best first")
    debug: DebugBody | None = Field(description="null but where options.debug is set")


class EvaluationBody(Strict):
    """What the network says of one edge or hand pose."""

    grasp: GraspBody | None = Field(description="null where it defines none")
    reason: NoGrasp | None = Field(description="why it defines none")


class ScoringBody(_ResultBody):
    """Evaluations of what the caller gave."""

    evaluations: list[EvaluationBody] = Field(description="in the order of the request")


class ModelBody(Strict):
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


class ModelsBody(Strict):
    """The weights a request can name."""

    models: list[ModelBody]


class HealthBody(Strict):
    """State of the server."""

    status: str


class ProblemBody(Strict):
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


# The OpenAPI document of the requests, which the service reads itself

FILE = {"type": "string", "format": "binary"}
AS_TEXT = "With a point cloud file as body. As JSON; lists of numbers also as 0.1,0.2,0.3."


def openapi_detect() -> dict[str, Any]:
    """Parameters and body of `POST /v1/grasps`, as FastAPI's `openapi_extra`."""
    body = _request_body(DetectRequest)
    content = body["requestBody"]["content"]
    content |= {media_type: {"schema": FILE} for media_type in FILE_TYPES}
    options = content["application/json"]["schema"]["properties"]["options"]
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
    return body | {"parameters": parameters + body["parameters"]}


def openapi_score() -> dict[str, Any]:
    """Parameters and body of `POST /v1/grasps:score`, as FastAPI's `openapi_extra`."""
    return _request_body(ScoreRequest)


def _request_body(model: type[DetectRequest]) -> dict[str, Any]:
    """A body as JSON, or as a form with files; and the header beside it."""
    schema = model.model_json_schema()
    # Without references: the document then needs no component that FastAPI does not know of.
    body: dict[str, Any] = _inlined(schema, schema.pop("$defs"))
    fields = body["properties"]
    files = {
        name: {"anyOf": [FILE, fields[name]]} for name in (*PER_POINT, *GIVEN) if name in fields
    }
    form = body | {"properties": {"cloud": FILE} | fields | files}
    del form["properties"]["points"]
    timeout = {
        "name": TIMEOUT,
        "in": "header",
        "required": False,
        "description": "Seconds from now until nobody wants the answer any more.",
        "schema": {"type": "number", "exclusiveMinimum": 0},
    }
    content = {
        "application/json": {"schema": body},
        "multipart/form-data": {
            "schema": form,
            "encoding": {"options": {"contentType": "application/json"}},
        },
    }
    return {"requestBody": {"required": True, "content": content}, "parameters": [timeout]}


def _inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(schema, list):
        return [_inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        target = definitions[schema["$ref"].rpartition("/")[2]]
        return _inlined(
            target | {name: schema[name] for name in schema if name != "$ref"}, definitions
        )
    # The discriminator maps to components; every `kind` has its const anyway.
    return {
        name: _inlined(value, definitions)
        for name, value in schema.items()
        if name != "discriminator"
    }
