"""The same request gives the same answer, whatever transport and format it comes by."""

import json
from collections.abc import Iterator
from typing import Any

import grpc
import httpx
import jsonschema
import numpy as np
import pytest
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from tests.cloud_files import npy, npz, png, xyz

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.front.http import DOCUMENT

OPTIONS = {"seed": 5, "num_approach_points": 20, "top_k": 7}


def grasps_of(answer: Any) -> list[dict[str, Any]]:
    """The grasps of either transport, as JSON values of which floats compare exactly."""
    if isinstance(answer, dict):
        return answer["grasps"]
    found = []
    for grasp in answer.grasps:
        fields = {field.name: getattr(grasp, field.name) for field in grasp.DESCRIPTOR.fields}
        for name, value in fields.items():
            if name.startswith("T_"):
                fields[name] = [list(value[row : row + 4]) for row in range(0, 16, 4)]
            elif grasp.DESCRIPTOR.fields_by_name[name].has_presence:
                fields[name] = value if grasp.HasField(name) else None
            elif not isinstance(value, float | bool):
                fields[name] = list(value)
        found.append(fields)
    return found


@pytest.fixture
def channel(dummy_server) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(dummy_server.grpc_address) as channel:
        yield channel


@pytest.fixture
def http(dummy_server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=dummy_server.http_url, timeout=20) as http:
        yield http


def test_every_way_in_gives_the_same_grasps(cloud: np.ndarray, channel, http) -> None:
    detect = grasp_pb2_grpc.GraspServiceStub(channel).DetectGrasps
    text = json.dumps(OPTIONS)
    posted: list[dict[str, Any]] = [{"json": {"points": cloud.tolist(), "options": OPTIONS}}]
    messages = [{"points": cloud.tobytes()}]
    files = {"npy": npy(cloud), "npz": npz(points=cloud), "xyz": xyz(cloud)}
    for file_format, data in files.items():
        media_type = f"application/x-{file_format}"
        messages.append({"encoded": {"format": file_format, "data": data}})
        posted += [
            {"content": data, "headers": {"content-type": media_type}, "params": OPTIONS},
            {"files": {"cloud": (f"cloud.{file_format}", data)}, "data": {"options": text}},
            {
                "files": {
                    "cloud": ("cloud", data, media_type),
                    "options": (None, text, "application/json"),
                }
            },
        ]
    answers = [
        detect(grasp_pb2.DetectGraspsRequest(options=OPTIONS, **message)) for message in messages
    ]
    answers += [http.post("/v1/grasps", **request).json() for request in posted]
    expected = grasps_of(answers[0])
    assert len(expected) == 7
    assert all(grasps_of(answer) == expected for answer in answers)


def test_a_form_of_camera_files(http) -> None:
    depth = np.random.default_rng(0).integers(4000, 6000, (24, 32)).astype(np.uint16)
    camera = [60.0, 50.0, 15.5, 11.5]
    nested = [[60.0, 0, 15.5], [0, 50.0, 11.5], [0, 0, 1]]
    image = {"depth": (depth / 10000).tolist(), "intrinsics": camera}
    expected = http.post("/v1/grasps", json={"depth_images": [image]}).json()
    labels = (depth > 5000).astype(np.uint8)
    images = {"depth": ("depth.png", png(depth)), "segment_ids": ("labels.png", png(labels))}
    array = {"depth": ("depth.npy", npy(depth))}
    for files, text in ((images, "60,50,15.5,11.5"), (array, json.dumps(nested))):
        parts = {"intrinsics": text, "depth_scale": "0.0001"}
        answer = http.post("/v1/grasps", files=files, data=parts)
        assert answer.status_code == 200, answer.text
        np.testing.assert_allclose(
            [grasp["contact_point"] for grasp in answer.json()["grasps"]],
            [grasp["contact_point"] for grasp in expected["grasps"]],
            atol=1e-6,
        )
    for parts, field in (
        ({}, "depth_images.0.intrinsics"),
        ({"intrinsics": "60,50"}, "depth_images.0.intrinsics"),
        ({"intrinsics": "60,50,15.5,11.5", "depth_images": "[]"}, "depth_images"),
    ):
        problem = check(http.post("/v1/grasps", files=images, data=parts), "Problem")
        assert problem["field"] == field


def check(answer: httpx.Response, name: str) -> Any:
    """The JSON of an answer, which is as its schema says."""
    jsonschema.validate(answer.json(), DOCUMENT | {"$ref": f"#/components/schemas/{name}"})
    return answer.json()


def test_debug_and_scoring_are_as_documented(cloud: np.ndarray, http) -> None:
    body = {"points": cloud.tolist(), "options": {"debug": True}}
    debug = check(http.post("/v1/grasps", json=body), "Detection")["debug"]
    assert len(debug["outcome"]) == len(debug["score"]) == len(debug["T_cloud_hand"]) == 32
    assert debug["score"][-1] is None
    body = {"points": cloud.tolist(), "edges": [[0, 1], [3, 3]]}
    scoring = check(http.post("/v1/grasps:score", json=body), "Scoring")
    assert [evaluation["grasp"] is None for evaluation in scoring["evaluations"]] == [False, True]
    check(http.get("/v1/models"), "Models")
    check(http.get("/v1/robots"), "Robots")
    check(http.post("/v1/grasps", json={}), "Problem")


def test_reflection(channel) -> None:
    reflection = reflection_pb2_grpc.ServerReflectionStub(channel)
    listing = reflection_pb2.ServerReflectionRequest(list_services="")
    answer = next(reflection.ServerReflectionInfo(iter([listing])))
    names = {service.name for service in answer.list_services_response.service}
    assert {"edgegrasp.v1.GraspService", "grpc.health.v1.Health"} <= names
