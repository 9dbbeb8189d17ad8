"""What the OpenAPI document says of the bodies that http_request.py reads."""

from typing import Any

from pydantic import BaseModel

from edgegrasp_model.options import DetectOptions
from edgegrasp_service.depth_images import Depth, DepthImage
from edgegrasp_service.http_request import FILE_TYPES, GIVEN, TIMEOUT
from edgegrasp_service.point_cloud2 import PointCloud2
from edgegrasp_service.sent_arrays import PER_POINT

TEXT = "With a point cloud file as body. As JSON; lists of numbers also as 0.1,0.2,0.3."
BESIDE = {
    "normals": "for each row of the cloud, outward, any length",
    "colors": "for each row of the cloud",
    "segment_ids": "for each row of the cloud",
    "view_ids": "for each row of the cloud: which of options.viewpoint saw it",
}


def _list(items: dict[str, Any], size: int | None = None, description: str = "") -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "array", "items": items}
    if size is not None:
        schema |= {"minItems": size, "maxItems": size}
    return schema | ({"description": description} if description else {})


NUMBER, INTEGER = {"type": "number"}, {"type": "integer"}
FILE = {"type": "string", "format": "binary"}


def _inline_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Without references: the document then needs no component the framework does not know of."""
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


def _clouds() -> dict[str, Any]:
    image = _inline_schema(DepthImage)
    rows = _list(_list(NUMBER), description="metres")
    image["properties"]["depth"] = {"anyOf": [rows, _inline_schema(Depth)]}
    text = "views to fuse; their cameras are the viewpoints"
    return {
        "point_cloud2": _inline_schema(PointCloud2),
        "depth_images": _list(image, description=text),
    }


def _beside() -> dict[str, Any]:
    return {
        name: _list(_list(NUMBER, 3) if width == 3 else INTEGER, description=BESIDE[name])
        for name, (width, _) in PER_POINT.items()
    }


def _request_body(
    options: dict[str, Any], given: dict[str, Any], files: bool
) -> dict[str, dict[str, Any]]:
    points = _list(_list(NUMBER, 3), description="x, y, z in metres; organised: rows of points")
    shared = _clouds() | _beside() | given | {"options": options}
    body = {
        "type": "object",
        "additionalProperties": False,
        "properties": {"points": points} | shared,
    }
    arrays = {name: {"anyOf": [FILE, schema]} for name, schema in (_beside() | given).items()}
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


def _query_parameters(options: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "in": "query",
            "required": False,
            "description": f"{schema.get('description', '')}. {TEXT}",
            "content": {"application/json": {"schema": schema}},
        }
        for name, schema in options["properties"].items()
    ]


def _given() -> dict[str, Any]:
    pose = _list(_list(NUMBER, 4), 4)
    edges = _list(_list(INTEGER, 2), description="approach and contact point, rows of the cloud")
    return dict(zip(GIVEN, (edges, _list(pose, description="T_cloud_hand")), strict=True))


_OPTIONS = _inline_schema(DetectOptions)

_HEADERS = [
    {
        "name": TIMEOUT,
        "in": "header",
        "required": False,
        "description": "Seconds from now until nobody wants the answer any more.",
        "schema": {"type": "number", "exclusiveMinimum": 0},
    },
]

OPENAPI_DETECT = _request_body(_OPTIONS, {}, files=True) | {
    "parameters": _query_parameters(_OPTIONS) + _HEADERS
}
OPENAPI_SCORE = _request_body(_OPTIONS, _given(), files=False) | {"parameters": _HEADERS}
