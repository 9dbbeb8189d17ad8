"""Writes the tables of docs/options.md and docs/settings.md: `python docs/make_tables.py`."""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edgegrasp_model.options import FARTHEST, DetectOptions
from edgegrasp_service.settings import Settings

Schema = dict[str, Any]
Rows = Iterator[list[str]]

BLOCK = re.compile(r"(<!-- begin: table -->\n).*?(<!-- end -->)", re.DOTALL)
BOUNDS = (
    ("minimum", ""),
    ("exclusiveMinimum", "over "),
    ("maximum", "to "),
    ("exclusiveMaximum", "to under "),
)
NAMES = {-(2**31): "-2^31", 2**30: "2^30", 2**31: "2^31", 2**63: "2^63", math.pi: "π"}  # of numbers


def pages() -> dict[Path, str]:
    """The text of each page with its table."""
    folder = Path(__file__).parent
    made = {folder / "options.md": _options(), folder / "settings.md": _settings()}
    return {page: _with_table(page.read_text(), *rows) for page, rows in made.items()}


def _with_table(text: str, header: list[str], *rows: list[str]) -> str:
    lines = (f"| {' | '.join(row)} |\n" for row in (header, ["---"] * 4, *rows))
    return BLOCK.sub(lambda match: f"{match[1]}\n{''.join(lines)}\n{match[2]}", text)


def _options() -> Rows:
    """Options, then each object that they are made of."""
    yield ["option", "value", "default", "meaning"]
    schema = DetectOptions.model_json_schema()
    names = ["DetectOptions"]
    for name in names:  # which grows by the objects in each
        part = schema["$defs"].get(name, schema)
        fields = dict(part["properties"])
        named = dict.fromkeys(re.findall(r'"#/\$defs/(\w+)"', json.dumps(fields)))
        names += [one for one in named if one not in names]
        prefix = "" if part is schema else f"{name}."
        if prefix:
            tag = fields.pop("kind", None)
            shown = "object" if tag is None else f'object, `"kind": "{tag["const"]}"`'
            yield [f"**{name}**", shown, "", _text(part)]
        required = part.get("required", ())
        for field, value in fields.items():
            default = "required" if field in required else _default(value["default"])
            yield [f"`{prefix}{field}`", _kind(value), default, _text(value)]


def _settings() -> Rows:
    yield ["setting", "value", "default", "meaning"]
    for name, field in Settings.model_json_schema()["properties"].items():
        default = field.get("default")
        shown = "none" if default in (None, [], "") else f"`{json.dumps(default)}`"
        yield [f"`{name}`", _kind(field), shown, _text(field)]


def _default(value: Any) -> str:
    if isinstance(value, dict):
        return f'`"{value["kind"]}"`' if value.keys() == {"kind"} else "its defaults"
    return f"`{json.dumps(value)}`"


def _text(schema: Schema) -> str:
    first = schema.get("description", "").partition("\n\n")[0]
    return str(first).replace("\n", " ").replace("|", "\\|")


def _kind(schema: Schema) -> str:
    """What a value may be."""
    if "$ref" in schema:
        return f"`{schema['$ref'].rpartition('/')[2]}`"
    for union in ("anyOf", "oneOf"):
        if union in schema:
            return " or ".join(dict.fromkeys(_kind(part) for part in schema[union]))
    if "enum" in schema or "const" in schema:
        return " or ".join(f'`"{word}"`' for word in schema.get("enum", [schema.get("const")]))
    if schema["type"] == "array":
        return _list(schema)
    names = {"null": "null", "boolean": "true or false"}
    return names.get(schema["type"], f"{schema['type']}{_range(schema)}")


def _list(schema: Schema) -> str:
    parts = schema.get("prefixItems")
    if parts is not None and all(part.get("type") == "number" for part in parts):
        kind = {2: "Pixel", 3: "Vector", 4: "Quaternion"}[len(parts)]
        return f"`{kind}`{_range(parts[0])}"
    if parts is not None:
        return f"[{', '.join(map(_kind, parts))}]"
    low, high = schema.get("minItems", 0), schema.get("maxItems")
    bounds = f"{high}" if low == high else f"{low} to {high}" if low else f"up to {high}"
    size = "" if high is None else f" of {bounds}"
    return f"list{size}: {_kind(schema['items'])}"


def _range(schema: Schema) -> str:
    if schema["type"] == "string":
        return f", up to {schema['maxLength']} characters" if "maxLength" in schema else ""
    held = {bound: word for bound, word in BOUNDS if abs(schema.get(bound, FARTHEST)) != FARTHEST}
    words = [f"{word}{_number(schema[bound])}" for bound, word in held.items()]
    words += ["and more"] if held and not any("axi" in bound for bound in held) else []
    return f", {' '.join(words)}" if words else ""


def _number(bound: float) -> str:
    return NAMES.get(bound, str(int(bound)) if float(bound).is_integer() else f"{bound:g}")


if __name__ == "__main__":
    for page, text in pages().items():
        page.write_text(text)
