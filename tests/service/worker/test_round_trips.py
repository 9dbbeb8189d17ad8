"""Options survive every way they are written: JSON, query text and protobuf, both ways."""

import json
import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.over_grpc import fill
from edgegrasp_client.requests import plain_options
from edgegrasp_model import options
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_service.worker.http_bodies import options_from_query
from edgegrasp_service.worker.messages import plain_options as options_from_message

Drawn = st.SearchStrategy[Any]
SCHEMA = DetectOptions.model_json_schema()
MOST = 10.0  # metres: larger numbers say nothing more
RIGID = np.eye(4).ravel().tolist()
TEXT = st.text(st.characters(exclude_categories=("Cs",)), max_size=20)
GRIPPER = st.fixed_dictionaries(
    {
        "max_opening": st.floats(0.02, 0.2),
        "tip_z": st.just(0.1),
        "contact_z": st.floats(0.06, 0.09),
        "tcp_z": st.floats(-1.0, 1.0),
        "hand": st.just({"boxes": [[[-0.1, -0.2, -0.1], [0.1, 0.2, 0.05]]]}),
        "finger": st.just(
            {"boxes": [[[-0.01, 0.0, 0.05], [0.01, 0.01, 0.1]], [[-1, 0.5, 0], [1, 1, 0.05]]]}
        ),
    },
    optional={"name": TEXT, "swing": st.none() | st.just({"radius": 0.5, "reach": 0.1})},
)


def drawn(schema: dict[str, Any], name: str) -> Drawn:
    """What the schema of a field allows."""
    if "$ref" in schema:
        return model(schema["$ref"].rpartition("/")[2])
    if parts := schema.get("anyOf", schema.get("oneOf")):
        return st.one_of(drawn(part, name) for part in parts if "contentEncoding" not in part)
    if "enum" in schema or "const" in schema:
        return st.sampled_from(schema.get("enum", [schema.get("const")]))
    match schema["type"]:
        case "null":
            return st.none()
        case "boolean":
            return st.booleans()
        case "integer":
            above = schema.get("exclusiveMaximum", 2**63)
            return st.integers(schema["minimum"], schema.get("maximum", above - 1))
        case "number":
            low = max(schema.get("minimum", 1e-6), -MOST)
            return st.floats(low, min(schema["maximum"], MOST))
        case "string":  # braces and quotes in a query mean a gripper's geometry
            return st.sampled_from(["panda", "7"]) if name == "gripper" else TEXT
    return numbers_or_list(schema, name)


def numbers_or_list(schema: dict[str, Any], name: str) -> Drawn:
    if name.startswith("T_"):
        place = st.floats(-MOST, MOST)
        return place.map(lambda x: [*RIGID[:3], x, *RIGID[4:]])
    if name == "surface":
        return st.lists(st.floats(-MOST, MOST), max_size=4).map(lambda values: values * 3)
    if "prefixItems" not in schema:
        most = min(schema.get("maxItems", 4), 4)
        return st.lists(
            drawn(schema["items"], name), min_size=schema.get("minItems", 0), max_size=most
        )
    vector = st.tuples(*(drawn(part, name) for part in schema["prefixItems"]))
    if name in ("normal", "quaternion", "direction", "up"):
        vector = vector.filter(lambda v: math.hypot(*v) > 1e-3)
    if name in ("normal", "quaternion"):
        return vector.map(lambda v: tuple((np.array(v) / np.linalg.norm(v)).tolist()))
    return vector


@cache
def model(name: str = "") -> Drawn:
    """What a model of the options allows; those of a request if it has no name."""
    if name == "GripperGeometry":
        return GRIPPER
    schema = SCHEMA["$defs"][name] if name else SCHEMA
    fields = {field: drawn(part, field) for field, part in schema["properties"].items()}
    needed = {*schema.get("required", ()), *({"kind"} if name != "SupportPlane" else ())}
    found = st.fixed_dictionaries(
        {field: fields[field] for field in fields if field in needed},
        optional={field: fields[field] for field in fields if field not in needed},
    )

    def possible(values: dict[str, Any]) -> bool:
        try:
            return bool(getattr(options, name).model_validate(values))
        except ValidationError:
            return False

    if "max" in fields:
        found = found.map(in_order)
    return found.filter(possible) if name else found


def in_order(box: dict[str, Any]) -> dict[str, Any]:
    ends = np.sort([box["min"], box["max"]], axis=0)
    return box | {"min": ends[0].tolist(), "max": (ends[1] + 0.1).tolist()}


def through_message(fields: dict[str, Any]) -> DetectOptions:
    """As the client sends it and the server reads it."""
    message = grasp_pb2.DetectOptions()
    fill(message, plain_options(fields), "options")
    arrived = grasp_pb2.DetectOptions.FromString(message.SerializeToString())
    return parse_options(options_from_message(arrived))


def through_json(fields: object) -> DetectOptions:
    return parse_options(json.loads(json.dumps(fields)))


def through_query(fields: dict[str, Any]) -> DetectOptions:
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in plain_options(fields).items()
    }
    return parse_options(options_from_query(texts.items()))


@settings(max_examples=300, derandomize=True, deadline=None)
@given(fields=model())
def test_a_request_means_the_same_however_it_is_sent(fields: dict[str, Any]) -> None:
    expected = parse_options(fields)
    for sent in (fields, expected.model_dump(mode="json")):
        assert through_message(sent) == expected
        assert through_json(sent) == expected
        assert through_query(sent) == expected


@pytest.mark.parametrize("value", [(0.0, 0.0, 1.0), ((0.0, 0.0, 1.0),)])
def test_one_viewpoint_is_one(value: Any) -> None:
    assert through_message({"viewpoint": value}).viewpoint == (0.0, 0.0, 1.0)


def test_zeros_and_empty_lists_are_sent() -> None:
    """What protobuf calls a default is not what an option calls one."""
    fields: dict[str, Any] = {
        "support": {"normal": [0, 0, 1], "offset": 0.0},
        "approach_region": {"include": [{"kind": "indices", "indices": []}]},
        "contact_region": {"include": [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}]},
        "suppression": {"translation": 0.0, "rotation": 0.0},
        "collision": {"approach_length": 0.0},
        "min_score": 0.0,
        "seed": 0,
        "debug": False,
    }
    assert through_message(fields) == parse_options(fields)
