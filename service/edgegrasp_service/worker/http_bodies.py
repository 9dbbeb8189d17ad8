"""HTTP bodies: parse requests and write answers.

A request is JSON, a point cloud file, or a form with parts; an answer is JSON.
"""

import io
import json
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import PurePath
from typing import Any
from urllib.parse import parse_qsl

import orjson
from werkzeug.exceptions import HTTPException
from werkzeug.formparser import MultiPartParser
from werkzeug.http import parse_options_header

from edgegrasp_camera.files import FILE_FORMATS
from edgegrasp_model.errors import InvalidRequest, brief
from edgegrasp_model.request_cloud import (
    CAMERA,
    GIVEN,
    PER_POINT,
    File,
    options_of_texts,
    unique_keys,
    value_of_text,
)
from edgegrasp_results import Detection, Scoring, plain
from edgegrasp_service.errors import UnsupportedMediaType
from edgegrasp_service.worker.process import Job

JSON, FORM = "application/json", "multipart/form-data"
FILE_TYPES = {f"application/x-{name}": name for name in FILE_FORMATS}
FIELDS = ("point_cloud2", "depth_images", *PER_POINT, "options")
MAX_QUERY_FIELDS = 64
MAX_CAMERA_TEXT = 1000  # most bytes of a part like 615,615,320,240; a longer one must be JSON
MAX_SHORT_LISTS = 20_000  # in JSON; edges take 6 bytes each


def read_request(job: Job) -> dict[str, Any]:
    """The fields of a request.

    Returns:
        The fields that were sent, as JSON or File; `cloud` is a File; and `options`.

    Raises:
        InvalidRequest: The body does not match its content type, has unknown fields or parts, or
            comes with query parameters although it has options.
        UnsupportedMediaType: There is no reader for the content type.
    """
    media_type, named = parse_options_header(job.content_type)
    media_type = media_type.lower()
    scores = job.method == "ScoreGrasps"
    accepted = (JSON, FORM) if scores else (JSON, *FILE_TYPES, FORM)
    if media_type not in accepted:
        fix = f"Send one of: {', '.join(accepted)}."
        raise UnsupportedMediaType("Content-Type", repr(media_type), fix)
    try:
        parameters = parse_qsl(job.query, True, max_num_fields=MAX_QUERY_FIELDS)
    except ValueError:
        value = f"more than {MAX_QUERY_FIELDS} parameters"
        raise InvalidRequest("query", value, "Send each option once.") from None
    if media_type in FILE_TYPES:
        file = File(FILE_TYPES[media_type], job.body)
        return {"cloud": file, "options": options_of_texts(parameters)}
    if parameters:
        fix = "Send options in the part `options`."
        raise InvalidRequest(parameters[0][0], "a query parameter", fix)
    known = ("points" if media_type == JSON else "cloud", *FIELDS, *(GIVEN if scores else ()))
    if media_type == JSON:
        fields: dict[str, Any] = read_json("body", job.body)
        if not isinstance(fields, dict):
            raise InvalidRequest("body", brief(fields), "Send a JSON object.")
        _refuse_unknown(fields, known, "field")
    else:
        boundary = named.get("boundary", "")
        fields = _fields_of_form(job.body, boundary, (*known, *CAMERA))
    if not isinstance(fields.setdefault("options", {}), dict):
        raise InvalidRequest("options", brief(fields["options"]), "Send a JSON object.")
    return fields


def write(result: Detection | Scoring) -> bytes:
    """A result as DetectionBody or ScoringBody; its floats are exact float32 values."""
    return orjson.dumps(result, default=plain, option=orjson.OPT_PASSTHROUGH_DATACLASS)


def _refuse_unknown(fields: Iterable[str], known: tuple[str, ...], kind: str) -> None:
    for name in fields:
        if name not in known:
            *names, last = known
            fix = f"Send {', '.join(names)} and {last} only."
            raise InvalidRequest(name, f"an unknown {kind}", fix)


# JSON


def read_json(field: str, text: bytes) -> Any:
    """Parse JSON within the memory allowed for a request of its size.

    Raises:
        InvalidRequest: It is not JSON, has a key twice, or would take far more memory than points
            of its size.
    """
    lists = text.count(b"[") + text.count(b"{")
    # Most lists are points of 8 bytes or more; an empty list takes 3 bytes, but 64 in memory.
    if lists > len(text) // 7 + MAX_SHORT_LISTS:
        value = f"{lists} lists and objects in {len(text)} bytes"
        raise InvalidRequest(field, value, "Send lists that hold numbers.")
    try:
        return json.loads(text, object_pairs_hook=partial(unique_keys, field))
    except (ValueError, RecursionError) as error:
        is_array = field in ("depth", *PER_POINT)  # perhaps an image of another format
        fix = "Send an .npy or .png file, or JSON." if is_array else "Send a JSON object."
        raise InvalidRequest(field, f"no valid JSON ({error})", fix) from None


# Forms


def _fields_of_form(body: bytes, boundary: str, known: tuple[str, ...]) -> dict[str, Any]:
    """Files as File, other parts as their JSON; the parts of one camera as `depth_images`."""
    fields: dict[str, Any] = {}
    for name, file_format, data in _parts(body, boundary, len(known) + 1):
        _refuse_unknown([name], known, "part")
        if name in fields:
            raise InvalidRequest(name, "two parts", "Send one.")
        if name == "cloud" and file_format is None:
            raise InvalidRequest("cloud", "no file", "Send the cloud as a file part.")
        # curl sends `-F options=@file;type=application/json` as a file as well.
        if name == "cloud" or (file_format in ("npy", "png") and name != "options"):
            fields[name] = File(file_format or "", data)
        elif name in CAMERA and len(data) < MAX_CAMERA_TEXT:
            fields[name] = value_of_text(name, data.decode("utf-8", "replace"))
        else:
            fields[name] = read_json(name, data)
    image = {name: fields.pop(name) for name in CAMERA if name in fields}
    if image and "depth_images" in fields:
        raise InvalidRequest("depth_images", f"images beside {next(iter(image))}", "Send one.")
    return fields | ({"depth_images": [image]} if image else {})


def _parts(body: bytes, boundary: str, most: int) -> Iterator[tuple[str, str | None, bytes]]:
    """Name, file format (None: not a file) and data of each part of a multipart body.

    The format comes from a part's content type, else from its file name.
    """
    parser = MultiPartParser(
        lambda **named: io.BytesIO(),  # type: ignore[arg-type]  # it is called so
        max_form_memory_size=None,
        max_form_parts=most,
    )
    try:
        if not boundary:
            raise ValueError("no boundary in its Content-Type")
        form, files = parser.parse(io.BytesIO(body), boundary.encode("utf-8", "replace"), len(body))
    except (ValueError, HTTPException) as error:
        fix = "Send a file part `cloud` and a JSON part `options`."
        raise InvalidRequest("body", f"a form that cannot be read ({error})", fix) from None
    for name, text in form.items(multi=True):
        yield str(name), None, text.encode()
    for name, file in files.items(multi=True):
        suffix = PurePath((file.filename or "").replace("\0", "")).suffix
        yield str(name), FILE_TYPES.get(file.mimetype) or suffix[1:].lower(), file.read()
