"""Answers and clouds have the same fields everywhere; those of options are generated."""

import dataclasses
import inspect
import json

import pytest

import edgegrasp_client as client
from edgegrasp.v1 import grasp_pb2
from edgegrasp_model import results
from edgegrasp_service import schemas


def fields(message: str) -> list[str]:
    return [field.name for field in getattr(grasp_pb2, message).DESCRIPTOR.fields]


@pytest.mark.parametrize("name", ["PointCloud2", "PointField", "DepthImage", "Intrinsics", "Depth"])
def test_clouds(name: str) -> None:
    assert fields(name) == list(getattr(schemas, name).model_fields)
    if name != "Depth":
        assert fields(name) == list(getattr(client, name).__annotations__)


def test_requests() -> None:
    """The same fields on both transports and in the client, but for the cloud itself."""
    detect, score = fields("DetectGraspsRequest"), fields("ScoreGraspsRequest")
    assert score == [*detect, "edges", "hand_poses"]
    for document, names in ((schemas.openapi_detect(), detect), (schemas.openapi_score(), score)):
        content = document["requestBody"]["content"]
        body = content["application/json"]["schema"]["properties"]
        form = content["multipart/form-data"]["schema"]["properties"]
        assert set(body) == set(names) - {"encoded"}
        assert set(form) == set(names) - {"encoded", "points"} | {"cloud"}
        assert list(body["options"]["properties"]) == fields("DetectOptions")
        assert "$ref" not in json.dumps(document)
    for method, names in ((client.GraspClient.detect, detect), (client.GraspClient.score, score)):
        ours = set(inspect.signature(method).parameters) - {"self", "timeout"}
        assert ours == set(names) - {"points", "encoded", "point_cloud2"} | {"cloud"}


def test_errors() -> None:
    """ErrorDetail has the fields of a problem document that a gRPC status does not hold."""
    ours = set(schemas.ProblemBody.model_fields) - {"type", "title", "status", "detail"}
    assert ours == set(fields("ErrorDetail")) - {"kind"}


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
    kinds = [getattr(client, name)] + ([getattr(results, name)] if name != "Model" else [])
    for kind in kinds:
        assert [field.name for field in dataclasses.fields(kind)] == fields(message)
    body = getattr(schemas, f"{name.removesuffix('Info')}Body")
    assert set(body.model_fields) == set(fields(message))
