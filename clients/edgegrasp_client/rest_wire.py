"""Requests, answers and errors as HTTP carries them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np

from edgegrasp_client.cloud_encoding import Cloud, cloud_file
from edgegrasp_client.errors import (
    DeadlineError,
    GraspClientError,
    PayloadTooLargeError,
    ProtocolError,
    ServerUnavailableError,
    error_of_kind,
    invalid,
)
from edgegrasp_client.results import Detection, Float32, Grasp, Model

GRASPS = "/v1/grasps"
MODELS = "/v1/models"
READY = "/health/ready"

_KIND_PREFIX = "urn:edgegrasp:error:"


@dataclass(frozen=True)
class Post:
    """A point cloud file as body, options as query parameters."""

    content: bytes
    headers: dict[str, str]
    params: dict[str, str]


def detect_post(cloud: Cloud, options: Mapping[str, Any]) -> Post:
    """A request; raises InvalidRequestError for what no request can hold."""
    file = cloud_file(cloud)
    return Post(
        content=file.data,
        headers={"content-type": f"application/x-{file.format}"},
        params={name: _text(name, value) for name, value in options.items()},
    )


def _text(name: str, value: object) -> str:
    if isinstance(value, str):
        return value
    try:
        return json.dumps(value)
    except (TypeError, ValueError) as error:
        raise invalid(f"options.{name}", repr(value)[:80], f"{error}.") from None


def detection_from_response(response: httpx.Response) -> Detection:
    """The answer to a detection; raises a GraspClientError if it is an error."""
    body = _body(response)
    try:
        return Detection(
            grasps=[
                Grasp(
                    score=grasp["score"],
                    T_cloud_hand=_floats(grasp["T_cloud_hand"]),
                    T_cloud_tcp=_floats(grasp["T_cloud_tcp"]),
                    width=grasp["width"],
                    approach_point=_floats(grasp["approach_point"]),
                    contact_point=_floats(grasp["contact_point"]),
                    approach_direction=_floats(grasp["approach_direction"]),
                    collision_free=grasp["collision_free"],
                )
                for grasp in body["grasps"]
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
    raise error_of_kind(
        kind.removeprefix(_KIND_PREFIX),
        *(str(body.get(name, "")) for name in ("detail", "field", "value", "fix")),
    )


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
