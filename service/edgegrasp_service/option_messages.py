"""Options messages as the plain values in which the same options are written in JSON."""

from collections.abc import Callable
from functools import cache
from typing import Any

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import InvalidRequest


def refuse_unknown_fields(message: Message, name: str) -> None:
    """Raise InvalidRequest for fields that are in no schema this server has, at any depth."""
    if len(unknown := UnknownFieldSet(message)):
        numbers = sorted({unknown[row].field_number for row in range(len(unknown))})[:5]
        fix = "Send the fields of edgegrasp.v1 only; is the server older than its client?"
        raise InvalidRequest(name, f"unknown fields numbered {numbers}", fix)
    for part, is_repeated in _parts(message.DESCRIPTOR):
        if is_repeated:
            for row, each in enumerate(getattr(message, part)):
                refuse_unknown_fields(each, f"{name}.{part}.{row}")
        elif message.HasField(part):
            refuse_unknown_fields(getattr(message, part), f"{name}.{part}")


@cache
def _parts(descriptor: Descriptor) -> list[tuple[str, bool]]:
    """Fields that are messages, and whether there may be several; asking for bytes copies them."""
    return [
        (field.name, field.is_repeated)
        for field in descriptor.fields
        if field.message_type is not None
    ]


def options_from_message(message: grasp_pb2.DetectOptions) -> dict[str, object]:
    """The options that are set."""
    return {field.name: _field(message, field) for field, _ in message.ListFields()}


def plain_fields(message: Message) -> dict[str, object]:
    """The fields of a message: those set, and lists even where they are empty."""
    return {
        field.name: _field(message, field)
        for field in message.DESCRIPTOR.fields
        if field.is_repeated or not field.has_presence or message.HasField(field.name)
    }


def _field(message: Message, field: Any) -> object:
    value = getattr(message, field.name)
    if field.is_repeated:
        return list(value) if field.message_type is None else [_plain(part) for part in value]
    return _plain(value)


def _plain(value: Any) -> object:
    if not isinstance(value, Message):
        return value
    return _FORMS.get(type(value), plain_fields)(value)


def _coordinates(message: Message) -> list[float]:
    return [getattr(message, field.name) for field in message.DESCRIPTOR.fields]


def _corners(message: grasp_pb2.HandBox) -> list[object]:
    return [_coordinates(message.min), _coordinates(message.max)]


def _gripper(message: grasp_pb2.GripperChoice) -> object:
    which = message.WhichOneof("choice")
    return None if which is None else _plain(getattr(message, which))


def _tagged(message: Message) -> dict[str, object]:
    """The field of the oneof `kind` that is set, its name beside its fields."""
    which = message.WhichOneof("kind")
    return {} if which is None else {"kind": which} | plain_fields(getattr(message, which))


def _support(message: grasp_pb2.Support) -> dict[str, object]:
    fields = plain_fields(message)
    ransac = fields.pop("ransac", None)
    return fields if ransac is None else {"kind": "ransac"} | fields | ransac  # type: ignore[operator]


def _suppression(message: grasp_pb2.Suppression) -> dict[str, object] | None:
    fields = plain_fields(message)
    return None if fields.pop("disabled") else fields


# What is written in JSON in another way than field by field.
_FORMS: dict[type[Message], Callable[[Any], object]] = {
    grasp_pb2.Vector: _coordinates,
    grasp_pb2.Quaternion: _coordinates,
    grasp_pb2.HandBox: _corners,
    grasp_pb2.GripperChoice: _gripper,
    grasp_pb2.Shape: _tagged,
    grasp_pb2.Obstacle: _tagged,
    grasp_pb2.Support: _support,
    grasp_pb2.Suppression: _suppression,
}
