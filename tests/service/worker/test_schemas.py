"""Requests and answers have the same fields everywhere."""

import dataclasses
import inspect
import json
from typing import Any

import numpy as np
import pytest
from tests.many_options import MANY, OWN_GRIPPER

import edgegrasp_client as client
from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.over_grpc import fill
from edgegrasp_client.requests import plain_options
from edgegrasp_model import request_cloud
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.request_cloud import options_of_texts
from edgegrasp_service.errors import STATUS
from edgegrasp_service.front.http import OPENAPI_DOCUMENT
from edgegrasp_service.worker.answer import plain_options as options_from_message

SCHEMAS = OPENAPI_DOCUMENT["components"]["schemas"]
OPTIONS = DetectOptions.model_json_schema()
OPTIONS_BY_NAME: dict[str, Any] = {"DetectOptions": OPTIONS, **OPTIONS["$defs"]}
NAMES = {"SupportPlane": "Support", "Linkage": "Swing"}  # of messages that are called otherwise
NAMES |= {"Detection": "DetectGraspsResponse", "Scoring": "ScoreGraspsResponse"}
ANSWERS = ["Grasp", "Detection", "Scoring", "Evaluation", "DebugInfo", "Model"]
BESIDE = {"disabled", "auto", "ransac", "object_choice"}  # fields for what JSON has no field for


def fields(message: str) -> list[str]:
    return [field.name for field in getattr(grasp_pb2, message).DESCRIPTOR.fields]


@pytest.mark.parametrize("name", OPTIONS_BY_NAME)
def test_options(name: str) -> None:
    ours = set(OPTIONS_BY_NAME[name]["properties"]) - {"kind"}
    assert ours == set(fields(NAMES.get(name, name))) - BESIDE


@pytest.mark.parametrize("name", ["PointCloud2", "PointField", "DepthImage", "Intrinsics", "Depth"])
def test_clouds(name: str) -> None:
    assert set(fields(name)) == set(getattr(request_cloud, name).model_fields)
    if name != "Depth":
        assert fields(name) == list(getattr(client, name).__annotations__)


def test_requests() -> None:
    """The same fields on both transports and in the client, but for the cloud itself."""
    detect, score = fields("DetectGraspsRequest"), fields("ScoreGraspsRequest")
    assert score == [*detect, "edges", "hand_poses"]
    for kind, names in (("Detect", detect), ("Score", score)):
        body, form = (SCHEMAS[f"{kind}{what}"]["properties"] for what in ("Request", "Form"))
        assert set(body) == set(names) - {"encoded"}
        assert set(form) == set(names) - {"encoded", "points"} | {"cloud", *request_cloud.CAMERA}
    in_grpc = [*SCHEMAS["DetectOptions"]["properties"], "object_choice"]  # `objects` as an object
    assert in_grpc == fields("DetectOptions")
    for method, names in ((client.GraspClient.detect, detect), (client.GraspClient.score, score)):
        beside = client.RequestFields.__annotations__.keys() - client.DetectOptions.__annotations__
        ours = set(inspect.signature(method).parameters) - {"self", "timeout", "fields"} | beside
        assert ours == set(names) - {"points", "encoded", "point_cloud2", "options"} | {"cloud"}


def test_errors() -> None:
    """ErrorDetail has the fields of a problem document that a gRPC status does not hold."""
    ours = set(SCHEMAS["Problem"]["properties"]) - {"type", "title", "status", "detail"}
    assert ours == set(fields("ErrorDetail")) - {"kind"}
    operations = [one for path in OPENAPI_DOCUMENT["paths"].values() for one in path.values()]
    told = {int(status) for operation in operations for status in operation["responses"]}
    assert told - {200} == {status for _, status in STATUS.values()} - {499}


@pytest.mark.parametrize("name", ANSWERS)
def test_answers(name: str) -> None:
    ours = {field.name for field in dataclasses.fields(getattr(client, name))}
    in_grpc, in_json = set(fields(NAMES.get(name, name))), SCHEMAS[name]
    assert ours == in_grpc == set(in_json["properties"]) == set(in_json["required"])


def test_kinds_are_required_and_tokens_described() -> None:
    for name, schema in SCHEMAS.items():
        if "kind" in schema.get("properties", ()) and name != "SupportPlane":
            assert "kind" in schema.get("required", ()), name
    assert "securitySchemes" in OPENAPI_DOCUMENT["components"]
    assert "File" not in SCHEMAS  # the name of a type of JavaScript


def test_generators_of_clients_find_nothing_to_stumble_over() -> None:
    def check(part: dict[str, Any]) -> dict[str, Any]:
        assert "/properties/" not in str(part.get("$ref", ""))
        assert "type" in part.get("default", {"type": ""})  # a field of that name: no value
        return part

    json.loads(json.dumps(OPENAPI_DOCUMENT), object_hook=check)


POSE = np.eye(4).ravel().tolist()
GRIPPER = OWN_GRIPPER | {
    "name": "mine",
    "tcp_z": -0.08,
    "finger": {"boxes": [*OWN_GRIPPER["finger"]["boxes"], [[-1, 0.5, 0], [1, 1, 0.05]]]},
    "swing": {"radius": 0.5, "reach": 0.1},
}
ORIENTED = {"kind": "oriented_box", "center": [0.1, 0, 0], "half_extents": [1, 2, 3]}
MASK = {"kind": "mask", "mask": [True, False, True]}
ROBOT = {"name": "fr3", "T_base_cloud": POSE, "joints": [0.0, -1.5], "avoid_unseen": True}
EXAMPLES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "many": MANY,
    "text that looks like something else": {"model": "7", "gripper": "7"},
    "one viewpoint": {"viewpoint": (0.0, 0.0, 1.0)},
    "one viewpoint in a list": {"viewpoint": ((0.0, 0.0, 1.0),)},
    "objects": {
        "objects": {"include": [0, 2], "exclude": [1]},
        "at": [3.0, 4.5],
        "near": [0.1, 0.2, 0.3],
        "max_object_size": 0.3,
    },
    "every object": {"objects": "off", "suppression": None, "support": None, "gripper": GRIPPER},
    "shapes": {
        "approach_region": {"include": [ORIENTED | {"quaternion": [0, 0, 0, 1]}, MASK]},
        "support": {"normal": [0, 0, 1], "offset": 0.1, "max_depth_error": 0.1},
    },
    "previous": {
        "previous": {
            "gripper": "panda",
            "next_id": 8,
            "grasps": [{"id": 7, "T_cloud_hand": POSE, "object": 3}],
            "objects": [{"number": 3, "surface": [0.0] * 6, "confidence": 0.5}],
            "search": True,
        }
    },
    "a robot that places by a pose": {"robot": ROBOT | {"place": {"T_base_object": POSE}}},
    "a robot that places in a region": {
        "robot": ROBOT | {"plan": "reach", "place": {"region": {"min": [0] * 3, "max": [1] * 3}}}
    },
    "zeros and empty lists, which protobuf calls defaults": {
        "support": {"normal": [0, 0, 1], "offset": 0.0},
        "approach_region": {"include": [{"kind": "indices", "indices": []}]},
        "contact_region": {"include": [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}]},
        "suppression": {"translation": 0.0, "rotation": 0.0},
        "collision": {"approach_length": 0.0},
        "min_score": 0.0,
        "seed": 0,
        "debug": False,
    },
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_request_means_the_same_however_it_is_sent(name: str) -> None:
    expected = parse_options(EXAMPLES[name])
    for sent in (EXAMPLES[name], expected.model_dump(mode="json")):
        plain = plain_options(sent)
        message = grasp_pb2.DetectOptions()
        fill(message, plain, "options")
        arrived = grasp_pb2.DetectOptions.FromString(message.SerializeToString())
        assert parse_options(options_from_message(arrived)) == expected
        assert parse_options(json.loads(json.dumps(sent))) == expected
        texts = [(name, v if isinstance(v, str) else json.dumps(v)) for name, v in plain.items()]
        quoted = [(name, json.dumps(value)) for name, value in plain.items()]
        assert parse_options(options_of_texts(texts)) == expected
        assert parse_options(options_of_texts(quoted)) == expected


def test_every_option_has_an_example() -> None:
    assert set().union(*EXAMPLES.values()) == set(DetectOptions.model_fields)
