"""Servers and clients: raw ones of one shared server, and controlled ones of servers in a test."""

import asyncio
import dataclasses
import os
import subprocess
import sys
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from grpc import aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import AsyncGraspClient
from edgegrasp_client.over_grpc import fill
from edgegrasp_service.errors import STATUS, kind_of
from edgegrasp_service.front.http import METHODS
from edgegrasp_service.observability import Call
from edgegrasp_service.server import Server
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.process import ONE_THREAD

PATIENCE = 30  # seconds; longer than anything takes
USER = "user-token-0123456789"
ADMIN = "admin-token-0123456789"
WRONG = "wrong-token-0123456789"


@dataclass
class Reply:
    code: str  # gRPC status name, or HTTP status
    kind: str = ""
    field: str = ""
    retry_after: float | None = None
    detail: str = ""
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    digest: str = ""  # of the first weights, after a reload

    @property
    def fine(self) -> bool:
        return self.code in ("OK", "200")


class Raw:
    """A client that shows codes and errors as they are sent."""

    async def detect(self, points: np.ndarray, timeout=None, **options: Any) -> Reply:
        return await self.ask("DetectGrasps", timeout, points=points, options=options)

    async def score(self, points: np.ndarray, timeout: float | None = None) -> Reply:
        return await self.ask("ScoreGrasps", timeout, points=points, edges=[[0, 1]] * 3)

    async def reload(self, token: str | None = None) -> Reply:
        headers = {"authorization": f"Bearer {token}"} if token else {}
        return await self.ask("ReloadModels", None, headers)

    ask: Callable[..., Awaitable[Reply]]  # a method, with a timeout, headers and fields


class Grpc(Raw):
    def __init__(self, server: Server, *options: tuple[str, int]) -> None:
        options = (("grpc.max_send_message_length", -1), *options)
        self.channel = aio.insecure_channel(server.grpc_address, options)
        self.stub = grasp_pb2_grpc.GraspServiceStub(self.channel)

    async def ask(self, method: str, timeout: float | None, headers=(), **fields: Any) -> Reply:
        message, metadata = getattr(grasp_pb2, f"{method}Request")(), tuple(dict(headers).items())
        packed = {"points": fields["points"].tobytes()} if fields else {}
        fill(message, fields | packed, "request")
        try:
            answer = await getattr(self.stub, method)(message, timeout=timeout, metadata=metadata)
        except aio.AioRpcError as error:
            trailers = dict(error.trailing_metadata() or ())
            detail = grasp_pb2.ErrorDetail.FromString(trailers.get("edgegrasp-error-bin", b""))
            retry_after = detail.retry_after if detail.HasField("retry_after") else None
            told = error.code().name, detail.kind, detail.field, retry_after
            return Reply(*told, error.details() or "")
        if method == "ReloadModels":
            return Reply("OK", digest=answer.models[0].digest)
        return Reply("OK", counts=dict(answer.counts))

    async def close(self) -> None:
        await self.channel.close(None)


class Rest(Raw):
    def __init__(self, server: Server) -> None:
        limits = httpx.Limits(max_connections=None)
        self.http = httpx.AsyncClient(base_url=server.http_url, timeout=PATIENCE, limits=limits)

    async def ask(self, method: str, timeout: float | None, headers=(), **fields: Any) -> Reply:
        headers = dict(headers) | ({} if timeout is None else {"X-Request-Timeout": str(timeout)})
        path = next(path for path, name in METHODS.items() if name == method)
        body = fields | ({"points": fields["points"].tolist()} if fields else {})
        response = await self.http.post(path, json=body, headers=headers)
        found = response.json()
        if response.is_success:
            digest = found["models"][0]["digest"] if "models" in found else ""
            return Reply("200", counts=found.get("counts", {}), digest=digest)
        kind = found["type"].removeprefix("urn:edgegrasp:error:")
        retry_after = found["retry_after"]
        if retry_after is not None:
            assert response.headers["retry-after"] == str(int(retry_after))
        told = str(response.status_code), kind, found["field"], retry_after
        return Reply(*told, found["detail"])

    async def close(self) -> None:
        await self.http.aclose()


class Stages:
    """Tells the dummies of one server when to wait and fail; see fork_server.py."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "begun").touch()

    @property
    def begun(self) -> Counter[str]:
        return Counter((self.folder / "begun").read_text().split())

    def shut(self, stage: str) -> None:
        """Let a stage begin, and hold it there."""
        (self.folder / f"shut-{stage}").touch()

    def open(self, stage: str) -> None:
        (self.folder / f"shut-{stage}").unlink()

    def fail(self, stage: str, kind: str) -> None:
        """Let a stage fail, once; `weights` cannot be loaded until `mend`."""
        new = self.folder / f"new-{stage}"
        new.write_text(kind)
        new.replace(self.folder / f"fault-{stage}")

    def mend(self, stage: str) -> None:
        (self.folder / f"fault-{stage}").unlink()


@dataclass
class Running:
    server: Server
    stages: Stages
    calls: list[Call]  # that have ended, and had to do with grasps
    stop: asyncio.Event
    serving: "asyncio.Task[None]"
    clients: list[Grpc | Rest | AsyncGraspClient] = dataclasses.field(default_factory=list)

    @property
    def ended(self) -> list[str]:
        """The kind of each call's problem, or ""."""
        return ["" if call.problem is None else call.problem.kind for call in self.calls]

    @property
    def waiting(self) -> int:
        """Admitted requests that no worker has yet."""
        admission = self.server.service.admission
        return len(admission.calls) - admission.num_at_work

    async def until(self, condition: Callable[[], bool]) -> None:
        """Return once something is so."""
        async with asyncio.timeout(PATIENCE):
            while not condition():
                await asyncio.sleep(0.002)

    async def until_idle(self) -> None:
        """Return once no request is in the server, and no worker has a job."""
        admission, pool = self.server.service.admission, self.server.pool
        await self.until(lambda: not admission.calls and not any(w.answer for w in pool._workers))

    def connect(self, transport: str) -> "Grpc | Rest":
        """A client, until the test ends."""
        self.clients.append(Grpc(self.server) if transport == "grpc" else Rest(self.server))
        return self.clients[-1]

    def http(self) -> httpx.AsyncClient:
        """A client that knows no messages, until the test ends."""
        return self.connect("rest").http

    def channel(self, *options: tuple[str, int]) -> aio.Channel:
        """A connection of gRPC, until the test ends."""
        self.clients.append(Grpc(self.server, *options))
        return self.clients[-1].channel

    def stub(self) -> Any:
        """The calls of the service, until the test ends."""
        return self.connect("grpc").stub

    def ours(self, transport: str, **given: Any) -> AsyncGraspClient:
        """The client that ships, until the test ends."""
        self.clients.append(AsyncGraspClient(self.address(transport), **given))
        return self.clients[-1]

    def address(self, transport: str) -> str:
        return self.server.grpc_address if transport == "grpc" else self.server.http_url

    async def hold(self, request: Awaitable[Any], stage: str = "evaluate") -> "asyncio.Task[Any]":
        """Ask for something that stays in a stage until this is opened."""
        self.stages.shut(stage)
        task = asyncio.ensure_future(request)
        await self.until(lambda: self.stages.begun[stage] == 1)
        return task

    async def speak(self, data: bytes) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A connection to the HTTP port on which this has been sent."""
        host, port = self.server.http_url.removeprefix("http://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(data)
        return reader, writer

    def metrics(self) -> str:
        return self.server.metrics.page().decode()


Serve = Callable[..., Awaitable[Running]]

# Asks for a fork server, and lives until that ends: see fork_server.py.
ASK = """
import os, socket, sys
with socket.socket(socket.AF_UNIX) as asking:
    asking.connect(sys.argv[1])
    socket.send_fds(asking, ["\\n".join(sys.argv[2:]).encode()], [0])
    os.close(0)
    asking.recv(1)
"""


@pytest.fixture(scope="session")
def fork_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, ...]]:
    """The command of a fork server, but for its folder; one process imports for all of them."""
    path = str(tmp_path_factory.mktemp("fork_server") / "socket")
    command = [sys.executable, "-P", str(Path(__file__).parent / "fork_server.py"), path]
    environment = os.environ | dict.fromkeys(ONE_THREAD, "1")
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout.readline() == b"ready\n"
        yield (sys.executable, "-ISc", ASK, path)
        process.kill()


@pytest.fixture
async def begin(tmp_path, monkeypatch, fork_server) -> AsyncIterator[Serve]:
    """Begins servers of controlled dummies in this event loop, on free ports."""
    monkeypatch.setattr("edgegrasp_service.server.NOTICE_SECONDS", 0.0)
    running: list[Running] = []

    async def start(prepare=lambda stages: None, **given: Any) -> tuple[Running, asyncio.Event]:
        folder = tmp_path / f"stages-{len(running)}"
        folder.mkdir()
        stages, calls = Stages(folder), []
        prepare(stages)
        ours = {"http_port": 0, "grpc_port": 0, "grace_seconds": PATIENCE, "workers": 1}

        def note(call: Call) -> None:
            if call.method in ("DetectGrasps", "ScoreGrasps") or call.in_stream:
                calls.append(call)

        for name in ("token", "admin_token"):
            if tokens := given.pop(f"{name}s", None):
                given[f"{name}_file"] = folder / name
                (folder / name).write_text("\n".join(tokens))
        server = Server(Settings(**(ours | given)))
        server.pool.command = (*fork_server, str(folder))
        server.service.observers.append(note)
        ready, stop = asyncio.Event(), asyncio.Event()
        serving = asyncio.create_task(server.serve(stop, ready.set))
        running.append(Running(server, stages, calls, stop, serving))
        await running[-1].until(lambda: serving.done() or server.http_url != "")
        return running[-1], ready

    yield start
    for each in running:
        for client in each.clients:
            await client.close()
        each.stop.set()
        await asyncio.wait([each.serving])


@pytest.fixture
def serve(begin: Serve) -> Serve:
    """As `begin`, and they are ready."""

    async def start(**given: Any) -> Running:
        running, ready = await begin(**given)
        await running.until(lambda: ready.is_set() or running.serving.done())
        if running.serving.done():
            running.serving.result()
        return running

    return start


@pytest.fixture
async def running(serve: Serve) -> Running:
    """A server with the default settings, which is ready."""
    return await serve()


@pytest.fixture
def http(dummy_server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=dummy_server.http_url, timeout=PATIENCE) as http:
        yield http


def is_error(answer: Reply, kind: str) -> bool:
    """Whether an answer is the error of a kind, on whichever transport."""
    code, status = next(STATUS[error] for error in STATUS if kind_of(error) == kind)
    # A gRPC client whose deadline passed does not wait to hear of it.
    kinds = (kind, "") if kind == "deadline-exceeded" else (kind,)
    return answer.code in (code, str(status)) and answer.kind in kinds
