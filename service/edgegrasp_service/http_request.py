"""Read the body of POST /v1/grasps: JSON, a point cloud file, or a form with a file."""

import json
from collections import Counter
from pathlib import PurePath
from typing import Any

from fastapi import Request
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions
from edgegrasp_service.cloud_decoding import FILE_FORMATS
from edgegrasp_service.core import DetectRequest, FileCloud, ListCloud
from edgegrasp_service.errors import UnsupportedMediaType
from edgegrasp_service.options_text import options_from_query

FILE_TYPES = {f"application/x-{name}": name for name in FILE_FORMATS}
ACCEPTED = ", ".join(["application/json", *FILE_TYPES, "multipart/form-data"])


async def read_request(request: Request) -> DetectRequest:
    """Read one request.

    Raises:
        InvalidRequest: The body is not what its content type says, or has unknown fields.
        UnsupportedMediaType: There is no reader for the content type.
        PayloadTooLarge: The body exceeds the server's limit.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type in FILE_TYPES:
        cloud = FileCloud(FILE_TYPES[media_type], await request.body())
        return DetectRequest(cloud, options_from_query(request.query_params.multi_items()))
    if request.query_params:
        name = next(iter(request.query_params))
        raise InvalidRequest(name, "a query parameter", "Send options in the part `options`.")
    if media_type == "application/json":
        return _from_json(await request.body())
    if media_type == "multipart/form-data":
        return await _from_form(request)
    raise UnsupportedMediaType("Content-Type", repr(media_type), f"Send one of: {ACCEPTED}.")


def _from_json(body: bytes) -> DetectRequest:
    fields = _object("body", body)
    for name in fields:
        if name not in ("points", "options"):
            raise InvalidRequest(name, "an unknown field", "Send points and options only.")
    if "points" not in fields:
        raise InvalidRequest("points", "nothing", "Send a list of [x, y, z] in metres.")
    options = fields.get("options", {})
    if not isinstance(options, dict):
        raise InvalidRequest("options", repr(options)[:80], "Send a JSON object.")
    return DetectRequest(ListCloud(fields["points"]), options)


async def _from_form(request: Request) -> DetectRequest:
    try:
        async with request.form(max_files=2, max_fields=2) as form:
            return await _from_parts(form)
    except HTTPException as error:
        fix = "Send a file part `cloud` and a JSON part `options`."
        raise InvalidRequest("body", f"a form that cannot be read ({error.detail})", fix) from None


async def _from_parts(form: FormData) -> DetectRequest:
    for name, count in Counter(name for name, _ in form.multi_items()).items():
        if name not in ("cloud", "options"):
            raise InvalidRequest(name, "an unknown part", "Send cloud and options only.")
        if count > 1:
            raise InvalidRequest(name, f"{count} parts", "Send one.")
    upload, options = form.get("cloud"), form.get("options", "{}")
    if not isinstance(upload, UploadFile):
        raise InvalidRequest("cloud", "no file", "Send the cloud as a file part.")
    # curl sends `-F options=@file;type=application/json` as a file too.
    text = await options.read() if isinstance(options, UploadFile) else options.encode()
    return DetectRequest(
        FileCloud(_format_of(upload), await upload.read()), _object("options", text)
    )


def _format_of(upload: UploadFile) -> str:
    """The format a part's content type names, or else its file name's ending."""
    media_type = (upload.content_type or "").partition(";")[0].strip().lower()
    return FILE_TYPES.get(media_type) or PurePath(upload.filename or "").suffix[1:].lower()


def _object(field: str, text: bytes) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidRequest(field, f"no valid JSON ({error})", "Send a JSON object.") from None
    if not isinstance(value, dict):
        raise InvalidRequest(field, repr(value)[:80], "Send a JSON object.")
    return value


def _openapi_request() -> dict[str, Any]:
    options = DetectOptions.model_json_schema(ref_template="#/components/schemas/{model}")
    # Inline, so that the document needs no component the framework does not know of.
    definitions = options.pop("$defs", {})
    options = _inlined(options, definitions)
    point = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
    points = {"type": "array", "items": point, "description": "x, y, z in metres"}
    body = {
        "type": "object",
        "required": ["points"],
        "additionalProperties": False,
        "properties": {"points": points, "options": options},
    }
    form = {
        "type": "object",
        "required": ["cloud"],
        "properties": {"cloud": {"type": "string", "format": "binary"}, "options": options},
    }
    file = {"schema": {"type": "string", "format": "binary"}}
    content: dict[str, Any] = {"application/json": {"schema": body}}
    content |= dict.fromkeys(FILE_TYPES, file)
    content["multipart/form-data"] = {
        "schema": form,
        "encoding": {"options": {"contentType": "application/json"}},
    }
    note = "With a point cloud file as body. As JSON; lists of numbers also as 0.1,0.2,0.3."
    parameters = [
        {
            "name": name,
            "in": "query",
            "required": False,
            "description": f"{schema.get('description', '')}. {note}",
            "content": {"application/json": {"schema": schema}},
        }
        for name, schema in options["properties"].items()
    ]
    return {"requestBody": {"required": True, "content": content}, "parameters": parameters}


def _inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(schema, list):
        return [_inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        target = definitions[schema["$ref"].rpartition("/")[2]]
        rest = {name: value for name, value in schema.items() if name != "$ref"}
        return _inlined(target | rest, definitions)
    return {name: _inlined(value, definitions) for name, value in schema.items()}


OPENAPI_REQUEST = _openapi_request()
