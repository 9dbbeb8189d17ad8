"""Requests and answers have the same fields everywhere."""

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any

import pytest

import edgegrasp_client as client
from edgegrasp.v1 import grasp_pb2
from edgegrasp_model import request_cloud
from edgegrasp_model.options import DetectOptions
from edgegrasp_service.errors import STATUS
from edgegrasp_service.front.http import DOCUMENT

SCHEMAS = DOCUMENT["components"]["schemas"]
OPTIONS = DetectOptions.model_json_schema()
OPTIONS_BY_NAME: dict[str, Any] = {"DetectOptions": OPTIONS, **OPTIONS["$defs"]}
NAMES = {"SupportPlane": "Support", "Linkage": "Swing"}  # of messages that are called otherwise
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
    told = {int(status) for path in DOCUMENT["paths"].values() for status in statuses(path)}
    assert told - {200} == {status for _, status in STATUS.values()} - {499}


def statuses(path: dict[str, Any]) -> list[str]:
    return [status for operation in path.values() for status in operation["responses"]]


@pytest.mark.parametrize(
    ("message", "name"),
    [
        ("Grasp", "Grasp"),
        ("DetectGraspsResponse", "Detection"),
        ("ScoreGraspsResponse", "Scoring"),
        ("Evaluation", "Evaluation"),
        ("DebugInfo", "DebugInfo"),
        ("Model", "Model"),
    ],
)
def test_answers(message: str, name: str) -> None:
    ours = {field.name for field in dataclasses.fields(getattr(client, name))}
    assert ours == set(fields(message))
    assert (
        set(SCHEMAS[name]["properties"]) == set(SCHEMAS[name]["required"]) == set(fields(message))
    )


def parts(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        yield value
    for part in value.values() if isinstance(value, dict) else value:
        if isinstance(part, dict | list):
            yield from parts(part)


def test_generators_of_clients_find_nothing_to_stumble_over() -> None:
    for part in parts(DOCUMENT):
        assert "/properties/" not in str(part.get("$ref", ""))
        assert "type" in part.get("default", {"type": ""})  # a field of that name: no value
