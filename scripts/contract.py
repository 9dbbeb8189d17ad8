"""Keep the promises of edgegrasp.v1: compare its descriptors with the committed ones.

proto/edgegrasp/v1/contract.json holds every service, message and enum that was ever promised, as a
FileDescriptorSet in JSON. Additions are written into it; what would break a caller is refused.

usage: scripts/contract.py [FOLDER]    writes edgegrasp/v1/contract.json there, or into proto/
"""

import json
import sys
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, json_format

from edgegrasp.v1 import grasp_pb2

ROOT = Path(__file__).parents[1]
CONTRACT = Path("edgegrasp/v1/contract.json")

File = descriptor_pb2.FileDescriptorProto


def current() -> File:
    """The descriptors of the generated code."""
    return File.FromString(grasp_pb2.DESCRIPTOR.serialized_pb)


def read(path: Path) -> File:
    """The descriptors in a contract."""
    return json_format.Parse(path.read_text(), descriptor_pb2.FileDescriptorSet()).file[0]


def breaks(old: File, new: File) -> list[str]:
    """What of `old` a caller of `new` would miss; empty: compatible, on the wire and in source."""
    before, now = (promises(json_format.MessageToDict(file)) for file in (old, new))
    return [
        f"{name} ({value}) is {f'now {now[name]}' if name in now else 'gone'}"
        for name, value in before.items()
        if now.get(name) != value
    ]


def promises(part: Any, path: str = "") -> dict[str, Any]:
    """Everything that a caller may rely on: each value by its place, where numbers name fields."""
    if isinstance(part, dict) and {"number", "inputType"} & part.keys():  # a field or a method
        return {path: ", ".join(f"{name} {one}" for name, one in part.items() if name != "options")}
    if isinstance(part, dict):
        oneofs = [one["name"] for one in part.get("oneofDecl", ())]
        for field in part.get("field", ()):
            if "oneofIndex" in field:  # of all in the message, which may become more
                field["oneof"] = oneofs[field.pop("oneofIndex")]
        places = part.items()
    elif isinstance(part, list):
        places = {_key(one): one for one in part}.items()
    else:
        return {path: part}
    parts = (promises(one, f"{path}.{name}".lstrip(".")) for name, one in places)
    return {name: value for found in parts for name, value in found.items()}


def _key(part: Any) -> str:
    """What tells a part of a list from the others."""
    named = part if isinstance(part, dict) else {"name": part}
    return str(named.get("number", named.get("name", json.dumps(part))))


def main() -> None:
    """Write the contract, unless that would break a promise."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "proto"
    new, committed = current(), ROOT / "proto" / CONTRACT
    if committed.exists() and (broken := breaks(read(committed), new)):
        sys.exit("\n".join(["edgegrasp.v1 would break its callers; a change goes to v2:", *broken]))
    (folder / CONTRACT).parent.mkdir(parents=True, exist_ok=True)
    text = json_format.MessageToJson(descriptor_pb2.FileDescriptorSet(file=[new]))
    (folder / CONTRACT).write_text(text + "\n")


if __name__ == "__main__":
    main()
