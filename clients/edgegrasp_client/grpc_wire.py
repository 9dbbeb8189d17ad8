"""Requests, answers and errors as gRPC carries them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import grpc
import numpy as np
from google.protobuf.message import DecodeError, Message

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.clouds import (
    cloud_file,
    depth_image_fields,
    float32_points,
    is_point_cloud2,
    point_cloud2_fields,
)
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
    invalid,
)
from edgegrasp_client.requests import Request, ScoreRequest, StreamRequest
from edgegrasp_client.results import StreamAnswer, detection_from

# grpc.health.v1: an empty request asks about the whole server; field 1 = 1 means SERVING.
HEALTH_CHECK = "/grpc.health.v1.Health/Check"
SERVING = b"\x08\x01"

_ERROR_METADATA = "edgegrasp-error-bin"

Filled = tuple[Message, object]  # a message, and the mapping of its fields that goes into it

_BY_CODE: dict[grpc.StatusCode, type[GraspClientError]] = {
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineError,
    grpc.StatusCode.INVALID_ARGUMENT: InvalidRequestError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: PayloadTooLargeError,
    grpc.StatusCode.UNAUTHENTICATED: AccessDeniedError,
    grpc.StatusCode.PERMISSION_DENIED: AccessDeniedError,
    grpc.StatusCode.UNAVAILABLE: ServerUnavailableError,
    grpc.StatusCode.CANCELLED: ServerUnavailableError,
    grpc.StatusCode.INTERNAL: ServerUnavailableError,  # of a proxy: our servers say more
    grpc.StatusCode.UNKNOWN: ServerFailedError,
}


def detect_message(request: Request) -> grasp_pb2.DetectGraspsRequest:
    """A request for grasps; raises InvalidRequestError for what no message can hold."""
    message = grasp_pb2.DetectGraspsRequest()
    _set_cloud_and_options(message, request)
    return message


def score_message(request: ScoreRequest) -> grasp_pb2.ScoreGraspsRequest:
    """A request to score; raises InvalidRequestError for what no message can hold."""
    message = grasp_pb2.ScoreGraspsRequest()
    _set_cloud_and_options(message, request)
    if request.edges is not None:
        for approach, contact in request.edges.tolist():
            edge = {"approach_index": approach, "contact_index": contact}
            fill(message.edges.add(), edge, "edges")
    if request.hand_poses is not None:
        for pose in request.hand_poses:
            message.hand_poses.add(T_cloud_hand=pose.ravel().tolist())
    return message


def stream_message(
    request: StreamRequest, number: int, timeout: float
) -> grasp_pb2.DetectGraspsStreamRequest:
    """A request of a stream; raises InvalidRequestError for what no message can hold."""
    return grasp_pb2.DetectGraspsStreamRequest(
        request_id=request.name(number),
        request=detect_message(request.request),
        timeout=timeout if request.timeout is None else request.timeout,
    )


def read_field(message: Message, name: str) -> Any:
    """A field of an answer; None if it is absent. What the parsers of `results` read with."""
    absent = message.DESCRIPTOR.fields_by_name[name].has_presence and not message.HasField(name)
    return None if absent else getattr(message, name)


def stream_answer(message: grasp_pb2.DetectGraspsStreamResponse) -> StreamAnswer:
    """The answer to one request of a stream."""
    if message.HasField("detection"):
        return StreamAnswer(message.request_id, detection_from(message.detection, read_field))
    error = _error(message.error.message, message.error.detail)
    return StreamAnswer(message.request_id, error=error)


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


def _error(message: str, detail: grasp_pb2.ErrorDetail) -> GraspClientError:
    retry_after = detail.retry_after if detail.HasField("retry_after") else None
    return error_of_kind(
        detail.kind, message, detail.field, detail.value, detail.fix, retry_after=retry_after
    )


def _set_cloud_and_options(message: Any, request: Request) -> None:
    cloud = request.cloud
    if cloud is None:
        for which, image in enumerate(request.depth_images or ()):
            fields = depth_image_fields(image, which)
            fields["T_cloud_camera"] = np.ravel(fields["T_cloud_camera"]).tolist()
            fill(message.depth_images.add(), fields, f"depth_images.{which}")
    elif is_point_cloud2(cloud):
        fill(message.point_cloud2, point_cloud2_fields(cloud), "point_cloud2")
    elif (points := float32_points(cloud)) is not None:
        message.points = points.astype("<f4", copy=False).tobytes()
    else:
        file = cloud_file(cloud)
        message.encoded.format, message.encoded.data = file.format, file.data
    for name, array in request.row_arrays().items():
        setattr(message, name, array.astype(array.dtype.newbyteorder("<")).tobytes())
    fill(message.options, request.options, "options")


def fill(message: Message, value: object, path: str) -> None:
    """Set a message to a plain value, written as the same thing is in JSON.

    Raises:
        InvalidRequestError: The message cannot hold the value. Whether the value is a good one is
            for the server to say.
    """
    if (form := _FORMS.get(type(message))) is not None:
        message, value = form(message, value, path)
    if not isinstance(value, Mapping):
        raise invalid(path, repr(value)[:80], f"Give a mapping with {_known(message)}.")
    message.SetInParent()
    for name, part in value.items():
        field = message.DESCRIPTOR.fields_by_name.get(name)
        here = f"{path}.{name}"
        if field is None:
            raise invalid(here, "an unknown field", f"Give {_known(message)} only.")
        if field.is_repeated:
            _extend(getattr(message, name), part, here, field.message_type is not None)
        elif field.message_type is not None:
            fill(getattr(message, name), part, here)
        else:
            _set(message, name, part, here)


def _set(message: Message, name: str, value: object, path: str) -> None:
    try:
        setattr(message, name, value)
    except (TypeError, ValueError) as error:
        raise invalid(path, repr(value)[:80], f"{error}.") from None


def _extend(container: Any, values: object, path: str, messages: bool) -> None:
    if isinstance(values, np.ndarray):
        values = values.tolist()
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise invalid(path, repr(values)[:80], "Give a list.")
    if messages:
        for row, value in enumerate(values):
            fill(container.add(), value, f"{path}.{row}")
        return
    try:
        container.extend(values)
    except (TypeError, ValueError) as error:
        nested = any(isinstance(value, Sequence) for value in values)
        fix = "Give one list without lists in it, or an array of bool." if nested else f"{error}."
        raise invalid(path, repr(values)[:80], fix) from None


def _known(message: Message) -> str:
    internal = ("disabled", "ransac", "auto", "object_choice")  # JSON writes these in another way
    return ", ".join(f.name for f in message.DESCRIPTOR.fields if f.name not in internal)


def _options(message: Message, value: Any, path: str) -> Filled:
    """One viewpoint may be given without a list around it, and objects as a choice of them."""
    if isinstance(value.get("objects"), Mapping):
        value = {**value, "object_choice": value["objects"]}
        del value["objects"]
    viewpoint = value.get("viewpoint")
    listed = isinstance(viewpoint, list) and bool(viewpoint) and isinstance(viewpoint[0], list)
    if viewpoint is None or listed:
        return message, value
    return message, {**value, "viewpoint": [viewpoint]}


def _coordinates(message: Message, value: Any, path: str) -> Filled:
    names = [field.name for field in message.DESCRIPTOR.fields]
    if not isinstance(value, Sequence) or len(value) != len(names):
        count = {2: "two", 3: "three", 4: "four"}[len(names)]
        raise invalid(path, repr(value)[:80], f"Give {count} numbers: {', '.join(names)}.")
    return message, dict(zip(names, value, strict=True))


def _corners(message: Message, value: Any, path: str) -> Filled:
    if not isinstance(value, Sequence) or len(value) != 2:
        raise invalid(path, repr(value)[:80], "Give two corners: [min, max].")
    return message, {"min": value[0], "max": value[1]}


def _gripper(message: Any, value: Any, path: str) -> Filled:
    return (message, {"name": value}) if isinstance(value, str) else (message.geometry, value)


def _shape(message: Message, value: Any, path: str) -> Filled:
    kinds = [field.name for field in message.DESCRIPTOR.fields]
    if not isinstance(value, Mapping) or value.get("kind") not in kinds:
        kind = repr(value.get("kind") if isinstance(value, Mapping) else value)[:80]
        raise invalid(path, kind, f"Set its kind to one of {', '.join(kinds)}.")
    return getattr(message, value["kind"]), _without_kind(value)


def _support(message: Any, value: Any, path: str) -> Filled:
    if value is None or value == "none":
        return message, {"disabled": True}
    value = {"kind": value} if isinstance(value, str) else value
    if not isinstance(value, Mapping):
        raise invalid(path, repr(value)[:80], "Give a mapping with normal and offset.")
    kind = value.get("kind", "plane")
    if kind in ("auto", "ransac"):
        return getattr(message, kind), _without_kind(value)
    if kind != "plane" or {"auto", "ransac"} & value.keys():
        raise invalid(path, repr(kind)[:80], "Set its kind to one of auto, plane, ransac, none.")
    return message, _without_kind(value)


def _suppression(message: Message, value: Any, path: str) -> Filled:
    return message, {"disabled": True} if value is None else value


def _collision(message: Message, value: Any, path: str) -> Filled:
    return message, {"mode": value} if isinstance(value, str) else value


def _robot(message: Message, value: Any, path: str) -> Filled:
    """A pose may also be rows, as arrays are sent."""
    pose = value.get("T_base_cloud") if isinstance(value, Mapping) else None
    if isinstance(pose, list) and all(isinstance(row, list) for row in pose):
        value = {**value, "T_base_cloud": [number for row in pose for number in row]}
    return message, value


def _without_kind(value: Mapping[str, Any]) -> dict[str, Any]:
    return {name: part for name, part in value.items() if name != "kind"}


# Messages that JSON does not write field by field: the message to fill, and its fields.
_FORMS: dict[type[Message], Callable[[Any, Any, str], Filled]] = {
    grasp_pb2.DetectOptions: _options,
    grasp_pb2.RobotArm: _robot,
    grasp_pb2.Pixel: _coordinates,
    grasp_pb2.Vector: _coordinates,
    grasp_pb2.Quaternion: _coordinates,
    grasp_pb2.HandBox: _corners,
    grasp_pb2.GripperChoice: _gripper,
    grasp_pb2.Shape: _shape,
    grasp_pb2.Obstacle: _shape,
    grasp_pb2.Support: _support,
    grasp_pb2.Suppression: _suppression,
    grasp_pb2.Collision: _collision,
}
