"""Requests, answers and errors as HTTP carries them."""

import base64
import json
import operator
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import httpx
import numpy as np

from edgegrasp_camera.arrays import Array
from edgegrasp_client.clouds import (
    cloud_file,
    depth_image_fields,
    is_point_cloud2,
    npy_bytes,
    point_cloud2_fields,
)
from edgegrasp_client.errors import (
    DeadlineError,
    GraspClientError,
    OverloadedError,
    PayloadTooLargeError,
    ProtocolError,
    ServerUnavailableError,
    error_of_kind,
    invalid,
)
from edgegrasp_client.requests import Request, ScoreRequest
from edgegrasp_client.results import Read

READY = "/health/ready"

MAX_QUERY = 4000  # characters; servers and proxies limit the length of an address

Call = dict[str, Any]  # arguments of httpx's `request`
Part = tuple[str | None, bytes, str]  # of a form: file name, content, media type
Answer = TypeVar("Answer")

_KIND_PREFIX = "urn:edgegrasp:error:"


def detect_call(request: Request) -> Call:
    """A request for grasps; raises InvalidRequestError for what HTTP cannot carry.

    A point cloud file as body and options as query parameters, or a form where there is more.
    """
    cloud = request.cloud
    query = {name: _text(f"options.{name}", value) for name, value in request.options.items()}
    short = sum(map(len, query.values())) < MAX_QUERY
    if cloud is None or is_point_cloud2(cloud) or request.row_arrays() or not short:
        return _form("/v1/grasps", request, {})
    file = cloud_file(cloud)
    headers = {"content-type": f"application/x-{file.format}"}
    post = {"method": "POST", "url": "/v1/grasps", "headers": headers}
    return {**post, "params": query, "content": file.data}


def score_call(request: ScoreRequest) -> Call:
    """A request to score; raises InvalidRequestError for what HTTP cannot carry."""
    arrays = {"edges": request.edges, "hand_poses": request.hand_poses}
    given = {name: array for name, array in arrays.items() if array is not None}
    return _form("/v1/grasps:score", request, given)


def models_call() -> Call:
    """A request for the list of models."""
    return {"method": "GET", "url": "/v1/models"}


def with_deadline(call: Call, timeout: float) -> Call:
    """The call, given up after `timeout` seconds by both sides."""
    headers = {**call.get("headers", {}), "x-request-timeout": f"{timeout:.6g}"}
    return call | {"headers": headers, "timeout": timeout}


def parsed(response: httpx.Response, parse: Callable[[Any, Read], Answer]) -> Answer:
    """An answer, by one of the parsers of `results`.

    Raises:
        GraspClientError: The answer is an error, or not from a grasp service.
    """
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, dict):
        raise _foreign(response)
    if not response.is_success:
        raise _error(body, response)
    try:
        return parse(body, operator.getitem)
    except (KeyError, TypeError, ValueError) as error:
        raise _foreign(response) from error


def error_from_transport(error: httpx.HTTPError) -> GraspClientError:
    """The exception for a call without an answer."""
    if isinstance(error, httpx.TimeoutException):
        return DeadlineError(f"No answer in time ({type(error).__name__}).")
    return ServerUnavailableError(f"No connection: {error or type(error).__name__}")


def _form(path: str, request: Request, arrays: Mapping[str, Array]) -> Call:
    parts: dict[str, Part] = {"options": _json_part("options", request.options)}
    cloud = request.cloud
    if cloud is None:
        images = enumerate(request.depth_images or ())
        fields = [depth_image_fields(image, number) for number, image in images]
        parts["depth_images"] = _json_part("depth_images", fields)
    elif is_point_cloud2(cloud):
        parts["point_cloud2"] = _json_part("point_cloud2", point_cloud2_fields(cloud))
    else:
        file = cloud_file(cloud)
        parts["cloud"] = (f"cloud.{file.format}", file.data, f"application/x-{file.format}")
    for name, array in {**request.row_arrays(), **arrays}.items():
        parts[name] = (f"{name}.npy", npy_bytes(array), "application/x-npy")
    return {"method": "POST", "url": path, "files": parts}


def _json_part(name: str, value: object) -> Part:
    return None, _text(name, value).encode(), "application/json"


def _text(name: str, value: object) -> str:
    if isinstance(value, str):
        return value
    try:
        return json.dumps(value, default=_base64)
    except (TypeError, ValueError) as error:
        raise invalid(name, repr(value)[:80], f"{error}.") from None


def _base64(value: object) -> str:
    if isinstance(value, np.ndarray):  # a mask
        value = value.tobytes()
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    raise TypeError(f"a {type(value).__name__} is no JSON value")


def _error(problem: Mapping[str, Any], response: httpx.Response) -> GraspClientError:
    """The exception for an error the server describes."""
    kind = str(problem.get("type", ""))
    if not kind.startswith(_KIND_PREFIX):
        return _foreign(response)
    said = [str(problem.get(name, "")) for name in ("detail", "field", "value", "fix")]
    kind = kind.removeprefix(_KIND_PREFIX)
    return error_of_kind(kind, *said, retry_after=problem.get("retry_after"))


def _foreign(response: httpx.Response) -> GraspClientError:
    """The exception for an answer of something else, such as a proxy in between."""
    status = response.status_code
    what = f"{response.request.url} answered {status} {response.reason_phrase}"
    if status == httpx.codes.REQUEST_ENTITY_TOO_LARGE:
        return PayloadTooLargeError(f"{what}.")
    retry_after = response.headers.get("retry-after", "")  # may also be a date, which is not read
    if status == httpx.codes.TOO_MANY_REQUESTS or (status == 503 and retry_after.isdecimal()):
        return OverloadedError(f"{what}.", float(retry_after) if retry_after.isdecimal() else 1.0)
    if status in (500, 502, 503, 504):
        return ServerUnavailableError(f"{what}.")
    return ProtocolError(f"{what}, which is not the answer of a grasp service.")
