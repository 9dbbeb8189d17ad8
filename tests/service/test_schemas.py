"""One set of names: proto, pydantic, client, command line and OpenAPI document."""

import dataclasses
import inspect
import os
import subprocess
import sys
import types
import typing
from pathlib import Path

import pytest

import edgegrasp_client
from edgegrasp.v1 import grasp_pb2
from edgegrasp_cli.detect import detect
from edgegrasp_model import options, results
from edgegrasp_service import http_bodies
from edgegrasp_service.core import GraspService, ModelInfo
from edgegrasp_service.dummy import DummyCatalogue
from edgegrasp_service.http_app import create_app

ROOT = Path(__file__).parents[2]
NOT_OPTIONS = {"file", "server", "timeout", "weights", "as_document"}


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
    assert [parameter["name"] for parameter in operation["parameters"]] == names
    content = operation["requestBody"]["content"]
    for media_type in ("application/json", "multipart/form-data"):
        schema = content[media_type]["schema"]["properties"]["options"]
        assert list(schema["properties"]) == names


@pytest.mark.parametrize("name", ["Workspace", "SupportPlane", "Suppression"])
def test_nested_options(name: str) -> None:
    names = list(getattr(options, name).model_fields)
    assert list(getattr(edgegrasp_client, name).__annotations__) == names
    assert [field for field in fields(getattr(grasp_pb2, name)) if field != "disabled"] == names


def test_option_types() -> None:
    """Each option has the same kind of value in the client's types as in the server's."""
    ours = typing.get_type_hints(edgegrasp_client.DetectOptions)
    for name, field in options.DetectOptions.model_fields.items():
        optional = type(None) in typing.get_args(field.annotation)
        assert isinstance(ours[name], types.UnionType) == optional, name


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
    assert set(document["paths"]) == {"/v1/grasps", "/v1/models", "/health/live", "/health/ready"}


def openapi() -> dict:
    return create_app(GraspService(DummyCatalogue, 100), 10_000).openapi()


def test_stubs_are_those_of_the_proto(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    script = ROOT / "scripts" / "generate_proto.sh"
    environment = os.environ | {"PYTHON": sys.executable}
    subprocess.run([script, tmp_path], check=True, env=environment)
    generated = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    assert [path.suffix for path in generated] == [".py", ".pyi", ".py", ".pyi"]
    for path in generated:
        committed = ROOT / "proto" / path.relative_to(tmp_path)
        assert committed.read_text() == path.read_text(), f"{committed.name} is out of date"
