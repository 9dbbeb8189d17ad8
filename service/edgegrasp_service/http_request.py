"""Read the bodies of the POST routes: JSON, a point cloud file, or a form with parts."""

import gc
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import PurePath
from typing import Any

from fastapi import Request
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException

from edgegrasp_model.errors import InvalidRequest, brief
from edgegrasp_service.cloud_decoding import FILE_FORMATS
from edgegrasp_service.core import DetectRequest, ScoreRequest
from edgegrasp_service.errors import UnsupportedMediaType
from edgegrasp_service.given_grasps import GivenGrasps
from edgegrasp_service.npy_file import read_npy
from edgegrasp_service.options_text import options_from_query
from edgegrasp_service.sent_arrays import (
    PER_POINT,
    ListArray,
    NpyArray,
    SentArray,
    array_from_lists,
)
from edgegrasp_service.sent_cloud import (
    DepthCloud,
    FileCloud,
    ListCloud,
    RosCloud,
    SentCloud,
    Source,
)

FILE_TYPES = {f"application/x-{name}": name for name in FILE_FORMATS}
JSON_OR_FORM = ("application/json", "multipart/form-data")
MAX_PART_BYTES = 2**31
MAX_SHORT_LISTS = 20_000  # edges take 6 bytes each

# Clouds of a JSON body; a form has the part `cloud`, a file, in the place of `points`.
SOURCES: dict[str, Callable[[Any], Source | DepthCloud]] = {
    "points": ListCloud,
    "point_cloud2": RosCloud,
    "depth_images": DepthCloud,
}
GIVEN = ("edges", "hand_poses")


TIMEOUT = "X-Request-Timeout"


def read_timeout(request: Request) -> float | None:
    """Seconds that the caller waits; None: it does not say.

    Raises:
        InvalidRequest: They are no positive number.
    """
    text = request.headers.get(TIMEOUT)
    if text is None:
        return None
    try:
        timeout = float(text)
    except ValueError:
        timeout = math.nan
    if not 0.0 < timeout < math.inf:
        raise InvalidRequest(TIMEOUT, brief(text), "Send seconds, such as 2.5, or leave it out.")
    return timeout


async def read_request(request: Request) -> DetectRequest:
    """Read one request for a detection.

    Raises:
        InvalidRequest: The body is not what its content type says, or has unknown fields.
        UnsupportedMediaType: There is no reader for the content type.
        PayloadTooLarge: The body exceeds the server's limit.
    """
    media_type = _media_type(request)
    if media_type in FILE_TYPES:
        cloud = SentCloud(FileCloud(FILE_TYPES[media_type], await request.body()))
        return DetectRequest(cloud, options_from_query(request.query_params.multi_items()))
    accepted = (JSON_OR_FORM[0], *FILE_TYPES, JSON_OR_FORM[1])
    return _request(await _read_fields(request, media_type, accepted, given=()))


async def read_score_request(request: Request) -> ScoreRequest:
    """Read one request to score edges or hand poses; raises as `read_request`."""
    fields = await _read_fields(request, _media_type(request), JSON_OR_FORM, GIVEN)
    arrays = {name: _given(name, fields.pop(name)) for name in GIVEN if name in fields}
    detect = _request(fields)
    return ScoreRequest(detect.cloud, detect.options, GivenGrasps(**arrays))


def _media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def _read_fields(
    request: Request, media_type: str, accepted: tuple[str, ...], given: tuple[str, ...]
) -> dict[str, Any]:
    """The fields of a JSON body, or the parts of a form."""
    if media_type not in accepted:
        fix = f"Send one of: {', '.join(accepted)}."
        raise UnsupportedMediaType("Content-Type", repr(media_type), fix)
    if request.query_params:
        name = next(iter(request.query_params))
        raise InvalidRequest(name, "a query parameter", "Send options in the part `options`.")
    if media_type == "application/json":
        fields = _object("body", await request.body())
        _refuse_unknown(fields, (*SOURCES, *PER_POINT, *given, "options"), "field")
        return fields
    known = ("cloud", *list(SOURCES)[1:], *PER_POINT, *given, "options")
    try:
        # The body as a whole is limited already, so its parts need not be.
        many = len(known) + 1
        async with request.form(
            max_files=many, max_fields=many, max_part_size=MAX_PART_BYTES
        ) as form:
            return await _from_parts(form, known)
    except HTTPException as error:
        fix = "Send a file part `cloud` and a JSON part `options`."
        raise InvalidRequest("body", f"a form that cannot be read ({error.detail})", fix) from None


async def _from_parts(form: FormData, known: tuple[str, ...]) -> dict[str, Any]:
    """The parts of a form: files as FileCloud and NpyArray, JSON as what it says."""
    _refuse_unknown(form, known, "part")
    for name, count in Counter(name for name, _ in form.multi_items()).items():
        if count > 1:
            raise InvalidRequest(name, f"{count} parts", "Send one.")
    fields: dict[str, Any] = {}
    for name, part in form.items():
        if name == "cloud":
            if not isinstance(part, UploadFile):
                raise InvalidRequest("cloud", "no file", "Send the cloud as a file part.")
            fields["cloud"] = FileCloud(_format_of(part), await part.read())
            continue
        # curl sends `-F options=@file;type=application/json` as a file too.
        data = await part.read() if isinstance(part, UploadFile) else part.encode()
        if isinstance(part, UploadFile) and _format_of(part) == "npy" and name != "options":
            fields[name] = NpyArray(data)
        else:
            fields[name] = _json(name, data)
    return fields


def _request(fields: dict[str, Any]) -> DetectRequest:
    options = fields.get("options", {})
    if not isinstance(options, dict):
        raise InvalidRequest("options", brief(options), "Send a JSON object.")
    beside: dict[str, SentArray] = {}
    for name in PER_POINT:
        if fields.get(name) is not None:
            array = fields[name]
            beside[name] = array if isinstance(array, NpyArray) else ListArray(array)
    return DetectRequest(SentCloud(_source(fields), beside), options)


def _source(fields: Mapping[str, Any]) -> Source | DepthCloud:
    sources = [name for name in ("cloud", *SOURCES) if fields.get(name) is not None]
    if not sources:
        fix = "Send a list of [x, y, z] in metres, point_cloud2, depth_images or a file `cloud`."
        raise InvalidRequest("points", "nothing", fix)
    if len(sources) > 1:
        value = f"a cloud beside {sources[0]}"
        raise InvalidRequest(sources[1], value, "Send one cloud.")
    name = sources[0]
    if isinstance(fields[name], NpyArray):
        raise InvalidRequest(name, "an .npy file", "Send JSON, or the part `cloud`.")
    if name == "cloud":
        file: FileCloud = fields[name]
        return file
    source: Source | DepthCloud = SOURCES[name](fields[name])
    return source


def _given(name: str, value: object) -> Any:
    if value is None:
        return None
    if isinstance(value, NpyArray):
        return read_npy(value.data, 2**31, name)
    return array_from_lists(name, value)


def _refuse_unknown(fields: Mapping[str, Any], known: tuple[str, ...], kind: str) -> None:
    for name in fields:
        if name not in known:
            *names, last = known
            fix = f"Send {', '.join(names)} and {last} only."
            raise InvalidRequest(name, f"an unknown {kind}", fix)


def _format_of(upload: UploadFile) -> str:
    """The format a part's content type names, or else its file name's ending."""
    media_type = (upload.content_type or "").partition(";")[0].strip().lower()
    return FILE_TYPES.get(media_type) or PurePath(upload.filename or "").suffix[1:].lower()


def _object(field: str, text: bytes) -> dict[str, Any]:
    value = _json(field, text)
    if not isinstance(value, dict):
        raise InvalidRequest(field, brief(value), "Send a JSON object.")
    return value


def _json(field: str, text: bytes) -> Any:
    lists = text.count(b"[") + text.count(b"{")
    # Most lists are points, of 8 bytes or more. An empty one takes 3 bytes, and 64 in memory.
    if lists > len(text) // 7 + MAX_SHORT_LISTS:
        value = f"{lists} lists and objects in {len(text)} bytes"
        raise InvalidRequest(field, value, "Send lists that hold numbers.")
    collecting = gc.isenabled()
    gc.disable()  # it would look through millions of lists again and again, and find nothing
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidRequest(field, f"no valid JSON ({error})", "Send a JSON object.") from None
    finally:
        if collecting:
            gc.enable()
