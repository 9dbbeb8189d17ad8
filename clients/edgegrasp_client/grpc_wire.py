"""Requests, answers and errors as gRPC carries them."""

from collections.abc import Mapping
from typing import Any

import grpc
import numpy as np
from google.protobuf.message import DecodeError

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.cloud_encoding import cloud_file, packable
from edgegrasp_client.depth_image import depth_image_fields
from edgegrasp_client.errors import (
    AccessDeniedError,
    DeadlineError,
    GraspClientError,
    InvalidRequestError,
    PayloadTooLargeError,
    ProtocolError,
    ServerFailedError,
    ServerUnavailableError,
    error_of_kind,
)
from edgegrasp_client.inputs import Given, Inputs
from edgegrasp_client.option_messages import fill
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
from edgegrasp_client.stream import StreamAnswer, StreamRequest

CHANNEL_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.initial_reconnect_backoff_ms", 100),  # servers restart within seconds
    ("grpc.max_reconnect_backoff_ms", 1000),
    # A server that vanished without a word is found out, and streams to it end.
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 10_000),
)

# grpc.health.v1: an empty request asks about the whole server; field 1 = 1 means SERVING.
HEALTH_CHECK = "/grpc.health.v1.Health/Check"
SERVING = b"\x08\x01"

_ERROR_METADATA = "edgegrasp-error-bin"

_BY_CODE: dict[grpc.StatusCode, type[GraspClientError]] = {
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineError,
    grpc.StatusCode.INVALID_ARGUMENT: InvalidRequestError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: PayloadTooLargeError,
    grpc.StatusCode.UNAUTHENTICATED: AccessDeniedError,
    grpc.StatusCode.PERMISSION_DENIED: AccessDeniedError,
    grpc.StatusCode.UNAVAILABLE: ServerUnavailableError,
    grpc.StatusCode.CANCELLED: ServerUnavailableError,
    grpc.StatusCode.INTERNAL: ServerFailedError,
    grpc.StatusCode.UNKNOWN: ServerFailedError,
}


def request_message(inputs: Inputs, options: Mapping[str, Any]) -> grasp_pb2.DetectGraspsRequest:
    """A request; raises InvalidRequestError for what no message can hold."""
    message = grasp_pb2.DetectGraspsRequest()
    _set_cloud(message, inputs)
    fill(message.options, options, "options")
    return message


def score_message(
    inputs: Inputs, given: Given, options: Mapping[str, Any]
) -> grasp_pb2.ScoreGraspsRequest:
    """A request to score; raises InvalidRequestError for what no message can hold."""
    message = grasp_pb2.ScoreGraspsRequest()
    _set_cloud(message, inputs)
    fill(message.options, options, "options")
    if given.edges is not None:
        for approach, contact in given.edges.tolist():
            edge = {"approach_index": approach, "contact_index": contact}
            fill(message.edges.add(), edge, "edges")
    if given.hand_poses is not None:
        for pose in given.hand_poses:
            message.hand_poses.add(T_cloud_hand=pose.ravel().tolist())
    return message


def _set_cloud(message: Any, inputs: Inputs) -> None:
    cloud = inputs.cloud
    if cloud is None:
        for row, image in enumerate(inputs.depth_images or ()):
            fields = depth_image_fields(image, row)
            fill(message.depth_images.add(), fields, f"depth_images.{row}")
    elif is_point_cloud2(cloud):
        fill(message.point_cloud2, point_cloud2_fields(cloud), "point_cloud2")
    elif (points := packable(cloud)) is not None:
        message.points = points.astype("<f4", copy=False).tobytes()
    else:
        file = cloud_file(cloud)
        message.encoded.format, message.encoded.data = file.format, file.data
    for name, array in inputs.beside().items():
        setattr(message, name, array.astype(array.dtype.newbyteorder("<")).tobytes())


def detection_from_message(message: grasp_pb2.DetectGraspsResponse) -> Detection:
    """The answer to a detection."""
    return Detection(
        grasps=[_grasp(grasp) for grasp in message.grasps],
        counts=dict(message.counts),
        seconds=dict(message.seconds),
        model=message.model,
        warnings=list(message.warnings),
        debug=_debug(message.debug) if message.HasField("debug") else None,
    )


def scoring_from_message(message: grasp_pb2.ScoreGraspsResponse) -> Scoring:
    """The answer to a request to score."""
    return Scoring(
        evaluations=[
            Evaluation(
                _grasp(evaluation.grasp) if evaluation.HasField("grasp") else None,
                evaluation.reason if evaluation.HasField("reason") else None,
            )
            for evaluation in message.evaluations
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
            return _error(message, detail)
    return _BY_CODE.get(code, ProtocolError)(f"{code.name}: {message}")


def stream_message(
    request: StreamRequest, number: int, timeout: float
) -> grasp_pb2.DetectGraspsStreamRequest:
    """A request of a stream; raises InvalidRequestError for what no message can hold."""
    return grasp_pb2.DetectGraspsStreamRequest(
        request_id=request.name(number),
        request=request_message(request.inputs, request.options),
        timeout=timeout if request.timeout is None else request.timeout,
    )


def stream_answer(message: grasp_pb2.DetectGraspsStreamResponse) -> StreamAnswer:
    """The answer to one request of a stream."""
    if message.HasField("detection"):
        return StreamAnswer(message.request_id, detection_from_message(message.detection))
    error = _error(message.error.message, message.error.detail)
    return StreamAnswer(message.request_id, error=error)


def _error(message: str, detail: grasp_pb2.ErrorDetail) -> GraspClientError:
    retry_after = detail.retry_after if detail.HasField("retry_after") else None
    return error_of_kind(
        detail.kind, message, detail.field, detail.value, detail.fix, retry_after=retry_after
    )


def _floats(values: Any) -> Float32:
    return np.array(values, dtype=np.float32)


def _grasp(message: grasp_pb2.Grasp) -> Grasp:
    return Grasp(
        score=message.score,
        T_cloud_hand=_floats(message.T_cloud_hand).reshape(4, 4),
        T_cloud_tcp=_floats(message.T_cloud_tcp).reshape(4, 4),
        width=message.width,
        approach_point=_floats(message.approach_point),
        contact_point=_floats(message.contact_point),
        approach_direction=_floats(message.approach_direction),
        collision_free=message.collision_free,
        clearance=message.clearance,
    )


def _debug(message: grasp_pb2.DebugInfo) -> DebugInfo:
    return DebugInfo(
        points=_floats(message.points).reshape(-1, 3),
        normals=_floats(message.normals).reshape(-1, 3),
        approach_index=np.array(message.approach_index, dtype=np.int32),
        contact_index=np.array(message.contact_index, dtype=np.int32),
        T_cloud_hand=_floats(message.T_cloud_hand).reshape(-1, 4, 4),
        score=_floats(message.score),
        outcome=list(message.outcome),
        support_plane=_floats(message.support_plane) if message.support_plane else None,
    )
