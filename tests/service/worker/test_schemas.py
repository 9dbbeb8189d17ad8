"""Answers and clouds have the same fields everywhere; those of options are generated."""

import dataclasses
import inspect
import json

import pytest

import edgegrasp_client
from edgegrasp.v1 import grasp_pb2
from edgegrasp_model import results
from edgegrasp_service import schemas


def fields(message: type) -> list[str]:
    return [field.name for field in message.DESCRIPTOR.fields]


@pytest.mark.parametrize(
    ("schema", "message", "client"),
    [
        (schemas.PointCloud2, grasp_pb2.PointCloud2, edgegrasp_client.PointCloud2),
        (schemas.PointField, grasp_pb2.PointField, edgegrasp_client.PointField),
        (schemas.DepthImage, grasp_pb2.DepthImage, edgegrasp_client.DepthImage),
        (schemas.Intrinsics, grasp_pb2.Intrinsics, edgegrasp_client.Intrinsics),
        (schemas.Depth, grasp_pb2.Depth, None),
    ],
)
def test_clouds(schema: type, message: type, client: type | None) -> None:
    assert fields(message) == list(schema.model_fields)
    if client is not None:
        assert list(client.__annotations__) == list(schema.model_fields)


def test_requests() -> None:
    """The same fields on both transports and in the client, but for the cloud itself."""
    detect, score = fields(grasp_pb2.DetectGraspsRequest), fields(grasp_pb2.ScoreGraspsRequest)
    assert score == [*detect, "edges", "hand_poses"]
    for document, names in ((schemas.openapi_detect(), detect), (schemas.openapi_score(), score)):
        content = document["requestBody"]["content"]
        body = content["application/json"]["schema"]["properties"]
        form = content["multipart/form-data"]["schema"]["properties"]
        assert set(body) == set(names) - {"encoded"}
        assert set(form) == set(names) - {"encoded", "points"} | {"cloud"}
        assert list(body["options"]["properties"]) == fields(grasp_pb2.DetectOptions)
        assert "$ref" not in json.dumps(document)
    client = edgegrasp_client.GraspClient
    for method, names in ((client.detect, detect), (client.score, score)):
        ours = set(inspect.signature(method).parameters) - {"self", "timeout"}
        assert ours == set(names) - {"points", "encoded", "point_cloud2"} | {"cloud"}


def test_errors() -> None:
    """ErrorDetail has the fields of a problem document that a gRPC status does not hold."""
    ours = set(schemas.ProblemBody.model_fields) - {"type", "title", "status", "detail"}
    assert ours == set(fields(grasp_pb2.ErrorDetail)) - {"kind"}


@pytest.mark.parametrize(
    ("message", "ours", "body", "client"),
    [
        (
            grasp_pb2.Grasp,
            results.Grasp,
            schemas.GraspBody,
            edgegrasp_client.Grasp,
        ),
        (
            grasp_pb2.DetectGraspsResponse,
            results.Detection,
            schemas.DetectionBody,
            edgegrasp_client.Detection,
        ),
        (
            grasp_pb2.ScoreGraspsResponse,
            results.Scoring,
            schemas.ScoringBody,
            edgegrasp_client.Scoring,
        ),
        (
            grasp_pb2.Evaluation,
            results.Evaluation,
            schemas.EvaluationBody,
            edgegrasp_client.Evaluation,
        ),
        (
            grasp_pb2.DebugInfo,
            results.DebugInfo,
            schemas.DebugBody,
            edgegrasp_client.DebugInfo,
        ),
    ],
)
def test_answers(message: type, ours: type, body: type, client: type) -> None:
    names = fields(message)
    assert [field.name for field in dataclasses.fields(ours)] == names
    assert [field.name for field in dataclasses.fields(client)] == names
    assert set(body.model_fields) == set(names)


def test_models() -> None:
    names = fields(grasp_pb2.Model)
    assert [field.name for field in dataclasses.fields(edgegrasp_client.Model)] == names
    assert list(schemas.ModelBody.model_fields) == names
