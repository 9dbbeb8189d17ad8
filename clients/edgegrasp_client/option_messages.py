"""Options as protobuf messages."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from google.protobuf.message import Message

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.errors import invalid


def fill(message: Message, fields: object, path: str) -> None:
    """Set a message's fields to plain values, as the same fields are written in JSON.

    Raises:
        InvalidRequestError: The message cannot hold a value; whether it suits is the server's
            part.
    """
    if (form := _FORMS.get(type(message))) is not None:
        form(message, fields, path)
    else:
        _fill_fields(message, fields, path)


def _fill_fields(message: Message, fields: object, path: str) -> None:
    if not isinstance(fields, Mapping):
        raise invalid(path, repr(fields)[:80], f"Give a mapping with {_known(message)}.")
    message.SetInParent()
    for name, value in fields.items():
        field = message.DESCRIPTOR.fields_by_name.get(name)
        here = f"{path}.{name}"
        if field is None:
            raise invalid(here, "an unknown field", f"Give {_known(message)} only.")
        if isinstance(message, grasp_pb2.DetectOptions) and name == "viewpoint":
            value = _viewpoints(value)
        if field.is_repeated:
            _extend(getattr(message, name), value, here, field.message_type is not None)
        elif field.message_type is not None:
            fill(getattr(message, name), value, here)
        else:
            _set(message, name, value, here)


def _extend(container: Any, values: object, path: str, messages: bool) -> None:
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise invalid(path, repr(values)[:80], "Give a list.")
    if messages:
        for row, value in enumerate(values):
            fill(container.add(), value, f"{path}.{row}")
        return
    try:
        container.extend(values)
    except (TypeError, ValueError) as error:
        raise invalid(path, repr(values)[:80], f"{error}.") from None


def _viewpoints(value: object) -> object:
    """A list of vectors, of one too."""
    several = isinstance(value, list) and bool(value) and isinstance(value[0], list)
    return value if several else [value]


def _coordinates(message: Message, value: object, path: str) -> None:
    names = [field.name for field in message.DESCRIPTOR.fields]
    if not isinstance(value, Sequence) or len(value) != len(names):
        count = {3: "three", 4: "four"}[len(names)]
        raise invalid(path, repr(value)[:80], f"Give {count} numbers: {', '.join(names)}.")
    _fill_fields(message, dict(zip(names, value, strict=True)), path)


def _corners(message: Message, value: object, path: str) -> None:
    if not isinstance(value, Sequence) or len(value) != 2:
        raise invalid(path, repr(value)[:80], "Give two corners: [min, max].")
    _fill_fields(message, {"min": value[0], "max": value[1]}, path)


def _gripper(message: Message, value: object, path: str) -> None:
    assert isinstance(message, grasp_pb2.GripperChoice)
    if isinstance(value, str):
        message.name = value
    else:
        fill(message.geometry, value, path)


def _tagged(message: Message, value: object, path: str) -> None:
    kinds = [field.name for field in message.DESCRIPTOR.fields]
    if not isinstance(value, Mapping) or value.get("kind") not in kinds:
        kind = repr(value.get("kind") if isinstance(value, Mapping) else value)[:80]
        raise invalid(path, kind, f"Set its kind to one of {', '.join(kinds)}.")
    fields = {name: part for name, part in value.items() if name != "kind"}
    fill(getattr(message, value["kind"]), fields, path)


def _support(message: Message, value: object, path: str) -> None:
    assert isinstance(message, grasp_pb2.Support)
    if not isinstance(value, Mapping):
        raise invalid(path, repr(value)[:80], "Give a mapping with normal and offset.")
    fields = {name: part for name, part in value.items() if name != "kind"}
    kind = value.get("kind", "plane")
    if kind == "ransac":
        fill(message.ransac, fields, path)
    elif kind == "plane" and "ransac" not in fields:
        _fill_fields(message, fields, path)
    else:
        raise invalid(path, repr(kind)[:80], "Set its kind to one of plane, ransac.")


def _suppression(message: Message, value: object, path: str) -> None:
    assert isinstance(message, grasp_pb2.Suppression)
    if value is None:
        message.disabled = True
    else:
        _fill_fields(message, value, path)


def _collision(message: Message, value: object, path: str) -> None:
    _fill_fields(message, {"mode": value} if isinstance(value, str) else value, path)


# What is written in JSON in another way than field by field.
_FORMS: dict[type[Message], Callable[[Message, object, str], None]] = {
    grasp_pb2.Vector: _coordinates,
    grasp_pb2.Quaternion: _coordinates,
    grasp_pb2.HandBox: _corners,
    grasp_pb2.GripperChoice: _gripper,
    grasp_pb2.Shape: _tagged,
    grasp_pb2.Obstacle: _tagged,
    grasp_pb2.Support: _support,
    grasp_pb2.Suppression: _suppression,
    grasp_pb2.Collision: _collision,
}


def _set(message: Message, name: str, value: object, path: str) -> None:
    try:
        setattr(message, name, value)
    except (TypeError, ValueError) as error:
        raise invalid(path, repr(value)[:80], f"{error}.") from None


def _known(message: Message) -> str:
    return ", ".join(
        field.name for field in message.DESCRIPTOR.fields if field.name not in _INTERNAL
    )


_INTERNAL = ("disabled", "ransac")  # how messages say what JSON says in another way
