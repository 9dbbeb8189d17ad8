"""Write what follows from the options of a request, whose one definition is DetectOptions.

That are the messages of options in grasp.proto, between the marks; the types of the client's
keyword arguments; and the table in docs/options.md. A field keeps the number that contract.json
has for it, and a new one gets the next that is free.

usage: scripts/generate_options.py [FOLDER]    writes them there, or where they are committed
"""

import json
import math
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edgegrasp_model.options import FARTHEST, DetectOptions

Schema = dict[str, Any]

ROOT = Path(__file__).parents[1]
PROTO = Path("proto/edgegrasp/v1/grasp.proto")
CONTRACT = Path("proto/edgegrasp/v1/contract.json")
CLIENT = Path("clients/edgegrasp_client/options.py")
PAGE = Path("docs/options.md")
BEGIN, END = "// generated: begin options\n", "// generated: end options\n"

# Objects whose message has another name, and the messages of what is no object.
MESSAGES = {"SupportPlane": "Support", "Linkage": "Swing"}
CHOICES = {"GripperGeometry": "GripperChoice"}  # a name, or the object
UNIONS = {"include": "Shape", "exclude": "Shape", "obstacles": "Obstacle"}  # lists of kinds
PLAIN_KIND = "SupportPlane"  # what an object without a `kind` is
WORDS = {"objects": "object_choice"}  # a word, or an object that has this field of its own in gRPC


def main() -> None:
    """Write the three files."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT
    for path, text in ((PROTO, proto()), (CLIENT, client_types()), (PAGE, page())):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)


def objects(schema: Schema) -> dict[str, Schema]:
    """DetectOptions and the objects it is made of, each before those that it mentions."""
    definitions, found = schema["$defs"], {"DetectOptions": schema}
    todo = [schema]
    while todo:
        for name in re.findall(r'"#/\$defs/(\w+)"', json.dumps(todo.pop(0)["properties"])):
            if name not in found:
                found[name] = definitions[name]
                todo.append(definitions[name])
    return found


def alternatives(schema: Schema) -> list[Schema]:
    """What a value may be, but null."""
    for union in ("anyOf", "oneOf"):
        if union in schema:
            return [one for part in schema[union] for one in alternatives(part)]
    return [] if schema.get("type") == "null" else [schema]


def name_of(schema: Schema) -> str:
    """The object that a schema refers to; empty for anything else."""
    return str(schema.get("$ref", "")).rpartition("/")[2]


def union_of(field: str, schema: Schema) -> str:
    """The message of a list's objects, which have kinds; empty where they have none."""
    kinds = alternatives(schema.get("items", {}))
    return UNIONS.get(field, "") if all(map(name_of, kinds)) else ""


def is_vector(schema: Schema) -> bool:
    """Whether a schema is a list of numbers with a length of its own."""
    parts = schema.get("prefixItems", [{}])
    return all(part.get("type") == "number" for part in parts)


# grasp.proto


def proto() -> str:
    """The whole file, its option messages written anew."""
    before, _, rest = (ROOT / PROTO).read_text().partition(BEGIN)
    _, mark, after = rest.partition(END)
    if not mark:
        sys.exit(f"{PROTO}: the marks {BEGIN.strip()!r} and {END.strip()!r} are gone")
    schema = DetectOptions.model_json_schema()
    messages = [_message(name, part, schema) for name, part in objects(schema).items()]
    messages += [_oneof(union, schema) for union in dict.fromkeys(UNIONS.values())]
    return before + BEGIN + "\n" + "\n".join(messages) + "\n" + END + after


def _message(name: str, schema: Schema, options: Schema) -> str:
    """A message with the fields of an object."""
    fields = {
        field: (part.get("description", ""), part, _label(part) + _proto_type(field, part))
        for field, part in schema["properties"].items()
        if field != "kind"
    }
    for field in WORDS.keys() & fields.keys():
        _, part, kind = fields[field]
        word, chosen = alternatives(part)
        fields[field] = (fields[field][0], word, "optional string")
        fields[WORDS[field]] = (f"`{field}` where it is an object in JSON", {}, name_of(chosen))
    if name == PLAIN_KIND:  # objects of the other kinds are fields of its message
        kinds = alternatives(options["properties"]["support"])
        for one in [kind for kind in kinds if name_of(kind) not in ("", PLAIN_KIND)]:
            other = options["$defs"][name_of(one)]
            word = other["properties"]["kind"]["const"]
            text = f'{_first_paragraph(other)} `kind` is "{word}" in JSON, its fields beside it'
            fields[word] = (text, {}, name_of(one))
    if _null_is_a_value(name, options):
        fields["disabled"] = ("true: null in JSON", {}, "bool")
    numbers = _Numbers(MESSAGES.get(name, name))
    lines = [*_comment(_first_paragraph(schema), ""), f"message {numbers.message} {{"]
    lines += [f"  reserved {numbers.reserved};", ""] if numbers.reserved else []
    for field, (description, part, kind) in fields.items():
        lines += _comment(_said_in_proto(description, part), "  ")
        lines.append(f"  {kind} {field} = {numbers.of(field)};")
    return "\n".join([*lines, "}", ""])


def _said_in_proto(description: str, schema: Schema) -> str:
    """What a field means, where there is no null and words have no type of their own."""
    kinds = alternatives(schema)
    words = [f'"{word}"' for one in kinds for word in one.get("enum", ())]
    if words and not any(map(name_of, kinds)):
        description += f". One of {', '.join(words)}"
    null_is_a_value = schema.get("default") is not None
    return re.sub(r"\bnull:", "disabled:" if null_is_a_value else "absent:", description)


def _null_is_a_value(name: str, options: Schema) -> bool:
    """Whether null instead of an object says something else than nothing does."""
    return any(
        {"type": "null"} in field.get("anyOf", ()) and field["default"] is not None
        for field in options["properties"].values()
        if name == next(filter(None, map(name_of, alternatives(field))), "")
    )


def _oneof(union: str, options: Schema) -> str:
    """A message of which one field is set, for objects distinguished by their kind."""
    places = [
        part
        for owner in options["$defs"].values()
        for field, part in owner["properties"].items()
        if union_of(field, part) == union
    ]
    numbers = _Numbers(union)
    lines = ["// In JSON `kind` is the name of the field set here, its fields beside it."]
    lines += [f"message {union} {{", "  oneof kind {"]
    for one in alternatives(places[0]["items"]):
        kind = options["$defs"][name_of(one)]["properties"]["kind"]["const"]
        lines.append(f"    {name_of(one)} {kind} = {numbers.of(kind)};")
    return "\n".join([*lines, "  }", "}", ""])


class _Numbers:
    """Field numbers of a message: those of the contract, then those that no field ever had."""

    def __init__(self, message: str) -> None:
        file = json.loads((ROOT / CONTRACT).read_text())["file"][0]
        known: Any = next((one for one in file["messageType"] if one["name"] == message), {})
        self.message = message
        self._known: dict[str, int] = {
            field["name"]: field["number"] for field in known.get("field", ())
        }
        ranges = known.get("reservedRange", ())
        held = [number for one in ranges for number in range(one["start"], one["end"])]
        self.reserved = ", ".join(map(str, held))
        self._last = max([*self._known.values(), *held], default=0)

    def of(self, field: str) -> int:
        if field not in self._known:
            self._last += 1
            self._known[field] = self._last
        return self._known[field]


def _label(schema: Schema) -> str:
    """`repeated`; `optional` for scalars, whose presence matters; nothing for messages."""
    kinds = alternatives(schema)
    if any(one.get("type") == "array" and not is_vector(one) for one in kinds):
        return "repeated "
    scalar = all(one.get("type") in ("string", "integer", "number", "boolean") for one in kinds)
    return "optional " if scalar else ""


def _proto_type(name: str, schema: Schema) -> str:
    """The type of a field, or of its items."""
    kinds = alternatives(schema)
    last = kinds[-1]
    if union_of(name, schema):
        return union_of(name, schema)
    if len(kinds) > 1 and name_of(last):
        if kinds[0].get("type") == "string" and "enum" not in kinds[0]:
            return CHOICES[name_of(last)]
        refers = next(one for one in kinds if name_of(one))
        return MESSAGES.get(name_of(refers), name_of(refers))
    if name_of(last):
        return MESSAGES.get(name_of(last), name_of(last))
    if last.get("type") == "array":
        if "prefixItems" not in last:
            return _proto_type("", last["items"])
        if not is_vector(last):
            return "HandBox"
        return {2: "Pixel", 3: "Vector", 4: "Quaternion"}[len(last["prefixItems"])]
    if last["type"] == "integer":
        high = last.get("maximum", 0) or last.get("exclusiveMaximum", 0)
        return "int64" if high > 2**31 else "int32"
    return {"string": "string", "number": "double", "boolean": "bool"}[last["type"]]


def _comment(text: str, indent: str) -> list[str]:
    prefix = f"{indent}// "
    starts_with_a_word = re.match(r"[a-z]{2,}", text) is not None
    text = (text[:1].upper() + text[1:] if starts_with_a_word else text).rstrip(".") + "."
    return textwrap.wrap(text, 100, initial_indent=prefix, subsequent_indent=prefix)


def _first_paragraph(schema: Schema) -> str:
    words: str = schema.get("description", "").partition("\n\n")[0].replace("\n", " ")
    return words


# The client's types

CLIENT_HEADER = '''\
"""Options of a request; what is left out, or None, takes the server's default.

Generated from the server's own definition by `make proto`; do not edit.
"""

from collections.abc import Sequence
from typing import Any, Literal

from numpy.typing import NDArray
from typing_extensions import NotRequired, TypedDict

Vector = Sequence[float] | NDArray[Any]  # x, y, z in the cloud's frame
'''


def client_types() -> str:
    """The module of the client's TypedDicts, each after those that it mentions."""
    schema = DetectOptions.model_json_schema()
    parts = objects(schema)
    written: dict[str, str] = {}

    def write(name: str) -> None:
        if name in written:
            return
        for other in re.findall(r'"#/\$defs/(\w+)"', json.dumps(parts[name]["properties"])):
            write(other)
        aliases = {
            union_of(field, part): [name_of(one) for one in alternatives(part["items"])]
            for field, part in parts[name]["properties"].items()
            if union_of(field, part)
        }
        for alias, names in aliases.items():
            written[alias] = f"{alias} = {' | '.join(names)}\n"
        written[name] = _typed_dict(name, parts[name])

    write("DetectOptions")
    return "\n\n".join([CLIENT_HEADER, *written.values()])


def _typed_dict(name: str, schema: Schema) -> str:
    required = {*schema.get("required", ()), *({"kind"} if name != PLAIN_KIND else ())}
    required &= schema["properties"].keys()
    total = "" if required else ", total=False"
    lines = [*textwrap.wrap(f'"""{_first_paragraph(schema)}"""', 96), ""]
    for field, part in schema["properties"].items():
        kind = _python_type(field, part)
        if required and field not in required:
            kind = f"NotRequired[{kind}]"
        said = re.sub(r"\bnull:", "None:", part.get("description", ""))
        lines += textwrap.wrap(said, 96, initial_indent="# ", subsequent_indent="# ")
        lines.append(f"{field}: {kind}")
    return f"class {name}(TypedDict{total}):\n{textwrap.indent(chr(10).join(lines), '    ')}\n"


def _python_type(name: str, schema: Schema) -> str:
    nullable = any(one.get("type") == "null" for one in schema.get("anyOf", ()))
    if union_of(name, schema):
        return f"Sequence[{union_of(name, schema)}]"
    packed = "contentEncoding"  # text in JSON, where Python has arrays
    parts = [one for one in alternatives(schema) if packed not in one]
    kinds = list(dict.fromkeys(map(_one_python_type, parts)))
    return " | ".join([*kinds, "None"] if nullable else kinds)


def _one_python_type(schema: Schema) -> str:
    if name_of(schema):
        return name_of(schema)
    if "enum" in schema or "const" in schema:
        words = schema.get("enum", [schema.get("const")])
        return f"Literal[{', '.join(json.dumps(word) for word in words)}]"
    if schema["type"] == "array":
        if "prefixItems" in schema:
            return "Vector" if is_vector(schema) else "Sequence[Vector]"
        items = _python_type("", schema["items"])
        arrays = " | NDArray[Any]" if items in ("int", "bool") else ""
        return f"Sequence[{items}]{arrays}"
    return {"string": "str", "integer": "int", "number": "float", "boolean": "bool"}[schema["type"]]


# docs/options.md

HEADER = ["option", "in JSON", "in gRPC", "default", "meaning"]
INTRODUCTION = """\
# Options

What a request may ask for besides its cloud, the same names and defaults on every transport: the
`options` of a JSON body or of a multipart part, query parameters (objects and lists as JSON text),
`DetectOptions` in gRPC, keyword arguments of the Python client, and flags of `edgegrasp detect`.
What is left out takes the default; unknown fields are refused. The same cloud, options and seed
give the same grasps.

Positions and directions are in the cloud's frame, in metres, within 10,000 km of its origin;
directions are the way the hand *moves* ([pictures](frames.md)). A `Vector` is `[x, y, z]` in JSON,
a `Quaternion` `[x, y, z, w]`, a `Pixel` `[column, row]`. Options come first in the table, then the
objects they are made of.
Where a JSON object has a `kind`, gRPC has a message with one field for each kind; but a given
support plane has its fields in `Support` itself, where one to look for is the field `auto` or
`ransac`.
`"suppression": null` and `"support": null` are `disabled: true` in gRPC; any other `null` is a
field left out.

This page is generated from the server's own definition by `make proto`.
"""


def page() -> str:
    """The whole page."""
    rows = [HEADER, ["---"] * len(HEADER), *_table()]
    return INTRODUCTION + "\n" + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _table() -> Iterator[list[str]]:
    """Rows of the table: options, then each object."""
    for name, schema in objects(DetectOptions.model_json_schema()).items():
        prefix = "" if name == "DetectOptions" else f"{name}."
        if prefix:
            message = MESSAGES.get(name, name)
            yield [f"**{name}**", "object", f"`{message}`", "", _cell(schema)]
        for field, part in schema["properties"].items():
            if field == "kind":
                kind = f'`"{part["const"]}"`'
                yield [f"`{prefix}kind`", kind, "the field of that name", "", ""]
                continue
            repeated = "repeated " if _label(part) == "repeated " else ""
            kind = _proto_type(field, part)
            in_proto = f"`{repeated}{kind}`"
            if field in WORDS:
                in_proto = f"`string`, or `{kind} {WORDS[field]}`"
            yield [
                f"`{prefix}{field}`",
                _json_type(part),
                in_proto,
                _default(field, part, schema),
                _cell(part),
            ]


def _json_type(field: Schema) -> str:
    if name_of(field):
        return f"`{name_of(field)}`"
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
    if "prefixItems" in field:
        parts = field["prefixItems"]
        if is_vector(field):
            kind = {2: "Pixel", 3: "Vector", 4: "Quaternion"}[len(parts)]
            return f"`{kind}`{_range(parts[0])}"
        return f"[{', '.join(_json_type(part) for part in parts)}]"
    low, high = field.get("minItems", 0), field["maxItems"]
    size = f"{low} to {high}" if low else f"up to {high}"
    return f"list of {size}: {_json_type(field['items'])}"


def _range(field: Schema) -> str:
    if field["type"] == "string":
        return f", up to {field['maxLength']} characters" if "maxLength" in field else ""
    words = [
        f"{word}{_number(field[bound])}"
        for bound, word in (
            ("minimum", ""),
            ("exclusiveMinimum", "over "),
            ("maximum", "to "),
            ("exclusiveMaximum", "to under "),
        )
        if bound in field and abs(field[bound]) != FARTHEST
    ]
    return f", {' '.join(words)}" if words else ""


def _number(bound: float) -> str:
    if abs(bound) >= 2**31:
        return f"{'-' if bound < 0 else ''}2^{int(abs(bound)).bit_length() - 1}"
    return "π" if math.isclose(bound, math.pi) else f"{bound:g}"


def _default(name: str, field: Schema, parent: Schema) -> str:
    if name in parent.get("required", ()):
        return "required"
    if isinstance(field["default"], dict):
        only = field["default"].get("kind") if len(field["default"]) == 1 else None
        return f'`"{only}"`' if only else "those of the object"
    return f"`{json.dumps(field['default'])}`"


def _cell(schema: Schema) -> str:
    return _first_paragraph(schema).replace("|", "\\|")


if __name__ == "__main__":
    main()
