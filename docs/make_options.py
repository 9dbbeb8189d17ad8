"""Writes docs/options.md from the schemas of both transports: `python docs/make_options.py`."""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.options import DetectOptions

Schema = dict[str, Any]

PAGE = Path(__file__).parent / "options.md"
HEADER = ["option", "in JSON", "in gRPC", "unit", "default", "meaning"]
INTRODUCTION = """\
# Options

What a request may ask for besides its cloud, the same names and defaults on every transport: the
`options` of a JSON body or of a multipart part, query parameters (objects and lists as JSON text),
`DetectOptions` in gRPC, keyword arguments of the Python client, and flags of `edgegrasp detect`.
What is left out takes the default; unknown fields are refused. The same cloud, options and seed
give the same grasps.

Positions and directions are in the cloud's frame, in metres; directions are the way the hand
*moves* ([pictures](frames.md)). A `Vector` is `[x, y, z]` in JSON, a `Quaternion` `[x, y, z, w]`.
Options come first in the table, then the objects they are made of. Where a JSON object has a
`kind`, gRPC has a message with one field for each kind; but a given support plane has its fields
in `Support` itself, where one to look for is the field `ransac`. `"suppression": null` is
`disabled: true` in gRPC; any other `null` is a field left out.

This page is written from the schemas by `python docs/make_options.py`.
"""

# JSON objects that have another name in gRPC.
MESSAGES = {"SupportPlane": "Support"}


def page() -> str:
    """The whole page."""
    rows = [HEADER, ["---"] * len(HEADER), *table()]
    return INTRODUCTION + "\n" + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def table() -> Iterator[list[str]]:
    """Rows of the table: options, then each object in the order in which they first appear."""
    schema = DetectOptions.model_json_schema()
    yield from _rows("", schema, grasp_pb2.DetectOptions.DESCRIPTOR)
    for name in _objects(schema, schema["$defs"]):
        described = schema["$defs"][name]
        message = getattr(grasp_pb2, MESSAGES.get(name, name)).DESCRIPTOR
        yield [f"**{name}**", "object", f"`{message.name}`", "", "", _sentence(described)]
        yield from _rows(f"{name}.", described, message)


def _rows(prefix: str, schema: Schema, message: Descriptor) -> Iterator[list[str]]:
    for name, field in schema["properties"].items():
        if name == "kind":
            yield [f"`{prefix}kind`", f'`"{field["const"]}"`', "the field of that name"] + [""] * 3
            continue
        yield [
            f"`{prefix}{name}`",
            _json_type(field),
            _grpc_type(message.fields_by_name[name]),
            _unit(field),
            _default(name, field, schema),
            _sentence(field),
        ]


def _objects(schema: Schema, definitions: dict[str, Schema]) -> list[str]:
    """Names of the objects that a schema mentions, then of those they mention."""
    found: list[str] = []
    todo = [schema["properties"]]
    while todo:
        for name in re.findall(r'"#/\$defs/(\w+)"', json.dumps(todo.pop(0))):
            if name not in found:
                found.append(name)
                todo.append(definitions[name])
    return found


def _json_type(field: Schema) -> str:
    if "$ref" in field:
        return f"`{field['$ref'].rpartition('/')[2]}`"
    for union in ("anyOf", "oneOf"):
        if union in field:
            return " or ".join(dict.fromkeys(_json_type(part) for part in field[union]))
    if "enum" in field:
        return " or ".join(f'`"{word}"`' for word in field["enum"])
    if field["type"] == "array":
        return _json_list(field)
    return {"null": "null", "boolean": "true or false"}.get(
        field["type"], f"{field['type']}{_range(field)}"
    )


def _json_list(field: Schema) -> str:
    parts = field.get("prefixItems")
    if parts is not None and parts[0]["type"] == "number":
        return {3: "`Vector`", 4: "`Quaternion`"}[len(parts)] + _range(parts[0])
    if parts is not None:
        return f"[{', '.join(_json_type(part) for part in parts)}]"
    low, high = field.get("minItems", 0), field["maxItems"]
    size = f"{low} to {high}" if low else f"up to {high}"
    return f"list of {size}: {_json_type(field['items'])}"


def _range(field: Schema) -> str:
    if field["type"] == "string":
        return f", up to {field['maxLength']} characters" if "maxLength" in field else ""
    low, over = field.get("minimum"), field.get("exclusiveMinimum")
    high, under = field.get("maximum"), field.get("exclusiveMaximum")
    words = [
        *([_number(low)] if low is not None else []),
        *([f"over {_number(over)}"] if over is not None else []),
        *([f"to {_number(high)}"] if high is not None else []),
        *([f"to under {_number(under)}"] if under is not None else []),
    ]
    return f", {' '.join(words)}" if words else ""


def _number(bound: float) -> str:
    if abs(bound) >= 2**31:
        return f"{'-' if bound < 0 else ''}2^{int(abs(bound)).bit_length() - 1}"
    return "π" if math.isclose(bound, math.pi) else f"{bound:g}"


def _grpc_type(field: FieldDescriptor) -> str:
    names = {
        FieldDescriptor.TYPE_BOOL: "bool",
        FieldDescriptor.TYPE_DOUBLE: "double",
        FieldDescriptor.TYPE_INT32: "int32",
        FieldDescriptor.TYPE_INT64: "int64",
        FieldDescriptor.TYPE_STRING: "string",
    }
    name = field.message_type.name if field.message_type is not None else names[field.type]
    return f"`{'repeated ' if field.is_repeated else ''}{name}`"


def _unit(field: Schema) -> str:
    described = json.dumps({**field, "default": None})
    return " ".join(
        unit for word, unit in (("metres", "m"), ("radians", "rad")) if word in described
    )


def _default(name: str, field: Schema, parent: Schema) -> str:
    if name in parent.get("required", ()):
        return "required"
    default = field["default"]
    if isinstance(default, dict):
        return "those of the object"
    return f"`{json.dumps(default)}`"


def _sentence(field: Schema) -> str:
    words: str = field.get("description", "").partition("\n\n")[0].replace("\n", " ")
    return words.replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page())
