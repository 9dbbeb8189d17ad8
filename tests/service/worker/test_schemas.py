"""Answers and clouds have the same fields everywhere; those of options are generated."""

import dataclasses
import inspect

import pytest

import edgegrasp_client
from edgegrasp.v1 import grasp_pb2
from edgegrasp_model import results
from edgegrasp_service import schemas
from edgegrasp_service.worker.answer import MODEL_FACTS


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
    """The client's methods take what either request has; the cloud under one name."""
    detect, score = fields(grasp_pb2.DetectGraspsRequest), fields(grasp_pb2.ScoreGraspsRequest)
    assert score == [*detect, "edges", "hand_poses"]
    client = edgegrasp_client.GraspClient
    for method, names in ((client.detect, detect), (client.score, score)):
        ours = set(inspect.signature(method).parameters) - {"self", "timeout"}
        assert ours == set(names) - {"points", "encoded", "point_cloud2"} | {"cloud"}


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
    assert list(body.model_fields) == names


def test_models() -> None:
    names = fields(grasp_pb2.Model)
    assert list(MODEL_FACTS) == names
    assert [field.name for field in dataclasses.fields(edgegrasp_client.Model)] == names
    assert list(schemas.ModelBody.model_fields) == names
