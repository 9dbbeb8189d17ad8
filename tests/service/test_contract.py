"""The same request gives the same answer, or error, whatever transport and format it comes by."""

import inspect
import json
from collections.abc import Iterator
from typing import Any

import grpc
import httpx
import jsonschema
import numpy as np
import pytest
from google.protobuf.any_pb2 import Any as AnyMessage
from google.rpc.error_details_pb2 import BadRequest, ErrorInfo, RetryInfo
from google.rpc.status_pb2 import Status
from grpc import aio
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from tests.cloud_files import npy, npz, png, xyz

import edgegrasp_model.errors
import edgegrasp_service.errors
from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import STATUS, kind_of
from edgegrasp_service.front.http import OPENAPI_DOCUMENT

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


def test_every_way_in_gives_the_same_grasps(cloud: np.ndarray, channel, http) -> None:
    detect = grasp_pb2_grpc.GraspServiceStub(channel).DetectGrasps
    text = json.dumps(OPTIONS)
    posted: list[dict[str, Any]] = [{"json": {"points": cloud.tolist(), "options": OPTIONS}}]
    messages = [{"points": cloud.tobytes()}]
    files = {"npy": npy(cloud), "npz": npz(points=cloud), "xyz": xyz(cloud)}
    for file_format, data in files.items():
        media_type = f"application/x-{file_format}"
        parts = {"cloud": ("cloud", data, media_type), "options": (None, text, "application/json")}
        messages.append({"encoded": {"format": file_format, "data": data}})
        posted += [
            {"content": data, "headers": {"content-type": media_type}, "params": OPTIONS},
            {"files": {"cloud": (f"cloud.{file_format}", data)}, "data": {"options": text}},
            {"files": parts},
        ]
    requests = [grasp_pb2.DetectGraspsRequest(options=OPTIONS, **fields) for fields in messages]
    answers = [detect(request) for request in requests]
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
    images = {"depth": ("depth.png", png(depth)), "segment_ids": ("blob", png(labels), "image/png")}
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
        assert check(http.post("/v1/grasps", files=images, data=parts), "Problem")["field"] == field


def check(answer: httpx.Response, name: str) -> Any:
    """The JSON of an answer, which is as its schema says."""
    jsonschema.validate(answer.json(), OPENAPI_DOCUMENT | {"$ref": f"#/components/schemas/{name}"})
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


# Errors of starting up: no request ever meets them.
START_UP = {"InvalidCheckpoint", "InvalidDevice", "InvalidGripper", "InvalidSettings"}
START_UP |= {"AddressInUse"}


async def ask(running, cloud, fault: str) -> tuple[httpx.Response, aio.AioRpcError]:
    """What both transports tell of a fault."""
    running.stages.fail("prepare", fault)
    response = await running.http().post("/v1/grasps", json={"points": cloud.tolist()})
    running.stages.fail("prepare", fault)
    with pytest.raises(aio.AioRpcError) as caught:
        await running.stub().DetectGrasps(grasp_pb2.DetectGraspsRequest(points=cloud.tobytes()))
    return response, caught.value


async def test_every_error_of_the_table(running, cloud) -> None:
    for number, (kind, (code, http_status)) in enumerate(STATUS.items(), 1):
        response, status = await ask(running, cloud, kind_of(kind))
        assert (response.status_code, status.code().name) == (http_status, code)
        problem = response.json()
        trailers = dict(status.trailing_metadata())
        detail = grasp_pb2.ErrorDetail.FromString(trailers["edgegrasp-error-bin"])
        assert problem["type"] == f"urn:edgegrasp:error:{detail.kind}"
        assert detail.kind == kind_of(kind)
        assert problem["detail"] == status.details()
        told = (problem["field"], problem["value"], problem["fix"])
        assert told == (detail.field, detail.value, detail.fix)
        retry_after = detail.retry_after if detail.HasField("retry_after") else None
        busy = kind_of(kind) == "overloaded"
        assert problem["retry_after"] == retry_after == (7.0 if busy else None)
        assert response.headers.get("retry-after") == ("7" if busy else None)
        check_google_details(trailers["grpc-status-details-bin"], detail)
        await running.until(lambda number=number: len(running.calls) == 2 * number)
        assert running.ended[-2:] == [kind_of(kind)] * 2
    running.stages.folder.joinpath("fault-prepare").unlink(missing_ok=True)
    assert (await running.connect("grpc").detect(cloud)).fine


def check_google_details(data: bytes, ours: grasp_pb2.ErrorDetail) -> None:
    """google.rpc's details say what ours do."""

    def unpacked(kind: type) -> list:
        found = []
        for envelope in Status.FromString(data).details:
            message = kind()
            assert isinstance(envelope, AnyMessage)
            if envelope.Unpack(message):
                found.append(message)
        return found

    (info,) = unpacked(ErrorInfo)
    assert (info.domain, info.reason) == ("edgegrasp", ours.kind.upper().replace("-", "_"))
    delays = [retry.retry_delay.ToTimedelta().total_seconds() for retry in unpacked(RetryInfo)]
    assert delays == ([ours.retry_after] if ours.HasField("retry_after") else [])
    fields = [each.field for bad in unpacked(BadRequest) for each in bad.field_violations]
    assert fields == ([ours.field] if ours.field else [])


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("ValueError", (500, grpc.StatusCode.INTERNAL)),
        ("MemoryError", (503, grpc.StatusCode.UNAVAILABLE)),
    ],
)
async def test_unforeseen_errors_tell_nothing(running, cloud, fault: str, expected, caplog) -> None:
    response, status = await ask(running, cloud, fault)
    assert (response.status_code, status.code()) == expected
    assert "secret" not in response.text + (status.details() or "")
    await running.until(
        lambda: any("secret" in vars(each).get("traceback", "") for each in caplog.records)
    )


def test_every_error_is_in_the_table() -> None:
    for module in (edgegrasp_model.errors, edgegrasp_service.errors):
        for name, kind in inspect.getmembers(module, inspect.isclass):
            abstract = kind.__subclasses__() or not issubclass(kind, EdgeGraspError)
            assert abstract or name in START_UP or kind in STATUS, f"{name} has no status"
