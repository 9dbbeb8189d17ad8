"""A server in the test's own process, whose stages wait, fail and are noted as a test says."""

import asyncio
import dataclasses
import threading
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from grpc import aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.call import Call
from edgegrasp_service.core import GraspService
from edgegrasp_service.dummy import DummyBatch, DummyCatalogue
from edgegrasp_service.errors import ErrorReport
from edgegrasp_service.observer import Observer
from edgegrasp_service.server import Server
from edgegrasp_service.settings import Settings

PATIENCE = 20  # seconds; longer than anything takes


class Stages:
    """Hook of the dummy detector."""

    def __init__(self) -> None:
        self.begun: Counter[str] = Counter()
        self.batches: list[int] = []  # requests of each forward pass
        self.faults: dict[str, list[BaseException]] = {}
        self._gates: dict[str, threading.Event] = {}

    def __call__(self, stage: str, subject: object) -> None:
        if isinstance(subject, DummyBatch):
            self.batches.append(subject.requests)
        gate = self._gates.get(stage)
        self.begun[stage] += 1
        if faults := self.faults.get(stage):
            raise faults.pop()
        assert gate is None or gate.wait(PATIENCE), f"the gate of {stage} stayed shut"

    def shut(self, stage: str) -> None:
        """Let a stage begin, and hold it there."""
        self._gates[stage] = threading.Event()

    def open(self, stage: str) -> None:
        self._gates.pop(stage).set()


class Told(Observer):
    """Notes what it is told."""

    def __init__(self) -> None:
        self.ended: list[str] = []  # the kind of problem, or ""
        self.replaced: list[str] = []
        self.stages: Counter[str] = Counter()
        self.waiting = self.active = 0

    def finished(self, call: Call, problem: ErrorReport | None) -> None:
        self.ended.append("" if problem is None else problem.kind)

    def worker_replaced(self, reason: str) -> None:
        self.replaced.append(reason)

    def stage(self, call: Call, name: str, seconds: float) -> None:
        self.stages[name] += 1

    def places(self, active: int, waiting: int) -> None:
        self.active, self.waiting = active, waiting


@dataclass
class Answer:
    code: str  # gRPC status name, or HTTP status
    kind: str = ""
    field: str = ""
    retry_after: float | None = None
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    scores: list[float] = dataclasses.field(default_factory=list)

    @property
    def fine(self) -> bool:
        return self.code in ("OK", "200")


class Grpc:
    name = "grpc"

    def __init__(self, server: Server) -> None:
        options = (("grpc.max_send_message_length", -1),)
        self.channel = aio.insecure_channel(server.grpc_address, options)
        self.stub = grasp_pb2_grpc.GraspServiceStub(self.channel)

    async def detect(
        self, points: np.ndarray, timeout: float | None = None, **options: Any
    ) -> Answer:
        message = grasp_pb2.DetectGraspsRequest(
            points=points.tobytes(), options=grasp_pb2.DetectOptions(**options)
        )
        return await self._answer(self.stub.DetectGrasps, message, timeout)

    async def score(self, points: np.ndarray, timeout: float | None = None) -> Answer:
        edges = [grasp_pb2.Edge(approach_index=0, contact_index=1)] * 3
        message = grasp_pb2.ScoreGraspsRequest(points=points.tobytes(), edges=edges)
        return await self._answer(self.stub.ScoreGrasps, message, timeout)

    async def _answer(self, method: Any, message: Any, timeout: float | None) -> Answer:
        try:
            body = await method(message, timeout=timeout)
        except aio.AioRpcError as error:
            trailers = dict(error.trailing_metadata() or ())
            detail = grasp_pb2.ErrorDetail.FromString(trailers.get("edgegrasp-error-bin", b""))
            retry_after = detail.retry_after if detail.HasField("retry_after") else None
            return Answer(error.code().name, detail.kind, detail.field, retry_after)
        scores = [grasp.score for grasp in getattr(body, "grasps", [])]
        return Answer("OK", counts=dict(body.counts), scores=scores)

    async def close(self) -> None:
        await self.channel.close(None)


class Rest:
    name = "rest"

    def __init__(self, server: Server) -> None:
        self.url = server.http_url
        limits = httpx.Limits(max_connections=None)
        self.http = httpx.AsyncClient(base_url=self.url, timeout=PATIENCE, limits=limits)

    async def detect(
        self, points: np.ndarray, timeout: float | None = None, **options: Any
    ) -> Answer:
        return await self._answer("/v1/grasps", points, timeout, {"options": options})

    async def score(self, points: np.ndarray, timeout: float | None = None) -> Answer:
        return await self._answer("/v1/grasps:score", points, timeout, {"edges": [[0, 1]] * 3})

    async def _answer(
        self, path: str, points: np.ndarray, timeout: float | None, fields: dict[str, Any]
    ) -> Answer:
        headers = {} if timeout is None else {"X-Request-Timeout": str(timeout)}
        body = {"points": points.tolist()} | fields
        response = await self.http.post(path, json=body, headers=headers)
        found = response.json()
        if response.is_success:
            scores = [grasp["score"] for grasp in found.get("grasps", [])]
            return Answer("200", counts=found["counts"], scores=scores)
        kind = found["type"].removeprefix("urn:edgegrasp:error:")
        retry_after = found["retry_after"]
        if retry_after is not None:
            assert response.headers["retry-after"] == str(int(retry_after))
        return Answer(str(response.status_code), kind, found["field"], retry_after)

    async def close(self) -> None:
        await self.http.aclose()


@dataclass
class Running:
    service: GraspService
    server: Server
    stages: Stages
    told: Told
    stop: asyncio.Event
    serving: "asyncio.Task[None]"

    async def until(self, condition: Callable[[], bool]) -> None:
        """Return once something is so."""
        async with asyncio.timeout(PATIENCE):
            while not condition():
                await asyncio.sleep(0.002)

    async def until_empty(self) -> None:
        """Return once no thread works on any request."""
        assert await self.service.drain(PATIENCE)


Serve = Callable[..., Awaitable[Running]]


@pytest.fixture
async def serve(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Serve]:
    monkeypatch.setattr("edgegrasp_service.server.NOTICE_SECONDS", 0.0)
    running: list[Running] = []

    async def start(seconds: float = 0.0, **given: Any) -> Running:
        settings = Settings(http_port=0, grpc_port=0, grace_seconds=PATIENCE, **given)
        stages, told = Stages(), Told()
        service = GraspService(lambda: DummyCatalogue(seconds, stages), settings, told)
        server, stop, ready = Server(settings, service), asyncio.Event(), asyncio.Event()
        serving = asyncio.create_task(server.serve(stop, ready=ready.set))
        await ready.wait()
        running.append(Running(service, server, stages, told, stop, serving))
        return running[-1]

    yield start
    for each in running:
        each.stop.set()
        await each.serving


@pytest.fixture(params=["grpc", "rest"])
async def connect(
    request: pytest.FixtureRequest,
) -> AsyncIterator[Callable[[Running], Grpc | Rest]]:
    made: list[Grpc | Rest] = []

    def make(running: Running) -> Grpc | Rest:
        made.append((Grpc if request.param == "grpc" else Rest)(running.server))
        return made[-1]

    yield make
    for each in made:
        await each.close()


CODES = {
    "overloaded": (grpc.StatusCode.RESOURCE_EXHAUSTED, 429),
    "payload-too-large": (grpc.StatusCode.RESOURCE_EXHAUSTED, 413),
    "deadline-exceeded": (grpc.StatusCode.DEADLINE_EXCEEDED, 504),
    "worker-lost": (grpc.StatusCode.UNAVAILABLE, 503),
    "not-ready": (grpc.StatusCode.UNAVAILABLE, 503),
    "detector-failed": (grpc.StatusCode.INTERNAL, 500),
}


@pytest.fixture
def is_error() -> Callable[[Answer, str], bool]:
    """Whether an answer is the error of a kind, on whichever transport."""

    def check(answer: Answer, kind: str) -> bool:
        code, status = CODES[kind]
        # A gRPC client whose deadline passed does not wait to hear of it.
        kinds = (kind, "") if kind == "deadline-exceeded" else (kind,)
        return answer.code in (code.name, str(status)) and answer.kind in kinds

    return check
