"""gRPC messages: parse requests and write answers.

A request message is converted to the fields of the same request in JSON, so that one schema checks
both.
"""

from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError, Message
from google.protobuf.unknown_fields import UnknownFieldSet

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import MAX_CANDIDATES, MAX_ROWS
from edgegrasp_model.request_cloud import PER_POINT, File
from edgegrasp_results import Detection, Scoring
from edgegrasp_service.worker.process import Job

MAX_PARTS = 64  # most messages in a repeated field; no option takes more
MAX_GIVEN = {"edges": MAX_CANDIDATES, "hand_poses": MAX_CANDIDATES}


def read_request(job: Job) -> dict[str, Any]:
    """The fields of a request, as `http_bodies.read_request` gives them.

    Returns:
        Plain values, with bytes where the message has bytes; edges (M, 2) and hand poses (M, 4, 4)
        as arrays.

    Raises:
        InvalidRequest: It is not such a message, has an invalid pose, more parts than any request
            needs, or an unknown field.
    """
    scores = job.method == "ScoreGrasps"
    kind = grasp_pb2.ScoreGraspsRequest if scores else grasp_pb2.DetectGraspsRequest
    try:
        message: Any = kind.FromString(job.body)
    except DecodeError:
        value = f"{len(job.body)} bytes that are no message of this method"
        fix = "Send a message as the .proto file has it."
        raise InvalidRequest("request", value, fix) from None
    _check(message, "request")
    fields: dict[str, Any] = {}
    if message.HasField("points"):
        fields["points"] = message.points
    if message.HasField("encoded"):
        fields["cloud"] = File(message.encoded.format, message.encoded.data)
    if message.HasField("point_cloud2"):
        fields["point_cloud2"] = _plain_fields(message.point_cloud2)
    if message.depth_images:
        images = enumerate(message.depth_images)
        fields["depth_images"] = [_depth_image(image, row) for row, image in images]
    fields |= {name: getattr(message, name) for name in PER_POINT if message.HasField(name)}
    fields["options"] = plain_options(message.options)
    if scores and message.edges:
        pairs = [(edge.approach_index, edge.contact_index) for edge in message.edges]
        fields["edges"] = np.array(pairs)
    if scores and message.hand_poses:
        poses = enumerate(message.hand_poses)
        fields["hand_poses"] = np.array(
            [_matrix(pose.T_cloud_hand, f"hand_poses.{row}.T_cloud_hand") for row, pose in poses]
        )
    return fields


def plain_options(message: grasp_pb2.DetectOptions) -> dict[str, Any]:
    """The options that are set; raises InvalidRequest if one is set in two fields."""
    options = _set_fields(message)
    if "object_choice" in options:
        if "objects" in options:
            value = f"{options['objects']!r} beside object_choice"
            raise InvalidRequest("options.objects", value, "Send one of the two.")
        options["objects"] = options.pop("object_choice")
    return options


def write(result: Detection | Scoring) -> bytes:
    """A result as DetectGraspsResponse or ScoreGraspsResponse."""
    if isinstance(result, Detection):
        return grasp_pb2.DetectGraspsResponse(**_flat(result)).SerializeToString()
    return grasp_pb2.ScoreGraspsResponse(**_flat(result)).SerializeToString()


def _flat(value: Any) -> Any:
    """Fields in the form of messages: arrays flat, in row-major order."""
    if isinstance(value, np.ndarray):
        return value.ravel().tolist()
    if isinstance(value, list):
        return [_flat(part) for part in value]
    if is_dataclass(value):
        return {name: _flat(part) for name, part in vars(value).items()}
    return value


# Requests


def _check(message: Message, name: str) -> None:
    """Refuse unknown fields, and lists that would take minutes and gigabytes in Python."""
    if len(unknown := UnknownFieldSet(message)):
        numbers = sorted({unknown[row].field_number for row in range(len(unknown))})[:5]
        fix = "Send the fields of edgegrasp.v1 only; is the server older than its client?"
        raise InvalidRequest(name, f"unknown fields numbered {numbers}", fix)
    for field in message.DESCRIPTOR.fields:
        here, is_message = f"{name}.{field.name}", field.message_type is not None
        if field.is_repeated:
            parts = getattr(message, field.name)
            most = MAX_GIVEN.get(field.name, MAX_PARTS) if is_message else MAX_ROWS
            if len(parts) > most:
                here = here.removeprefix("request.")
                raise InvalidRequest(here, f"{len(parts)} of them", f"Send at most {most}.")
            for row, part in enumerate(parts if is_message else ()):
                _check(part, f"{here}.{row}")
        elif is_message and message.HasField(field.name):
            _check(getattr(message, field.name), here)


def _depth_image(message: grasp_pb2.DepthImage, row: int) -> dict[str, Any]:
    fields = _plain_fields(message)
    if pose := fields.pop("T_cloud_camera"):
        fields["T_cloud_camera"] = _matrix(pose, f"depth_images.{row}.T_cloud_camera")
    return fields


def _matrix(numbers: Any, field: str) -> list[list[float]]:
    if len(numbers) != 16:
        raise InvalidRequest(field, f"{len(numbers)} numbers", "Send 16, row-major.")
    return [list(numbers[start : start + 4]) for start in range(0, 16, 4)]


def _plain_fields(message: Message) -> dict[str, Any]:
    """The fields of a message that are set, and all lists, even empty ones."""
    return {
        field.name: _field(message, field)
        for field in message.DESCRIPTOR.fields
        if field.is_repeated or not field.has_presence or message.HasField(field.name)
    }


def _set_fields(message: Message) -> dict[str, Any]:
    return {field.name: _field(message, field) for field, _ in message.ListFields()}


def _field(message: Message, field: Any) -> Any:
    value = getattr(message, field.name)
    if field.type == field.TYPE_BOOL and field.is_repeated:
        return np.array(value, dtype=bool)  # a mask: millions of values, packed
    if field.is_repeated:
        return list(value) if field.message_type is None else [_plain(part) for part in value]
    return _plain(value)


def _plain(value: Any) -> Any:
    if not isinstance(value, Message):
        return value
    form: Callable[[Any], Any] = _FORMS.get(type(value), _plain_fields)
    return form(value)


def _coordinates(message: Message) -> list[float]:
    return [getattr(message, field.name) for field in message.DESCRIPTOR.fields]


def _gripper(message: grasp_pb2.GripperChoice) -> Any:
    which = message.WhichOneof("choice")
    return None if which is None else _plain(getattr(message, which))


def _tagged(message: Message) -> dict[str, Any]:
    """The field of the oneof `kind` that is set, its name beside its fields."""
    which = message.WhichOneof("kind")
    return {} if which is None else {"kind": which} | _plain_fields(getattr(message, which))


def _support(message: grasp_pb2.Support) -> dict[str, Any] | None:
    fields = _plain_fields(message)
    if fields.pop("disabled"):
        return None
    for kind in ("ransac", "auto"):
        if kind in fields:
            fields |= {"kind": kind} | fields.pop(kind)
    return fields


def _suppression(message: grasp_pb2.Suppression) -> dict[str, Any] | None:
    fields = _plain_fields(message)
    return None if fields.pop("disabled") else fields


# Messages that JSON does not write field by field.
_FORMS: dict[type[Message], Callable[[Any], Any]] = {
    grasp_pb2.Place: _set_fields,
    grasp_pb2.Pixel: _coordinates,
    grasp_pb2.Vector: _coordinates,
    grasp_pb2.Quaternion: _coordinates,
    grasp_pb2.HandBox: lambda box: [_coordinates(box.min), _coordinates(box.max)],
    grasp_pb2.GripperChoice: _gripper,
    grasp_pb2.Shape: _tagged,
    grasp_pb2.Obstacle: _tagged,
    grasp_pb2.Support: _support,
    grasp_pb2.Suppression: _suppression,
}
