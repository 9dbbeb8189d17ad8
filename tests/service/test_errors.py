"""The one table of errors, walked on both transports."""

import inspect

import grpc
import httpx
import pytest
from google.protobuf.any_pb2 import Any as AnyMessage
from google.rpc.error_details_pb2 import BadRequest, ErrorInfo, RetryInfo
from google.rpc.status_pb2 import Status
from grpc import aio

import edgegrasp_model.errors
import edgegrasp_service.errors
from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import STATUS, kind_of

# Errors of starting up: no request ever meets them.
START_UP = {
    "InvalidCheckpoint",
    "InvalidDevice",
    "InvalidGripper",
    "InvalidSettings",
    "AddressInUse",
}


async def ask(running, cloud) -> tuple[httpx.Response, aio.AioRpcError]:
    """What both transports tell of a fault; it is told to the next two requests."""
    fault = (running.stages.folder / "fault-prepare").read_text()
    response = await running.http().post("/v1/grasps", json={"points": cloud.tolist()})
    running.stages.fail("prepare", fault)
    with pytest.raises(aio.AioRpcError) as caught:
        await running.stub().DetectGrasps(grasp_pb2.DetectGraspsRequest(points=cloud.tobytes()))
    return response, caught.value


async def test_every_error_of_the_table(running, cloud) -> None:
    for number, (kind, (code, http_status)) in enumerate(STATUS.items(), 1):
        running.stages.fail("prepare", kind_of(kind))
        response, status = await ask(running, cloud)
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
    running.stages.fail("prepare", fault)
    response, status = await ask(running, cloud)
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
