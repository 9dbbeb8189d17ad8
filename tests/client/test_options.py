"""The messages have the options of the server's definition, from which all else is generated."""

from typing import Any

import pytest

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.options import DetectOptions

SCHEMA = DetectOptions.model_json_schema()
OBJECTS: dict[str, Any] = {"DetectOptions": SCHEMA, **SCHEMA["$defs"]}
NAMES = {"SupportPlane": "Support", "Linkage": "Swing"}  # of messages that are called otherwise
BESIDE = {"disabled", "auto", "ransac", "object_choice"}  # fields for what JSON has no field for


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_the_messages_have_the_fields_of_the_server(name: str) -> None:
    message = getattr(grasp_pb2, NAMES.get(name, name))
    sent = {field.name for field in message.DESCRIPTOR.fields}
    assert sent - BESIDE == set(OBJECTS[name]["properties"]) - {"kind"}
