"""REST and gRPC accept and return the same fields: the two documents, walked side by side."""

import json
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor import Descriptor, FieldDescriptor

from edgegrasp.v1 import grasp_pb2

DOCUMENT = json.loads((Path(__file__).parents[3] / "proto" / "openapi.json").read_text())

# Messages that JSON writes as lists or as one number, a string or an object without a field around.
AS_LISTS = {"Vector", "Quaternion", "HandBox", "Edge", "HandPose"}
BYTES_AS_LISTS = {"points", "normals", "colors", "segment_ids", "view_ids"}
KINDS = {
    FieldDescriptor.CPPTYPE_BOOL: "boolean",
    FieldDescriptor.CPPTYPE_INT32: "integer",
    FieldDescriptor.CPPTYPE_INT64: "integer",
    FieldDescriptor.CPPTYPE_FLOAT: "number",
    FieldDescriptor.CPPTYPE_DOUBLE: "number",
    FieldDescriptor.CPPTYPE_STRING: "string",
}


def resolve(schema: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in schema:
        schema = DOCUMENT["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema


def alternatives(schema: dict[str, Any]) -> list[dict[str, Any]]:
    """What a value may be, null aside."""
    schema = resolve(schema)
    for word in ("anyOf", "oneOf"):
        if word in schema:
            return [leaf for part in schema[word] for leaf in alternatives(part)]
    return [] if schema.get("type") == "null" else [schema]


def differences(path: str, schema: dict[str, Any], message: Descriptor) -> list[str]:
    """Where an object of JSON and a message do not have the same fields of the same kinds."""
    objects = [one for one in alternatives(schema) if one.get("type") == "object"]
    by_kind = {one["properties"]["kind"]["const"]: one for one in objects if kind_of(one)}
    oneof = message.oneofs_by_name.get("kind")
    if oneof is not None:  # a shape: one message for each kind
        names = {field.name for field in oneof.fields}
        if names != set(by_kind):
            return [f"{path}: kinds {sorted(by_kind)} and {sorted(names)}"]
        return [
            line
            for field in oneof.fields
            for line in compare(f"{path}.{field.name}", [by_kind[field.name]], field.message_type)
        ]
    if message.name == "Support":
        found = compare(path, [by_kind["plane"]], message, without={"ransac"})
        ransac = message.fields_by_name["ransac"].message_type
        return found + compare(f"{path}.ransac", [by_kind["ransac"]], ransac)
    if message.name == "GripperChoice":
        geometry = message.fields_by_name["geometry"].message_type
        assert any(one.get("type") == "string" for one in alternatives(schema))
        return compare(path, objects, geometry)
    without = {"disabled"} if message.name == "Suppression" else set()  # null in JSON
    return compare(path, objects, message, without)


def kind_of(schema: dict[str, Any]) -> str:
    return str(schema.get("properties", {}).get("kind", {}).get("const", ""))


def compare(
    path: str,
    objects: list[dict[str, Any]],
    message: Descriptor,
    without: frozenset[str] | set[str] = frozenset(),
) -> list[str]:
    if not objects:
        return [f"{path}: no object in JSON for {message.name}"]
    properties = {name: part for one in objects for name, part in one["properties"].items()}
    ours = set(properties) - {"kind"}
    theirs = set(message.fields_by_name) - without
    found = [f"{path}.{name}: only in one of the two" for name in sorted(ours ^ theirs)]
    for name in sorted(ours & theirs):
        found += compare_field(f"{path}.{name}", properties[name], message.fields_by_name[name])
    return found


def compare_field(path: str, schema: dict[str, Any], field: FieldDescriptor) -> list[str]:
    types = {one.get("type", "any") for one in alternatives(schema)}
    nested = field.message_type
    if nested is not None and nested.GetOptions().map_entry:
        return [] if types == {"object"} else [f"{path}: {types} for a map"]
    if field.cpp_type == FieldDescriptor.CPPTYPE_STRING and field.type == field.TYPE_BYTES:
        expected = "array" if field.name in BYTES_AS_LISTS else "string"
        return [] if types == {expected} else [f"{path}: {types} for bytes"]
    if field.is_repeated:
        if types != {"array"}:
            return [f"{path}: {types} for a repeated field"]
        items = [one["items"] for one in alternatives(schema) if "items" in one]
        if nested is None or nested.name in AS_LISTS:
            return []  # a matrix is rows in JSON, and flat in a message
        return [line for item in items for line in differences(f"{path}.0", item, nested)]
    if nested is not None:
        if nested.name in AS_LISTS:
            return [] if types == {"array"} else [f"{path}: {types} for {nested.name}"]
        return differences(path, schema, nested)
    kind = KINDS[field.cpp_type]
    return [] if types == {kind} else [f"{path}: {types} for {kind}"]


def request_schema(path: str) -> dict[str, Any]:
    content = DOCUMENT["paths"][path]["post"]["requestBody"]["content"]
    schema: dict[str, Any] = content["application/json"]["schema"]
    # A file is a body of its own, or a part of a form; a message has the field `encoded`.
    files = [name for name in content if name.startswith("application/x-")]
    assert "cloud" in content["multipart/form-data"]["schema"]["properties"]
    assert bool(files) == (path == "/v1/grasps")
    encoded = {"type": "object", "properties": {"format": STRING, "data": STRING}}
    return schema | {"properties": schema["properties"] | {"encoded": encoded}}


STRING = {"type": "string"}


def answer_schema(path: str, method: str) -> dict[str, Any]:
    answer = DOCUMENT["paths"][path][method]["responses"]["200"]
    schema: dict[str, Any] = answer["content"]["application/json"]["schema"]
    return schema


PAIRS = {
    "detect request": (request_schema("/v1/grasps"), grasp_pb2.DetectGraspsRequest),
    "score request": (request_schema("/v1/grasps:score"), grasp_pb2.ScoreGraspsRequest),
    "detect answer": (answer_schema("/v1/grasps", "post"), grasp_pb2.DetectGraspsResponse),
    "score answer": (answer_schema("/v1/grasps:score", "post"), grasp_pb2.ScoreGraspsResponse),
    "models": (answer_schema("/v1/models", "get"), grasp_pb2.ListModelsResponse),
    "reload": (answer_schema("/v1/models:reload", "post"), grasp_pb2.ReloadModelsResponse),
}


@pytest.mark.parametrize("name", PAIRS)
def test_same_fields(name: str) -> None:
    schema, message = PAIRS[name]
    assert differences(name, schema, message.DESCRIPTOR) == []


def test_errors() -> None:
    """ErrorDetail has the fields of a problem document that a gRPC status does not hold."""
    responses = DOCUMENT["paths"]["/v1/grasps"]["post"]["responses"]
    for status, response in responses.items():
        if status == "200":
            continue
        schema = response["content"]["application/problem+json"]["schema"]
        ours = set(schema["properties"]) - {"type", "title", "status", "detail"}
        assert ours == set(grasp_pb2.ErrorDetail.DESCRIPTOR.fields_by_name) - {"kind"}


def test_the_walk_reaches_every_message() -> None:
    """Every message but envelopes is compared somewhere."""
    reached: set[str] = set()

    def walk(message: Descriptor) -> None:
        if message.name not in reached and not message.GetOptions().map_entry:
            reached.add(message.name)
            for field in message.fields:
                if field.message_type is not None:
                    walk(field.message_type)

    for _, message in PAIRS.values():
        walk(message.DESCRIPTOR)
    every = set(grasp_pb2.DESCRIPTOR.message_types_by_name)
    assert every - reached == EMPTY | ERRORS | STREAMED


EMPTY = {"ListModelsRequest", "ReloadModelsRequest"}
ERRORS = {"ErrorDetail"}  # compared with the problem document
STREAMED = {"DetectGraspsStreamRequest", "DetectGraspsStreamResponse", "StreamError"}  # no HTTP


def test_empty_messages_are_empty() -> None:
    for name in EMPTY:
        assert grasp_pb2.DESCRIPTOR.message_types_by_name[name].fields == []


@pytest.mark.parametrize("change", ["removed", "renamed", "type", "added"])
def test_the_walk_finds_differences(change: str) -> None:
    schema = json.loads(json.dumps(request_schema("/v1/grasps")))
    collision = next(
        one
        for one in alternatives(schema["properties"]["options"]["properties"]["collision"])
        if one["type"] == "object"
    )["properties"]
    if change in ("removed", "renamed"):
        margin = collision.pop("margin")
    if change == "renamed":
        collision["margins"] = margin
    if change == "type":
        collision["margin"] = {"type": "string"}
    if change == "added":
        collision["force"] = {"type": "number"}
    found = differences("request", schema, grasp_pb2.DetectGraspsRequest.DESCRIPTOR)
    assert found
    assert all(line.startswith("request.options.collision.") for line in found)
