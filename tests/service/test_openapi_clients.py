"""Clients that generators make of the OpenAPI document."""

import json
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.programs import run

from edgegrasp_service.front.http import DOCUMENT

FILE = Path(__file__).parents[2] / "proto" / "edgegrasp" / "v1" / "openapi.json"
ASK = """
import json, sys
from edge_grasp_client import Client
from edge_grasp_client.api.default import get_v1_models, post_v1_grasps
from edge_grasp_client.models import DetectRequest
body = DetectRequest.from_dict(json.load(sys.stdin))
with Client(sys.argv[1]) as client:
    assert get_v1_models.sync_detailed(client=client).parsed.models[0].name == "dummy"
    answer = post_v1_grasps.sync_detailed(client=client, body=body)
assert answer.status_code == 200, answer.content
print(len(answer.parsed.grasps), answer.parsed.grasps[0].score)
"""


def program(variable: str, name: str) -> str:
    """A generator: too far from our own requirements to be installed beside them."""
    found = os.environ.get(variable) or shutil.which(name)
    if not found:
        pytest.skip(f"{name} is not here, and {variable} names none")
    return found


def parts(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        yield value
    for part in value.values() if isinstance(value, dict) else value:
        if isinstance(part, dict | list):
            yield from parts(part)


def test_the_document_has_nothing_that_generators_stumble_over() -> None:
    for part in parts(DOCUMENT):
        assert "/properties/" not in str(part.get("$ref", ""))
        assert "type" in part.get("default", {"type": ""})  # a field of that name: no value


def test_openapi_python_client_asks_a_server(dummy_server, cloud: np.ndarray, tmp_path) -> None:
    generator = program("OPENAPI_PYTHON_CLIENT", "openapi-python-client")
    folder = tmp_path / "generated"
    words = [generator, "generate", "--path", str(FILE), "--output-path", str(folder)]
    environment = os.environ | {"PATH": f"{Path(generator).parent}:{os.environ['PATH']}"}
    done = run(*words, env=environment)
    assert "will not be generated" not in done.stdout + done.stderr
    request = {"points": cloud.tolist(), "options": {"top_k": 3, "objects": {"include": [0]}}}
    words, there = [sys.executable, "-c", ASK, dummy_server.http_url], {"PYTHONPATH": str(folder)}
    asked = run(*words, input=json.dumps(request), env=os.environ | there)
    assert asked.stdout.startswith("3 0."), asked.stderr


def test_openapi_typescript_knows_what_may_be_left_out(tmp_path: Path) -> None:
    generator = program("OPENAPI_TYPESCRIPT", "openapi-typescript")
    types = tmp_path / "types.ts"
    run(generator, FILE, "-o", types)
    text = types.read_text()
    for name in ("cones", "num_candidates", "max_object_size"):
        assert f" {name}?:" in text
        assert f" {name}:" not in text
