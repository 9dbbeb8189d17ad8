"""Requests, answers and errors as gRPC carries them."""

from collections.abc import Mapping
from typing import Any

import grpc
import numpy as np
from google.protobuf.message import DecodeError, Message

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.cloud_encoding import Cloud, cloud_file, packable
from edgegrasp_client.errors import (
    DeadlineError,
    GraspClientError,
    InvalidRequestError,
    PayloadTooLargeError,
    ProtocolError,
    ServerFailedError,
    ServerUnavailableError,
    error_of_kind,
    invalid,
)
from edgegrasp_client.results import Detection, Float32, Grasp, Model

CHANNEL_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.initial_reconnect_backoff_ms", 100),  # servers restart within seconds
    ("grpc.max_reconnect_backoff_ms", 1000),
)

# grpc.health.v1: an empty request asks about the whole server; field 1 = 1 means SERVING.
HEALTH_CHECK = "/grpc.health.v1.Health/Check"
SERVING = b"\x08\x01"

_ERROR_METADATA = "edgegrasp-error-bin"

_BY_CODE: dict[grpc.StatusCode, type[GraspClientError]] = {
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineError,
    grpc.StatusCode.INVALID_ARGUMENT: InvalidRequestError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: PayloadTooLargeError,
    grpc.StatusCode.UNAVAILABLE: ServerUnavailableError,
    grpc.StatusCode.CANCELLED: ServerUnavailableError,
    grpc.StatusCode.INTERNAL: ServerFailedError,
    grpc.StatusCode.UNKNOWN: ServerFailedError,
}


def request_message(cloud: Cloud, options: Mapping[str, Any]) -> grasp_pb2.DetectGraspsRequest:
    """A request; raises InvalidRequestError for what no message can hold."""
    message = grasp_pb2.DetectGraspsRequest()
    points = packable(cloud)
    if points is not None:
        message.points = points.astype("<f4", copy=False).tobytes()
    else:
        file = cloud_file(cloud)
        message.encoded.format, message.encoded.data = file.format, file.data
    _fill(message.options, options, "options")
    return message


def _fill(message: Message, fields: object, path: str) -> None:
    """Set a message's fields to plain values."""
    if not isinstance(fields, Mapping):
        raise invalid(path, repr(fields)[:80], f"Give a mapping with {_known(message)}.")
    message.SetInParent()
    for name, value in fields.items():
        field = message.DESCRIPTOR.fields_by_name.get(name)
        here = f"{path}.{name}"
        if field is None:
            raise invalid(here, "an unknown field", f"Give {_known(message)} only.")
        part = getattr(message, name) if field.message_type is not None else None
        if value is None and isinstance(part, grasp_pb2.Suppression):
            part.disabled = True
        elif isinstance(part, grasp_pb2.Vector):
            if not isinstance(value, list) or len(value) != 3:
                raise invalid(here, repr(value)[:80], "Give three numbers: x, y, z.")
            _fill(part, dict(zip("xyz", value, strict=True)), here)
        elif part is not None:
            _fill(part, value, here)
        else:
            _set(message, name, value, here)


def _set(message: Message, name: str, value: object, path: str) -> None:
    try:
        setattr(message, name, value)
    except (TypeError, ValueError) as error:
        raise invalid(path, repr(value)[:80], f"{error}.") from None


def _known(message: Message) -> str:
    return ", ".join(field.name for field in message.DESCRIPTOR.fields)


def detection_from_message(message: grasp_pb2.DetectGraspsResponse) -> Detection:
    """The answer to a detection."""
    return Detection(
        grasps=[
            Grasp(
                score=grasp.score,
                T_cloud_hand=_floats(grasp.T_cloud_hand).reshape(4, 4),
                T_cloud_tcp=_floats(grasp.T_cloud_tcp).reshape(4, 4),
                width=grasp.width,
                approach_point=_floats(grasp.approach_point),
                contact_point=_floats(grasp.contact_point),
                approach_direction=_floats(grasp.approach_direction),
                collision_free=grasp.collision_free,
            )
            for grasp in message.grasps
        ],
        counts=dict(message.counts),
        seconds=dict(message.seconds),
        model=message.model,
        warnings=list(message.warnings),
    )


def models_from_message(message: grasp_pb2.ListModelsResponse) -> list[Model]:
    """The answer to a listing."""
    names = [field.name for field in grasp_pb2.Model.DESCRIPTOR.fields]
    return [Model(**{name: getattr(model, name) for name in names}) for model in message.models]


def error_from_call(error: Any) -> GraspClientError:
    """The exception for a failed call, as the server describes it or by its status code."""
    code, message = error.code(), error.details() or ""
    for name, value in error.trailing_metadata() or ():
        if name == _ERROR_METADATA:
            try:
                detail = grasp_pb2.ErrorDetail.FromString(bytes(value))
            except DecodeError:
                break
            return error_of_kind(detail.kind, message, detail.field, detail.value, detail.fix)
    return _BY_CODE.get(code, ProtocolError)(f"{code.name}: {message}")


def _floats(values: Any) -> Float32:
    return np.array(values, dtype=np.float32)
