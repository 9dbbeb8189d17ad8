"""Keep the promises of edgegrasp.v1: compare its descriptors with the committed ones.

proto/edgegrasp/v1/contract.json holds every service, message and enum that was ever promised, as a
FileDescriptorSet in JSON. Additions are written into it; what would break a caller is refused.

usage: scripts/contract.py [FOLDER]    writes edgegrasp/v1/contract.json there, or into proto/
"""

import sys
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, json_format

ROOT = Path(__file__).parents[1]
CONTRACT = Path("edgegrasp/v1/contract.json")

File = descriptor_pb2.FileDescriptorProto
Message = descriptor_pb2.DescriptorProto


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
    now = promises(new)
    return [
        f"{name} ({said}) is {f'now {now[name]}' if name in now else 'gone'}"
        for name, said in promises(old).items()
        if now.get(name) != said
    ]


def promises(file: File) -> dict[str, str]:
    """Everything that a caller may rely on, by its name or number; each in words."""
    found = {"package": file.package, "syntax": file.syntax}
    for service in file.service:
        for method in service.method:
            found[f"rpc {service.name}.{method.name}"] = _said(method)
    for enum in file.enum_type:
        found |= _of_enum(enum.name, enum)
    for message in file.message_type:
        found |= _of_message(message.name, message)
    return found


def _of_message(name: str, message: Message) -> dict[str, str]:
    found = {f"message {name}": ""}
    for field in message.field:
        # The oneof of an `optional` field is made up.
        is_choice = field.HasField("oneof_index") and not field.proto3_optional
        oneof = f", in oneof {message.oneof_decl[field.oneof_index].name}" if is_choice else ""
        found[f"{name} = {field.number}"] = _said(field) + oneof
    for numbers in message.reserved_range:
        found |= {f"{name} reserves {n}": "" for n in range(numbers.start, numbers.end)}
    found |= {f"{name} reserves {word}": "" for word in message.reserved_name}
    for inner in message.nested_type:
        found |= _of_message(f"{name}.{inner.name}", inner)
    for enum in message.enum_type:
        found |= _of_enum(f"{name}.{enum.name}", enum)
    return found


def _of_enum(name: str, enum: Any) -> dict[str, str]:
    values = {f"{name}.{value.name}": f"= {value.number}" for value in enum.value}
    return {f"enum {name}": ""} | values


def _said(part: Any) -> str:
    """The properties of a field or method, except its number and options."""
    properties = ((field.name, value) for field, value in part.ListFields())
    skipped = ("number", "oneof_index", "options")
    return ", ".join(f"{name} {value}" for name, value in properties if name not in skipped)


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
