"""The same request gives the same answer, whatever transport and format it comes by."""

import io
import json
from typing import Any

import httpx
import numpy as np
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from edgegrasp.v1 import grasp_pb2
from edgegrasp_service.schemas import DetectionBody, ModelsBody, ScoringBody

OPTIONS = {"seed": 5, "num_approach_points": 20, "top_k": 7}


def files_of(cloud: np.ndarray) -> dict[str, bytes]:
    npy, npz = io.BytesIO(), io.BytesIO()
    np.save(npy, cloud)
    np.savez_compressed(npz, points=cloud)
    ply = "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\n"
    ply += "property float y\nproperty float z\nend_header\n"
    pcd = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\n"
    pcd += "POINTS {0}\nDATA binary\n"
    return {
        "npy": npy.getvalue(),
        "npz": npz.getvalue(),
        "ply": ply.format(len(cloud)).encode() + cloud.tobytes(),
        "pcd": pcd.format(len(cloud)).encode() + cloud.tobytes(),
        "xyz": "\n".join(f"{x!r} {y!r} {z!r}" for x, y, z in cloud.tolist()).encode(),
    }


def grasps_of(answer: Any) -> list[dict[str, Any]]:
    """The grasps of either transport, as JSON values of which floats compare exactly."""
    if isinstance(answer.body, dict):
        return answer.body["grasps"]
    found = []
    for grasp in answer.body.grasps:
        fields = {field.name: getattr(grasp, field.name) for field in grasp.DESCRIPTOR.fields}
        for name, value in fields.items():
            if name.startswith("T_"):
                fields[name] = [list(value[row : row + 4]) for row in range(0, 16, 4)]
            elif not isinstance(value, float | bool):
                fields[name] = list(value)
        found.append(fields)
    return found


def test_every_way_in_gives_the_same_grasps(cloud: np.ndarray, raw_grpc, raw_rest) -> None:
    message = grasp_pb2.DetectOptions(**OPTIONS)
    answers = [
        raw_grpc.request(points=cloud.tobytes(), options=message),
        raw_rest.post(json={"points": cloud.tolist(), "options": OPTIONS}),
    ]
    for file_format, data in files_of(cloud).items():
        upload = {"cloud": (f"cloud.{file_format}", data)}
        part = {"options": json.dumps(OPTIONS)}
        typed = {
            "cloud": ("cloud", data, f"application/x-{file_format}"),
            "options": (None, json.dumps(OPTIONS), "application/json"),
        }
        answers += [
            raw_grpc.file(file_format, data, **OPTIONS),
            raw_rest.file(file_format, data, **OPTIONS),
            raw_rest.post(files=upload, data=part),
            raw_rest.post(files=typed),
        ]
    expected = grasps_of(answers[0])
    assert len(expected) == 7
    assert all(grasps_of(answer) == expected for answer in answers)


def test_debug_and_scoring_are_as_documented(cloud: np.ndarray, raw_rest) -> None:
    body = {"points": cloud.tolist(), "options": {"debug": True}}
    debug = DetectionBody.model_validate(raw_rest.post(json=body).body).debug
    assert debug is not None
    assert len(debug.outcome) == len(debug.score) == len(debug.T_cloud_hand) == 32
    assert debug.score[-1] is None
    body = {"points": cloud.tolist(), "edges": [[0, 1], [3, 3]]}
    scoring = ScoringBody.model_validate(raw_rest.post("/v1/grasps:score", json=body).body)
    assert [evaluation.grasp is None for evaluation in scoring.evaluations] == [False, True]
    ModelsBody.model_validate(raw_rest.http.get("/v1/models").json())


def test_nothing_found_is_a_success(cloud: np.ndarray, raw) -> None:
    answer = raw.file("npy", files_of(cloud)["npy"], min_score=1.0)
    assert answer.code in ("OK", "200")
    assert grasps_of(answer) == []
    counts = answer.body["counts"] if raw.name == "rest" else answer.body.counts
    assert (counts["points"], counts["returned"]) == (500, 0)


def test_probes(dummy_server, raw_grpc) -> None:
    for path in ("/health/live", "/health/ready", "/docs", "/openapi.json"):
        assert httpx.get(dummy_server.http_url + path).status_code == 200
    health = health_pb2_grpc.HealthStub(raw_grpc.channel)
    for name in ("", "edgegrasp.v1.GraspService"):
        request = health_pb2.HealthCheckRequest(service=name)
        assert health.Check(request).status == health_pb2.HealthCheckResponse.SERVING


def test_reflection_lists_the_service(raw_grpc) -> None:
    stub = reflection_pb2_grpc.ServerReflectionStub(raw_grpc.channel)
    request = reflection_pb2.ServerReflectionRequest(list_services="")
    answer = next(stub.ServerReflectionInfo(iter([request])))
    names = {service.name for service in answer.list_services_response.service}
    assert {"edgegrasp.v1.GraspService", "grpc.health.v1.Health"} <= names
