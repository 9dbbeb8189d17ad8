"""docs/options.md says of every option what both transports' schemas say."""

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.options import DetectOptions as ClientOptions
from edgegrasp_model import directions, gripper, options, regions, support
from edgegrasp_model.options import DetectOptions

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "options.md").read_text()
LINES = [line[2:-2].split(" | ") for line in PAGE.splitlines() if line.startswith("| ")]
ROWS = {cells[0].strip("*`"): cells[1:] for cells in LINES[2:]}
OBJECTS = [name for name in ROWS if "." not in name and name[0].isupper()]

# JSON and gRPC tell kinds apart in different ways; every other field has one name.
ONLY_JSON = {"kind"}
ONLY_GRPC = {"disabled", "ransac"}


def model_of(name: str) -> type[BaseModel]:
    for module in (options, gripper, regions, directions, support):
        if hasattr(module, name):
            found: type[BaseModel] = getattr(module, name)
            return found
    raise LookupError(name)


def message_of(name: str) -> Any:
    return getattr(grasp_pb2, {"SupportPlane": "Support"}.get(name, name)).DESCRIPTOR


def fields_in_table(owner: str) -> dict[str, list[str]]:
    if not owner:
        return {name: cells for name, cells in ROWS.items() if "." not in name and name.islower()}
    prefix = f"{owner}."
    return {name.removeprefix(prefix): ROWS[name] for name in ROWS if name.startswith(prefix)}


OWNERS = ["", *OBJECTS]


def test_the_page_is_as_its_script_writes_it() -> None:
    spec = importlib.util.spec_from_file_location("make_options", DOCS / "make_options.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.page() == PAGE, "run: python docs/make_options.py"


def test_the_columns_are_those_that_were_asked_for() -> None:
    assert LINES[0] == ["option", "in JSON", "in gRPC", "unit", "default", "meaning"]
    assert all(len(cells) == 6 for cells in LINES)


def test_every_option_is_in_the_table_and_in_the_same_order_everywhere() -> None:
    named = list(fields_in_table(""))
    assert named == list(DetectOptions.model_fields)
    assert named == [field.name for field in grasp_pb2.DetectOptions.DESCRIPTOR.fields]
    assert set(named) == set(ClientOptions.__annotations__)


def test_every_object_that_options_are_made_of_is_in_the_table() -> None:
    schema = json.dumps(DetectOptions.model_json_schema())
    assert set(re.findall(r"#/\$defs/(\w+)", schema)) == set(OBJECTS)


@pytest.mark.parametrize("owner", OWNERS)
def test_names_and_defaults_are_those_of_the_json_schema(owner: str) -> None:
    model = model_of(owner or "DetectOptions")
    rows = fields_in_table(owner)
    assert list(rows) == list(model.model_fields)
    for name, field in model.model_fields.items():
        default = rows[name][3]
        if name in ONLY_JSON:
            assert rows[name][0] == f'`"{field.default}"`'
        elif field.default is PydanticUndefined:
            assert default == "required"
        elif isinstance(field.default, BaseModel):
            assert default == "those of the object"
            assert field.default == type(field.default)()
        else:
            expected = json.loads(json.dumps(field.default))
            assert json.loads(default.strip("`")) == expected


@pytest.mark.parametrize("owner", OWNERS)
def test_names_and_types_are_those_of_the_grpc_messages(owner: str) -> None:
    rows, fields = fields_in_table(owner), message_of(owner or "DetectOptions").fields
    assert set(rows) - ONLY_JSON == {field.name for field in fields} - ONLY_GRPC
    scalars = {
        "bool": FieldDescriptor.TYPE_BOOL,
        "double": FieldDescriptor.TYPE_DOUBLE,
        "int32": FieldDescriptor.TYPE_INT32,
        "int64": FieldDescriptor.TYPE_INT64,
        "string": FieldDescriptor.TYPE_STRING,
    }
    for field in fields:
        if field.name not in ONLY_GRPC:
            repeated, _, kind = rows[field.name][1].strip("`").rpartition(" ")
            assert (repeated == "repeated") == field.is_repeated
            if field.message_type is None:
                assert scalars[kind] == field.type
            else:
                assert kind == field.message_type.name


LENGTHS = {
    "viewpoint",
    *(f"GripperGeometry.{name}" for name in ("max_opening", "tip_z", "contact_z", "tcp_z")),
    *(f"Linkage.{name}" for name in ("radius", "reach")),
    *(f"{owner}.{corner}" for owner in ("Workspace", "Box") for corner in ("min", "max")),
    *(f"OrientedBox.{name}" for name in ("center", "half_extents")),
    *(f"Sphere.{name}" for name in ("center", "radius")),
    *(f"Collision.{name}_length" for name in ("approach", "retreat")),
    *("Collision.margin", "Collision.opening", "RansacPlane.distance", "HandPart.boxes"),
    *("SupportPlane.offset", "HalfSpace.offset", "Suppression.translation"),
}
ANGLES = {"RansacPlane.max_tilt", "Suppression.rotation", "Cone.max_angle"}


def test_units_are_told_of_lengths_and_angles_and_of_nothing_else() -> None:
    assert {name for name, cells in ROWS.items() if cells[2] == "m"} == LENGTHS
    assert {name for name, cells in ROWS.items() if cells[2] == "rad"} == ANGLES
    assert {cells[2] for cells in ROWS.values()} == {"m", "rad", ""}


def test_every_option_says_what_it_means() -> None:
    assert all(cells[4] for name, cells in ROWS.items() if not name.endswith(".kind"))
