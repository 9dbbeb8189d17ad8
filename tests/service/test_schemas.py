"""One set of names: proto, pydantic, client, command line and OpenAPI document."""

import dataclasses
import inspect
import os
import subprocess
import sys
import typing
from pathlib import Path

import pytest

import edgegrasp_client
from edgegrasp.v1 import grasp_pb2
from edgegrasp_cli.detect import NOT_OPTIONS, detect
from edgegrasp_model import directions, gripper, options, regions, results, support
from edgegrasp_service import depth_images, http_bodies, point_cloud2
from edgegrasp_service.core import GraspService, ModelInfo
from edgegrasp_service.dummy import DummyCatalogue
from edgegrasp_service.http_app import create_app

ROOT = Path(__file__).parents[2]


def fields(message: type) -> list[str]:
    return [field.name for field in message.DESCRIPTOR.fields]


def test_options() -> None:
    names = list(options.DetectOptions.model_fields)
    assert fields(grasp_pb2.DetectOptions) == names
    assert list(edgegrasp_client.DetectOptions.__annotations__) == names
    assert [name for name in inspect.signature(detect).parameters if name not in NOT_OPTIONS] == (
        names
    )
    operation = openapi()["paths"]["/v1/grasps"]["post"]
    queries = [parameter for parameter in operation["parameters"] if parameter["in"] == "query"]
    assert [parameter["name"] for parameter in queries] == names
    content = operation["requestBody"]["content"]
    for media_type in ("application/json", "multipart/form-data"):
        schema = content[media_type]["schema"]["properties"]["options"]
        assert list(schema["properties"]) == names


# Each kind of object in the options, and the message that holds its fields.
NESTED = {
    options.Workspace: grasp_pb2.Workspace,
    options.Suppression: grasp_pb2.Suppression,
    options.Collision: grasp_pb2.Collision,
    support.SupportPlane: grasp_pb2.Support,
    support.RansacPlane: grasp_pb2.RansacPlane,
    regions.Region: grasp_pb2.Region,
    regions.Box: grasp_pb2.Box,
    regions.OrientedBox: grasp_pb2.OrientedBox,
    regions.Sphere: grasp_pb2.Sphere,
    regions.HalfSpace: grasp_pb2.HalfSpace,
    regions.Indices: grasp_pb2.Indices,
    regions.Mask: grasp_pb2.Mask,
    regions.Segments: grasp_pb2.Segments,
    directions.ApproachDirection: grasp_pb2.ApproachDirection,
    directions.Cone: grasp_pb2.Cone,
    gripper.GripperGeometry: grasp_pb2.GripperGeometry,
    gripper.HandPart: grasp_pb2.HandPart,
    gripper.Linkage: grasp_pb2.Linkage,
}
IN_MESSAGES_ONLY = {"disabled", "ransac"}  # `null` and `"kind": "ransac"` in JSON


@pytest.mark.parametrize("schema", NESTED, ids=lambda schema: schema.__name__)
def test_nested_options(schema: type) -> None:
    names = list(schema.model_fields)
    typed = getattr(edgegrasp_client, schema.__name__)
    assert list(typed.__annotations__) == names
    required = {name for name, field in schema.model_fields.items() if field.is_required()}
    if typed.__required_keys__:
        assert typed.__required_keys__ - {"kind"} == required
    message = [name for name in fields(NESTED[schema]) if name not in IN_MESSAGES_ONLY]
    assert message == [name for name in names if name != "kind"]


def test_every_object_of_the_options_is_compared() -> None:
    definitions = options.DetectOptions.model_json_schema()["$defs"]
    assert set(definitions) == {schema.__name__ for schema in NESTED}


def test_kinds_of_shapes() -> None:
    kinds = {schema.model_fields["kind"].default for schema in typing.get_args(_union())}
    assert set(fields(grasp_pb2.Shape)) == kinds
    assert set(fields(grasp_pb2.Obstacle)) == {"box", "oriented_box"}


def _union() -> object:
    return typing.get_args(regions.Shape)[0]


@pytest.mark.parametrize(
    ("schema", "message", "client"),
    [
        (point_cloud2.PointCloud2, grasp_pb2.PointCloud2, edgegrasp_client.PointCloud2),
        (point_cloud2.PointField, grasp_pb2.PointField, edgegrasp_client.PointField),
        (depth_images.DepthImage, grasp_pb2.DepthImage, edgegrasp_client.DepthImage),
        (depth_images.Intrinsics, grasp_pb2.Intrinsics, edgegrasp_client.Intrinsics),
        (depth_images.Depth, grasp_pb2.Depth, None),
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
    document = openapi()["paths"]
    for path, names in (("/v1/grasps", detect), ("/v1/grasps:score", score)):
        content = document[path]["post"]["requestBody"]["content"]
        body = set(content["application/json"]["schema"]["properties"])
        form = set(content["multipart/form-data"]["schema"]["properties"])
        assert body == set(names) - {"encoded"}
        assert form == set(names) - {"encoded", "points"} | {"cloud"}
    client = edgegrasp_client.GraspClient
    for method, names in ((client.detect, detect), (client.score, score)):
        ours = set(inspect.signature(method).parameters) - {"self", "timeout"}
        assert ours == set(names) - {"points", "encoded", "point_cloud2"} | {"cloud"}


def test_option_types() -> None:
    """Each option has the same kind of value in the client's types as in the server's."""
    ours = typing.get_type_hints(edgegrasp_client.DetectOptions)
    for name, field in options.DetectOptions.model_fields.items():
        optional = type(None) in typing.get_args(field.annotation)
        assert (type(None) in typing.get_args(ours[name])) == optional, name


@pytest.mark.parametrize(
    ("message", "ours", "body", "client"),
    [
        (
            grasp_pb2.Grasp,
            results.Grasp,
            http_bodies.GraspBody,
            edgegrasp_client.Grasp,
        ),
        (
            grasp_pb2.DetectGraspsResponse,
            results.Detection,
            http_bodies.DetectionBody,
            edgegrasp_client.Detection,
        ),
        (
            grasp_pb2.ScoreGraspsResponse,
            results.Scoring,
            http_bodies.ScoringBody,
            edgegrasp_client.Scoring,
        ),
        (
            grasp_pb2.Evaluation,
            results.Evaluation,
            http_bodies.EvaluationBody,
            edgegrasp_client.Evaluation,
        ),
        (
            grasp_pb2.DebugInfo,
            results.DebugInfo,
            http_bodies.DebugBody,
            edgegrasp_client.DebugInfo,
        ),
        (grasp_pb2.Model, ModelInfo, http_bodies.ModelBody, edgegrasp_client.Model),
    ],
)
def test_answers(message: type, ours: type, body: type, client: type) -> None:
    names = fields(message)
    assert [field.name for field in dataclasses.fields(ours)] == names
    assert [field.name for field in dataclasses.fields(client)] == names
    assert list(body.model_fields) == names


def test_openapi_has_no_dangling_reference() -> None:
    document = openapi()

    def walk(value: object) -> None:
        if isinstance(value, dict):
            if "$ref" in value:
                target = document
                for part in value["$ref"].removeprefix("#/").split("/"):
                    target = target[part]
            for part in value.values():
                walk(part)
        elif isinstance(value, list):
            for part in value:
                walk(part)

    walk(document)
    assert set(document["paths"]) == {
        "/v1/grasps",
        "/v1/grasps:score",
        "/v1/models",
        "/v1/models:reload",
        "/health/live",
        "/health/ready",
    }


def openapi() -> dict:
    return create_app(GraspService(DummyCatalogue)).openapi()


def test_what_is_generated_is_committed(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    script = ROOT / "scripts" / "generate_proto.sh"
    environment = os.environ | {"PYTHON": sys.executable}
    subprocess.run([script, tmp_path], check=True, env=environment)
    generated = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    assert [path.name for path in generated] == [
        "contract.json",
        "grasp_pb2.py",
        "grasp_pb2.pyi",
        "grasp_pb2_grpc.py",
        "grasp_pb2_grpc.pyi",
        "openapi.json",
    ]
    for path in generated:
        committed = ROOT / "proto" / path.relative_to(tmp_path)
        assert committed.read_text() == path.read_text(), f"{committed.name} is out of date"
