"""The options of the server's definition, in the client's types and in the messages."""

from typing import Any, get_args

import pytest

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client import options as client_types
from edgegrasp_model.options import DetectOptions

SCHEMA = DetectOptions.model_json_schema()
OBJECTS: dict[str, Any] = {"DetectOptions": SCHEMA, **SCHEMA["$defs"]}
NAMES = {"SupportPlane": "Support", "Linkage": "Swing"}  # of messages that are called otherwise
BESIDE = {"disabled", "auto", "ransac", "object_choice"}  # fields for what JSON has no field for


def words(annotation: object) -> set[object]:
    """The words of the Literals in an annotation."""
    parts = get_args(annotation)
    found = {part for part in parts if isinstance(part, str)}
    return found.union(*(words(part) for part in parts if not isinstance(part, str)))


def words_of(schema: dict[str, Any]) -> set[object]:
    found = {*schema.get("enum", ())} | ({schema["const"]} if "const" in schema else set())
    parts = [part for union in ("anyOf", "oneOf") for part in schema.get(union, ())]
    return found.union(*map(words_of, parts))


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_the_client_and_the_messages_have_the_fields_of_the_server(name: str) -> None:
    fields, message = OBJECTS[name]["properties"], getattr(grasp_pb2, NAMES.get(name, name))
    typed = getattr(client_types, name)
    assert set(typed.__annotations__) == set(fields)
    required = {*OBJECTS[name].get("required", ())}
    required |= {"kind"} & fields.keys() if name != "SupportPlane" else set()
    assert typed.__required_keys__ == required
    for field, schema in fields.items():
        assert words(typed.__annotations__[field]) == words_of(schema), field
    sent = {field.name for field in message.DESCRIPTOR.fields}
    assert sent - BESIDE == set(fields) - {"kind"}
