"""Requests, answers and errors as HTTP carries them."""

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any

import httpx
import numpy as np

from edgegrasp_client.cloud_encoding import cloud_file, npy_bytes
from edgegrasp_client.depth_image import DepthImage, depth_image_fields
from edgegrasp_client.errors import (
    DeadlineError,
    GraspClientError,
    PayloadTooLargeError,
    ProtocolError,
    ServerUnavailableError,
    error_of_kind,
    invalid,
)
from edgegrasp_client.inputs import Given, Inputs
from edgegrasp_client.point_cloud2 import is_point_cloud2, point_cloud2_fields
from edgegrasp_client.results import (
    DebugInfo,
    Detection,
    Evaluation,
    Float32,
    Grasp,
    Model,
    Scoring,
)

GRASPS = "/v1/grasps"
SCORE = "/v1/grasps:score"
MODELS = "/v1/models"
READY = "/health/ready"

MAX_QUERY = 4000  # characters; servers and proxies limit the length of an address

Part = tuple[str | None, bytes, str]  # file name, content, media type

_KIND_PREFIX = "urn:edgegrasp:error:"


def detect_post(inputs: Inputs, options: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of an httpx post; raises InvalidRequestError for what no request can hold.

    A point cloud file as body and options as query parameters, or a form where there is more.
    """
    cloud = inputs.cloud
    query = {name: _text(f"options.{name}", value) for name, value in options.items()}
    short = sum(map(len, query.values())) < MAX_QUERY
    if cloud is None or is_point_cloud2(cloud) or inputs.beside() or not short:
        return _form(inputs, options, {})
    file = cloud_file(cloud)
    headers = {"content-type": f"application/x-{file.format}"}
    return {"content": file.data, "headers": headers, "params": query}


def with_deadline(post: dict[str, Any], timeout: float) -> dict[str, Any]:
    """The arguments, and until when the server need not answer any more."""
    return post | {"headers": {**post.get("headers", {}), "x-request-timeout": f"{timeout:.6g}"}}


def score_post(inputs: Inputs, given: Given, options: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of an httpx post; raises InvalidRequestError for what no request can hold."""
    arrays = {name: array for name, array in vars(given).items() if array is not None}
    return _form(inputs, options, arrays)


def _form(
    inputs: Inputs, options: Mapping[str, Any], arrays: Mapping[str, Any]
) -> dict[str, dict[str, Part]]:
    parts: dict[str, Part] = {"options": _json_part("options", options)}
    cloud = inputs.cloud
    if cloud is None:
        images = [depth_image_fields(image, row) for row, image in enumerate(_images(inputs))]
        for image in images:
            pose = image["T_cloud_camera"]
            image["T_cloud_camera"] = [pose[start : start + 4] for start in range(0, 16, 4)]
        parts["depth_images"] = _json_part("depth_images", images)
    elif is_point_cloud2(cloud):
        parts["point_cloud2"] = _json_part("point_cloud2", point_cloud2_fields(cloud))
    else:
        file = cloud_file(cloud)
        name, media_type = f"cloud.{file.format}", f"application/x-{file.format}"
        parts["cloud"] = (name, file.data, media_type)
    for name, array in {**inputs.beside(), **arrays}.items():
        parts[name] = (f"{name}.npy", npy_bytes(array), "application/x-npy")
    return {"files": parts}


def _images(inputs: Inputs) -> Sequence[DepthImage]:
    return inputs.depth_images or ()


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
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    raise TypeError(f"a {type(value).__name__} is no JSON value")


def detection_from_response(response: httpx.Response) -> Detection:
    """The answer to a detection; raises a GraspClientError if it is an error."""
    body = _body(response)
    try:
        return Detection(
            grasps=[_grasp(grasp) for grasp in body["grasps"]],
            counts=body["counts"],
            seconds=body["seconds"],
            model=body["model"],
            warnings=body["warnings"],
            debug=None if body["debug"] is None else _debug(body["debug"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise _foreign(response) from error


def scoring_from_response(response: httpx.Response) -> Scoring:
    """The answer to a request to score; raises a GraspClientError if it is an error."""
    body = _body(response)
    try:
        return Scoring(
            evaluations=[
                Evaluation(
                    None if evaluation["grasp"] is None else _grasp(evaluation["grasp"]),
                    evaluation["reason"],
                )
                for evaluation in body["evaluations"]
            ],
            counts=body["counts"],
            seconds=body["seconds"],
            model=body["model"],
            warnings=body["warnings"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise _foreign(response) from error


def models_from_response(response: httpx.Response) -> list[Model]:
    """The answer to a listing; raises a GraspClientError if it is an error."""
    body = _body(response)
    names = Model.__dataclass_fields__
    try:
        return [Model(**{name: model[name] for name in names}) for model in body["models"]]
    except (KeyError, TypeError) as error:
        raise _foreign(response) from error


def error_from_transport(error: httpx.HTTPError) -> GraspClientError:
    """The exception for a call without an answer."""
    if isinstance(error, httpx.TimeoutException):
        return DeadlineError(f"No answer in time ({type(error).__name__}).")
    return ServerUnavailableError(f"No connection: {error or type(error).__name__}")


def _body(response: httpx.Response) -> dict[str, Any]:
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, dict):
        raise _foreign(response)
    if response.is_success:
        return body
    kind = str(body.get("type", ""))
    if not kind.startswith(_KIND_PREFIX):
        raise _foreign(response)
    told = [str(body.get(name, "")) for name in ("detail", "field", "value", "fix")]
    kind = kind.removeprefix(_KIND_PREFIX)
    raise error_of_kind(kind, *told, retry_after=body.get("retry_after"))


def _foreign(response: httpx.Response) -> GraspClientError:
    """The exception for an answer of something else, such as a proxy in between."""
    what = f"{response.request.url} answered {response.status_code} {response.reason_phrase}"
    if response.status_code == httpx.codes.REQUEST_ENTITY_TOO_LARGE:
        return PayloadTooLargeError(f"{what}.")
    if response.status_code in (502, 503, 504):
        return ServerUnavailableError(f"{what}.")
    return ProtocolError(f"{what}, which is no answer of a grasp service.")


def _floats(values: Any) -> Float32:
    return np.array(values, dtype=np.float32)


def _grasp(fields: Mapping[str, Any]) -> Grasp:
    return Grasp(
        score=fields["score"],
        T_cloud_hand=_floats(fields["T_cloud_hand"]),
        T_cloud_tcp=_floats(fields["T_cloud_tcp"]),
        width=fields["width"],
        approach_point=_floats(fields["approach_point"]),
        contact_point=_floats(fields["contact_point"]),
        approach_direction=_floats(fields["approach_direction"]),
        collision_free=fields["collision_free"],
        clearance=fields["clearance"],
    )


def _debug(fields: Mapping[str, Any]) -> DebugInfo:
    plane = fields["support_plane"]
    return DebugInfo(
        points=_floats(fields["points"]).reshape(-1, 3),
        normals=_floats(fields["normals"]).reshape(-1, 3),
        approach_index=np.array(fields["approach_index"], dtype=np.int32),
        contact_index=np.array(fields["contact_index"], dtype=np.int32),
        T_cloud_hand=_floats(fields["T_cloud_hand"]).reshape(-1, 4, 4),
        score=_floats(fields["score"]),  # null becomes NaN
        outcome=fields["outcome"],
        support_plane=None if plane is None else _floats(plane),
    )
