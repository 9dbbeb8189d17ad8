"""Read the bodies of the POST routes: JSON, a point cloud file, or a form with parts."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException

from edgegrasp_model.errors import InvalidRequest, brief
from edgegrasp_service.cloud_decoding import FILE_FORMATS
from edgegrasp_service.core import DetectRequest, ScoreRequest
from edgegrasp_service.errors import UnsupportedMediaType
from edgegrasp_service.given_grasps import GivenGrasps
from edgegrasp_service.json_text import read_json
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


async def receive_request(request: Request) -> Callable[[], DetectRequest]:
    """Receive what was sent to get a detection.

    Returns:
        What reads it. A long text takes seconds to read, so not in the event loop. It raises
        InvalidRequest where the body is not what its content type says, or has unknown fields.

    Raises:
        InvalidRequest: A form cannot be taken apart, or there are query parameters beside one.
        UnsupportedMediaType: There is no reader for the content type.
        PayloadTooLarge: The body exceeds the server's limit.
    """
    media_type = _media_type(request)
    if media_type in FILE_TYPES:
        cloud = SentCloud(FileCloud(FILE_TYPES[media_type], await request.body()))
        query = request.query_params.multi_items()
        return lambda: DetectRequest(cloud, options_from_query(query))
    accepted = (JSON_OR_FORM[0], *FILE_TYPES, JSON_OR_FORM[1])
    read_fields = await _receive_fields(request, media_type, accepted, given=())
    return lambda: _request(read_fields())


async def receive_score_request(request: Request) -> Callable[[], ScoreRequest]:
    """Receive what was sent to score edges or hand poses; as `receive_request`."""
    read_fields = await _receive_fields(request, _media_type(request), JSON_OR_FORM, GIVEN)

    def read() -> ScoreRequest:
        fields = read_fields()
        arrays = {name: _given(name, fields.pop(name)) for name in GIVEN if name in fields}
        detect = _request(fields)
        return ScoreRequest(detect.cloud, detect.options, GivenGrasps(**arrays))

    return read


def _media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def _receive_fields(
    request: Request, media_type: str, accepted: tuple[str, ...], given: tuple[str, ...]
) -> Callable[[], dict[str, Any]]:
    """What reads the fields of a JSON body, or the parts of a form."""
    if media_type not in accepted:
        fix = f"Send one of: {', '.join(accepted)}."
        raise UnsupportedMediaType("Content-Type", repr(media_type), fix)
    if request.query_params:
        name = next(iter(request.query_params))
        raise InvalidRequest(name, "a query parameter", "Send options in the part `options`.")
    if media_type == "application/json":
        body = await request.body()
        return lambda: _from_json(body, (*SOURCES, *PER_POINT, *given, "options"))
    known = ("cloud", *list(SOURCES)[1:], *PER_POINT, *given, "options")
    try:
        # The body as a whole is limited already, so its parts need not be.
        many = len(known) + 1
        async with request.form(
            max_files=many, max_fields=many, max_part_size=MAX_PART_BYTES
        ) as form:
            parts = [(name, await _part(part)) for name, part in form.multi_items()]
    except HTTPException as error:
        fix = "Send a file part `cloud` and a JSON part `options`."
        raise InvalidRequest("body", f"a form that cannot be read ({error.detail})", fix) from None
    return lambda: _from_parts(parts, known)


class Part(NamedTuple):
    """One part of a form."""

    data: bytes
    file_format: str | None  # None: it is no file


async def _part(part: UploadFile | str) -> Part:
    if isinstance(part, UploadFile):
        return Part(await part.read(), _format_of(part))
    return Part(part.encode(), None)


def _from_json(body: bytes, known: tuple[str, ...]) -> dict[str, Any]:
    fields = _object("body", body)
    _refuse_unknown(fields, known, "field")
    return fields


def _from_parts(parts: Sequence[tuple[str, Part]], known: tuple[str, ...]) -> dict[str, Any]:
    """The parts of a form: files as FileCloud and NpyArray, JSON as what it says."""
    counts = Counter(name for name, _ in parts)
    _refuse_unknown(counts, known, "part")
    for name, count in counts.items():
        if count > 1:
            raise InvalidRequest(name, f"{count} parts", "Send one.")
    fields: dict[str, Any] = {}
    for name, (data, file_format) in parts:
        if name == "cloud":
            if file_format is None:
                raise InvalidRequest("cloud", "no file", "Send the cloud as a file part.")
            fields["cloud"] = FileCloud(file_format, data)
        # curl sends `-F options=@file;type=application/json` as a file too.
        elif file_format == "npy" and name != "options":
            fields[name] = NpyArray(data)
        else:
            fields[name] = read_json(name, data)
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
    value = read_json(field, text)
    if not isinstance(value, dict):
        raise InvalidRequest(field, brief(value), "Send a JSON object.")
    return value
