"""Between protobuf messages and the core's requests and answers."""

from typing import Any

import numpy as np
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.results import Detection, Grasp
from edgegrasp_service.core import DetectRequest, FileCloud, ModelInfo, PackedCloud
from edgegrasp_service.errors import ErrorReport


def request_from_message(message: grasp_pb2.DetectGraspsRequest) -> DetectRequest:
    """Take a request apart.

    Raises:
        InvalidRequest: It has no cloud, or a field this server does not know.
    """
    refuse_unknown_fields(message, "request")
    options = fields_from_message(message.options)
    match message.WhichOneof("cloud"):
        case "points":
            return DetectRequest(PackedCloud(message.points), options)
        case "encoded":
            return DetectRequest(FileCloud(message.encoded.format, message.encoded.data), options)
        case _:
            raise InvalidRequest("cloud", "nothing", "Set `points` or `encoded`.")


def refuse_unknown_fields(message: Message, name: str) -> None:
    """Raise InvalidRequest for fields that are in no schema this server has, at any depth."""
    if len(unknown := UnknownFieldSet(message)):
        numbers = sorted({unknown[row].field_number for row in range(len(unknown))})[:5]
        fix = "Send the fields of edgegrasp.v1 only; is the server older than its client?"
        raise InvalidRequest(name, f"unknown fields numbered {numbers}", fix)
    for field, value in message.ListFields():
        if isinstance(value, Message):
            refuse_unknown_fields(value, f"{name}.{field.name}")


def fields_from_message(message: Message) -> dict[str, object]:
    """The fields set in an options message, as the same options are written in JSON."""
    return {field.name: _plain(value) for field, value in message.ListFields()}


def _plain(value: Any) -> object:
    match value:
        case grasp_pb2.Vector():
            return [value.x, value.y, value.z]
        case grasp_pb2.Suppression(disabled=True):
            return None
        case Message():
            return fields_from_message(value)
        case _:
            return value


def detection_message(detection: Detection) -> grasp_pb2.DetectGraspsResponse:
    """A detection as a message."""
    return grasp_pb2.DetectGraspsResponse(
        grasps=[_grasp_message(grasp) for grasp in detection.grasps],
        counts=detection.counts,
        seconds=detection.seconds,
        model=detection.model,
        warnings=detection.warnings,
    )


def models_message(models: list[ModelInfo]) -> grasp_pb2.ListModelsResponse:
    """Loaded weights as a message."""
    return grasp_pb2.ListModelsResponse(models=[grasp_pb2.Model(**vars(model)) for model in models])


def error_message(problem: ErrorReport) -> grasp_pb2.ErrorDetail:
    """An error as the message in the trailing metadata."""
    return grasp_pb2.ErrorDetail(
        kind=problem.kind, field=problem.field, value=problem.value, fix=problem.fix
    )


def _grasp_message(grasp: Grasp) -> grasp_pb2.Grasp:
    return grasp_pb2.Grasp(
        score=grasp.score,
        T_cloud_hand=np.ravel(grasp.T_cloud_hand).tolist(),
        T_cloud_tcp=np.ravel(grasp.T_cloud_tcp).tolist(),
        width=grasp.width,
        approach_point=grasp.approach_point.tolist(),
        contact_point=grasp.contact_point.tolist(),
        approach_direction=grasp.approach_direction.tolist(),
        collision_free=bool(grasp.collision_free),
    )
