"""The one table of errors, walked on both transports."""

import inspect

import grpc
import httpx
import numpy as np
import pytest
from grpc import aio

import edgegrasp_model.errors
import edgegrasp_service.errors
from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, UnknownModel
from edgegrasp_service.core import GraspService
from edgegrasp_service.dummy import DummyCatalogue
from edgegrasp_service.errors import (
    STATUS,
    Overloaded,
    _FieldError,
    kind_of,
    report,
)
from edgegrasp_service.grpc_server import GrpcServer
from edgegrasp_service.http_app import create_app
from edgegrasp_service.settings import Settings

SMALL = Settings(max_points=100, max_body_bytes=10_000)

# Errors of starting up: no request ever meets them.
START_UP = {
    "InvalidCheckpoint",
    "InvalidDevice",
    "InvalidGripper",
    "InvalidSettings",
    "AddressInUse",
}


class Failing:
    """A detector that raises what it is told to."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    def get(self, name: str = "") -> "Failing":
        return self

    def prepare(self, cloud: object, options: object) -> None:
        raise self._error

    def describe(self) -> list[dict[str, object]]:
        raise self._error

    def warm_up(self) -> None: ...


def example(kind: type[Exception]) -> Exception:
    if kind is UnknownModel:
        return UnknownModel("wanted", ["a", "b"])
    if kind is Overloaded:
        return Overloaded("What happened.", 7.0)
    if issubclass(kind, InvalidRequest | _FieldError):
        return kind("cloud", "a value", "Fix it.")
    return kind("What happened.")


async def ask(error: Exception) -> tuple[httpx.Response, aio.AioRpcError]:
    service = GraspService(lambda: Failing(error), SMALL)
    await service.start()
    transport = httpx.ASGITransport(create_app(service), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://test") as http:
        response = await http.post("/v1/grasps", json={"points": [[0, 0, 0]]})
    server = GrpcServer(service, "127.0.0.1", 0)
    await server.start()
    async with aio.insecure_channel(server.address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        with pytest.raises(aio.AioRpcError) as caught:
            await stub.DetectGrasps(grasp_pb2.DetectGraspsRequest(points=bytes(12)))
    await server.stop(0)
    service.close()
    return response, caught.value


@pytest.mark.parametrize("kind", STATUS, ids=kind_of)
async def test_every_error_of_the_table(kind: type[Exception]) -> None:
    error = example(kind)
    response, status = await ask(error)
    code, http_status = STATUS[kind]
    assert (response.status_code, status.code()) == (http_status, code)
    problem = response.json()
    trailers = dict(status.trailing_metadata())
    detail = grasp_pb2.ErrorDetail.FromString(trailers["edgegrasp-error-bin"])
    assert problem["type"] == f"urn:edgegrasp:error:{detail.kind}"
    assert detail.kind == kind_of(kind)
    assert problem["detail"] == status.details()
    told = (problem["field"], problem["value"], problem["fix"])
    assert told == (detail.field, detail.value, detail.fix)
    retry_after = detail.retry_after if detail.HasField("retry_after") else None
    assert problem["retry_after"] == retry_after == (7.0 if kind is Overloaded else None)
    assert response.headers.get("retry-after") == ("7" if kind is Overloaded else None)
    if hasattr(error, "fix"):
        assert told == ("cloud", "a value", "Fix it.")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (ZeroDivisionError("secret"), (500, grpc.StatusCode.INTERNAL)),
        (MemoryError("secret"), (503, grpc.StatusCode.UNAVAILABLE)),
        (RuntimeError("can't allocate memory: secret"), (503, grpc.StatusCode.UNAVAILABLE)),
    ],
)
async def test_unforeseen_errors_tell_nothing(error: Exception, expected: object) -> None:
    response, status = await ask(error)
    assert (response.status_code, status.code()) == expected
    assert "secret" not in response.text + (status.details() or "")


def test_every_error_is_in_the_table() -> None:
    for module in (edgegrasp_model.errors, edgegrasp_service.errors):
        for name, kind in inspect.getmembers(module, inspect.isclass):
            abstract = kind.__subclasses__() or not issubclass(kind, EdgeGraspError)
            assert abstract or name in START_UP or kind in STATUS, f"{name} has no status"


def test_report_of_an_unknown_model() -> None:
    told = report(UnknownModel("x", ["b", "a"]))
    assert (told.field, told.value, told.fix) == ("options.model", "'x'", "Use one of: a, b.")


async def test_a_failed_detection_leaves_the_service_working() -> None:
    class Once(DummyCatalogue):
        failed = False

        def get(self, name: str = ""):
            if not Once.failed:
                Once.failed = True
                return Failing(ValueError("once"))
            return super().get(name)

    service = GraspService(Once, SMALL)
    await service.start()
    transport = httpx.ASGITransport(create_app(service))
    body = {"points": np.zeros((40, 3)).tolist()}
    async with httpx.AsyncClient(transport=transport, base_url="http://test") as http:
        assert (await http.post("/v1/grasps", json=body)).status_code == 500
        assert (await http.post("/v1/grasps", json=body)).status_code == 200
    service.close()


def test_start_up_errors_exist() -> None:
    found = {
        name
        for module in (edgegrasp_model.errors, edgegrasp_service.errors)
        for name in vars(module)
    }
    assert found >= START_UP
