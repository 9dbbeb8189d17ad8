import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from typing import Any

import grpc
import httpx
import pytest

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.core import GraspService
from edgegrasp_service.server import Server
from edgegrasp_service.settings import load_settings


@dataclass
class Answer:
    code: str  # gRPC status name, or HTTP status
    kind: str
    detail: str
    field: str
    value: str
    fix: str
    body: Any = None


class RawGrpc:
    """Sends what a careless client might, and shows what comes back."""

    name = "grpc"

    def __init__(self, address: str) -> None:
        self.channel = grpc.insecure_channel(address, (("grpc.max_send_message_length", -1),))
        self._stub = grasp_pb2_grpc.GraspServiceStub(self.channel)

    def file(self, file_format: str, data: bytes, **options: Any) -> Answer:
        encoded = grasp_pb2.EncodedCloud(format=file_format, data=data)
        return self.request(encoded=encoded, options=grasp_pb2.DetectOptions(**options))

    def request(self, **fields: Any) -> Answer:
        return self.send(grasp_pb2.DetectGraspsRequest(**fields))

    def send(self, message: grasp_pb2.DetectGraspsRequest | grasp_pb2.ScoreGraspsRequest) -> Answer:
        scores = isinstance(message, grasp_pb2.ScoreGraspsRequest)
        call = self._stub.ScoreGrasps if scores else self._stub.DetectGrasps
        try:
            body = call(message, timeout=20)
        except grpc.RpcError as error:
            trailers = dict(error.trailing_metadata())
            detail = grasp_pb2.ErrorDetail.FromString(trailers["edgegrasp-error-bin"])
            told = (detail.kind, error.details(), detail.field, detail.value, detail.fix)
            return Answer(error.code().name, *told)
        return Answer("OK", "", "", "", "", "", body)

    def close(self) -> None:
        self.channel.close()


class RawRest:
    name = "rest"

    def __init__(self, address: str) -> None:
        self.http = httpx.Client(base_url=address, timeout=20)

    def file(self, file_format: str, data: bytes, **options: Any) -> Answer:
        headers = {"content-type": f"application/x-{file_format}"}
        return self.post(content=data, headers=headers, params=options)

    def post(self, path: str = "/v1/grasps", **request: Any) -> Answer:
        response = self.http.post(path, **request)
        body = response.json()
        if response.is_success:
            return Answer("200", "", "", "", "", "", body)
        assert response.headers["content-type"] == "application/problem+json"
        assert body["status"] == response.status_code
        assert body["title"]
        kind = body["type"].removeprefix("urn:edgegrasp:error:")
        told = (kind, body["detail"], body["field"], body["value"], body["fix"])
        return Answer(str(response.status_code), *told)

    def close(self) -> None:
        self.http.close()


@pytest.fixture
def raw_grpc(dummy_server) -> Iterator[RawGrpc]:
    raw = RawGrpc(dummy_server.grpc_address)
    yield raw
    raw.close()


@pytest.fixture
def raw_rest(dummy_server) -> Iterator[RawRest]:
    raw = RawRest(dummy_server.http_url)
    yield raw
    raw.close()


@pytest.fixture(params=["grpc", "rest"])
def raw(request: pytest.FixtureRequest) -> RawGrpc | RawRest:
    found: RawGrpc | RawRest = request.getfixturevalue(f"raw_{request.param}")
    return found


@contextlib.asynccontextmanager
async def a_server(service: GraspService | None = None, **given: Any) -> AsyncIterator[Server]:
    """A server in this event loop, on free ports, of dummies unless told otherwise."""
    defaults = {"backend": "dummy", "http_port": 0, "grpc_port": 0, "grace_seconds": 5.0}
    server = Server(load_settings(**(defaults | given)), service)
    ready, stop = asyncio.Event(), asyncio.Event()
    serving = asyncio.create_task(server.serve(stop, ready=ready.set))
    waiting = asyncio.create_task(ready.wait())
    await asyncio.wait([serving, waiting], return_when=asyncio.FIRST_COMPLETED)
    try:
        if serving.done():
            serving.result()
        yield server
    finally:
        waiting.cancel()
        stop.set()
        await asyncio.wait([serving])


@pytest.fixture
def serving() -> Callable[..., contextlib.AbstractAsyncContextManager[Server]]:
    return a_server
