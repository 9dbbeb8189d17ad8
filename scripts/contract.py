"""Keep the promises of edgegrasp.v1: compare its descriptors with the committed ones.

proto/edgegrasp/v1/contract.json holds every service, message and enum that was ever promised, as a
FileDescriptorSet in JSON. Additions are written into it; what would break a caller is refused.

usage: scripts/contract.py [FOLDER]    writes edgegrasp/v1/contract.json there, or into proto/
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, json_format

ROOT = Path(__file__).parents[1]
CONTRACT = Path("edgegrasp/v1/contract.json")

File = descriptor_pb2.FileDescriptorProto
Message = descriptor_pb2.DescriptorProto
Field = descriptor_pb2.FieldDescriptorProto


def current() -> File:
    """The descriptors of the generated code."""
    from edgegrasp.v1 import grasp_pb2

    file = File()
    grasp_pb2.DESCRIPTOR.CopyToProto(file)
    return file


def read(path: Path) -> File:
    """The descriptors in a contract."""
    return json_format.Parse(path.read_text(), descriptor_pb2.FileDescriptorSet()).file[0]


def text(file: File) -> str:
    """A contract, in an order that shows additions as added lines."""
    return json_format.MessageToJson(descriptor_pb2.FileDescriptorSet(file=[file])) + "\n"


def breaks(old: File, new: File) -> list[str]:
    """What of `old` a caller of `new` would miss; empty: compatible, on the wire and in source."""
    return list(_breaks(old, new))


def _breaks(old: File, new: File) -> Iterator[str]:
    if old.package != new.package:
        yield f"package {old.package} is now {new.package}"
    if old.syntax != new.syntax:
        yield f"syntax {old.syntax} is now {new.syntax}"
    for service, now in _pairs(old.service, new.service):
        if now is None:
            yield f"service {service.name} is gone"
        else:
            yield from _of_service(service, now)
    for message, now in _pairs(old.message_type, new.message_type):
        yield from _of_message(message.name, message, now)
    for enum, now in _pairs(old.enum_type, new.enum_type):
        yield from _of_enum(enum.name, enum, now)


def _of_service(old: Any, new: Any) -> Iterator[str]:
    for method, now in _pairs(old.method, new.method):
        name = f"rpc {old.name}.{method.name}"
        if now is None:
            yield f"{name} is gone"
            continue
        for part in ("input_type", "output_type", "client_streaming", "server_streaming"):
            before, after = getattr(method, part), getattr(now, part)
            if before != after:
                yield f"{name}: {part} {before} is now {after}"


def _of_message(name: str, old: Message, new: Message | None) -> Iterator[str]:
    if new is None:
        yield f"message {name} is gone"
        return
    by_number = {field.number: field for field in new.field}
    for field in old.field:
        yield from _of_field(name, (old, field), (new, by_number.get(field.number)))
    for numbers in old.reserved_range:
        still = new.reserved_range
        if not any(now.start <= numbers.start and numbers.end <= now.end for now in still):
            yield f"{name}: {numbers.start} to {numbers.end - 1} is no longer reserved"
    for word in old.reserved_name:
        if word not in new.reserved_name:
            yield f"{name}: {word!r} is no longer reserved"
    for inner, now in _pairs(old.nested_type, new.nested_type):
        yield from _of_message(f"{name}.{inner.name}", inner, now)
    for enum, now in _pairs(old.enum_type, new.enum_type):
        yield from _of_enum(f"{name}.{enum.name}", enum, now)


def _of_field(
    message: str, old: tuple[Message, Field], new: tuple[Message, Field | None]
) -> Iterator[str]:
    field, now = old[1], new[1]
    name = f"{message}.{field.name} = {field.number}"
    if now is None:
        yield f"{name} is gone"
        return
    for part in ("name", "json_name", "type", "type_name", "label", "proto3_optional"):
        before, after = getattr(field, part), getattr(now, part)
        if before != after:
            yield f"{name}: {part} {before!r} is now {after!r}"
    before, after = _oneof(*old), _oneof(new[0], now)
    if before != after:
        yield f"{name}: oneof {before!r} is now {after!r}"


def _of_enum(name: str, old: Any, new: Any) -> Iterator[str]:
    if new is None:
        yield f"enum {name} is gone"
        return
    numbers = {value.name: value.number for value in new.value}
    for value in old.value:
        if value.name not in numbers:
            yield f"{name}.{value.name} is gone"
        elif numbers[value.name] != value.number:
            yield f"{name}.{value.name} = {value.number} is now {numbers[value.name]}"


def _oneof(message: Message, field: Field) -> str:
    """The oneof a field is in; none for `optional`, whose oneof is made up."""
    if not field.HasField("oneof_index") or field.proto3_optional:
        return ""
    return message.oneof_decl[field.oneof_index].name


def _pairs(old: Any, new: Any) -> Iterator[tuple[Any, Any]]:
    """What was there, and what bears its name now."""
    by_name = {one.name: one for one in new}
    return ((one, by_name.get(one.name)) for one in old)


def main() -> None:
    """Write the contract, unless that would break a promise."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "proto"
    new, committed = current(), ROOT / "proto" / CONTRACT
    if committed.exists() and (broken := breaks(read(committed), new)):
        sys.exit("\n".join(["edgegrasp.v1 would break its callers; a change goes to v2:", *broken]))
    (folder / CONTRACT).parent.mkdir(parents=True, exist_ok=True)
    (folder / CONTRACT).write_text(text(new))


if __name__ == "__main__":
    main()
