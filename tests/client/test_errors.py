"""What goes wrong is the same exception over either transport, or is tried again."""

import asyncio
import itertools
import socket
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, NamedTuple

import grpc
import httpx
import numpy as np
import pytest
from tests.programs import free_ports

import edgegrasp_client as api
from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import AsyncGraspClient, GraspClient, StreamRequest, Tls, connection


class Problem(NamedTuple):
    """An error as a server describes it; one without a kind is not described."""

    kind: str
    code: grpc.StatusCode
    status: int
    retry_after: float | None = None


class FailingServer(grasp_pb2_grpc.GraspServiceServicer):
    """Answers with one problem after the other, then with detections without grasps."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.calls = 0
        self._problems = iter(problems)

    def _problem(self) -> Problem | None:
        self.calls += 1
        return next(self._problems, None)

    def DetectGrasps(self, request: Any, context: Any) -> Any:  # noqa: N802
        if (problem := self._problem()) is not None:
            detail = grasp_pb2.ErrorDetail(kind=problem.kind, field="f", value="v", fix="x")
            if problem.retry_after is not None:
                detail.retry_after = problem.retry_after
            described = detail.SerializeToString() if problem.kind else b"\xff\xff"
            context.set_trailing_metadata((("edgegrasp-error-bin", described),))
            context.abort(problem.code, "what happened")
        return grasp_pb2.DetectGraspsResponse(model="fake", gripper={"name": "fake"})

    def DetectGraspsStream(self, requests: Any, context: Any) -> Iterator[Any]:  # noqa: N802
        for request in requests:
            detection = self.DetectGrasps(request.request, context)
            yield grasp_pb2.DetectGraspsStreamResponse(detection=detection)

    def respond(self, request: httpx.Request) -> httpx.Response:
        if (problem := self._problem()) is None:
            found = dict.fromkeys(("debug", "support", "tracking")) | {"up": [0, 0, 1]}
            found |= {"grasps": [], "warnings": [], "objects": [], "counts": {}, "seconds": {}}
            found |= {"model": "fake", "gripper": {"name": "fake", "palm_z": 0.0, "tip_z": 0.1}}
            return httpx.Response(200, json=found)
        if not problem.kind:
            return httpx.Response(problem.status, text="<html>")
        document = {"detail": "what happened", "field": "f", "value": "v", "fix": "x"}
        document |= {"type": f"urn:edgegrasp:error:{problem.kind}"}
        return httpx.Response(problem.status, json=document | {"retry_after": problem.retry_after})


def put_in_place_of_http(monkeypatch: pytest.MonkeyPatch, respond: Any) -> None:
    """Answers come from a function, and from no network."""
    fake = httpx.MockTransport(respond).handle_async_request
    monkeypatch.setattr(httpx.AsyncHTTPTransport, "handle_async_request", fake)


@pytest.fixture
def failing(transport: str, make_client: Any, monkeypatch: Any) -> Iterator[Any]:
    """Makes a server with problems, and a client of it."""
    started = []

    def make(problems: Iterable[Problem], **arguments: Any) -> tuple[Any, FailingServer]:
        failing = FailingServer(problems)
        if transport == "rest":
            put_in_place_of_http(monkeypatch, failing.respond)
            return make_client("http://failing", **arguments), failing
        started.append(grpc.server(ThreadPoolExecutor(2)))
        grasp_pb2_grpc.add_GraspServiceServicer_to_server(failing, started[-1])
        port = started[-1].add_insecure_port("127.0.0.1:0")
        started[-1].start()
        return make_client(f"127.0.0.1:{port}", **arguments), failing

    yield make
    for server in started:
        server.stop(0).wait()


Code = grpc.StatusCode
BUSY = Problem("overloaded", Code.RESOURCE_EXHAUSTED, 429, retry_after=0.01)
AWAY = Problem("not-ready", Code.UNAVAILABLE, 503)
LOST = Problem("worker-lost", Code.UNAVAILABLE, 503)
INVALID = Problem("invalid-request", Code.INVALID_ARGUMENT, 400)

DESCRIBED = [
    (INVALID, api.InvalidRequestError),
    (Problem("unsupported-media-type", Code.INVALID_ARGUMENT, 415), api.InvalidRequestError),
    (Problem("headers-too-large", Code.RESOURCE_EXHAUSTED, 431), api.InvalidRequestError),
    (Problem("start-collision", Code.INVALID_ARGUMENT, 400), api.StartCollisionError),
    (Problem("unknown-model", Code.NOT_FOUND, 404), api.UnknownModelError),
    (Problem("payload-too-large", Code.RESOURCE_EXHAUSTED, 413), api.PayloadTooLargeError),
    (Problem("unauthenticated", Code.UNAUTHENTICATED, 401), api.AccessDeniedError),
    (Problem("permission-denied", Code.PERMISSION_DENIED, 403), api.AccessDeniedError),
    (Problem("detector-failed", Code.INTERNAL, 500), api.ServerFailedError),
    (AWAY, api.ServerUnavailableError),
    (BUSY, api.OverloadedError),
    (LOST, api.WorkerLostError),
    (Problem("harmful-request", Code.INVALID_ARGUMENT, 422), api.InvalidRequestError),
    (Problem("deadline-exceeded", Code.DEADLINE_EXCEEDED, 504), api.DeadlineError),
    (Problem("teapot", Code.UNKNOWN, 418), api.ProtocolError),
]


@pytest.mark.parametrize(("problem", "expected"), DESCRIBED, ids=lambda value: str(value)[:40])
def test_described_errors_are_the_same_exception(problem, expected, failing, cloud) -> None:
    client, server = failing([problem], retry=False)
    with pytest.raises(expected, match="what happened") as caught:
        client.detect(cloud)
    assert type(caught.value) is expected
    assert server.calls == 1
    if isinstance(caught.value, api.InvalidRequestError):
        assert vars(caught.value) == {"field": "f", "value": "v", "fix": "x"}
    if isinstance(caught.value, api.OverloadedError):
        assert caught.value.retry_after == BUSY.retry_after


@pytest.mark.parametrize(
    ("transport", "code", "expected"),
    [
        ("grpc", Code.UNIMPLEMENTED, api.ProtocolError),
        ("grpc", Code.RESOURCE_EXHAUSTED, api.PayloadTooLargeError),
        ("grpc", Code.UNAVAILABLE, api.ServerUnavailableError),
        ("grpc", Code.DEADLINE_EXCEEDED, api.DeadlineError),
        ("grpc", Code.INTERNAL, api.ServerUnavailableError),
        ("grpc", Code.UNKNOWN, api.ServerFailedError),
        ("rest", 200, api.ProtocolError),
        ("rest", 404, api.ProtocolError),
        ("rest", 413, api.PayloadTooLargeError),
        ("rest", 429, api.OverloadedError),
        ("rest", 500, api.ServerUnavailableError),
        ("rest", 502, api.ServerUnavailableError),
    ],
)
def test_errors_of_proxies_and_other_servers_are_classified(code, expected, failing, cloud) -> None:
    client, _ = failing(itertools.repeat(Problem("", code, code)), retry=False)
    with pytest.raises(api.GraspClientError) as caught:
        client.detect(cloud)
    assert type(caught.value) is expected
    assert not client.ready() or code == 200


def test_answers_of_another_server_and_of_a_busy_proxy(make_client, monkeypatch, cloud) -> None:
    answers = [httpx.Response(503, headers={"retry-after": "7"})]
    put_in_place_of_http(monkeypatch, lambda request: answers[-1])
    client = make_client("http://elsewhere", timeout=5)
    with pytest.raises(api.OverloadedError) as caught:
        client.detect(cloud)
    assert caught.value.retry_after == 7
    for body in ([], {"grasps": [{}]}, {"grasps": [3]}, {"grasps": 3}, {"detail": "Not Found"}):
        answers.append(httpx.Response(200, json=body))
        with pytest.raises(api.ProtocolError, match="not the answer of a grasp service"):
            client.detect(cloud)


@pytest.fixture(autouse=True)
def hasty_retries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "FIRST_DELAY", 0.001)


RESTARTED = [None] + [AWAY] * connection.RETRIES  # it answered before


BUSY_FIRST = [[BUSY] * 8 + [LOST], [BUSY] * 4 + [AWAY]]


@pytest.mark.parametrize("problems", [[AWAY, BUSY, LOST], *BUSY_FIRST, RESTARTED])
def test_a_server_that_is_away_or_busy_is_asked_again(problems: Any, failing, cloud) -> None:
    client, server = failing(problems)
    while server.calls < len(problems):
        assert client.detect(cloud).model == "fake"
    assert server.calls == len(problems) + 1


@pytest.mark.parametrize(
    ("problem", "arguments", "calls"),
    [
        (AWAY, {}, connection.FEW_RETRIES + 1),
        (AWAY, {"retry": False}, 1),
        (BUSY, {"retry": False}, 1),
        (BUSY._replace(retry_after=1000.0), {"timeout": 30}, 1),
        (INVALID, {}, 1),
        (LOST, {}, 2),
        (Problem("deadline-exceeded", Code.DEADLINE_EXCEEDED, 504), {}, 1),
        (Problem("detector-failed", Code.INTERNAL, 500), {}, 1),
    ],
)
def test_a_call_is_tried_as_often_as_it_can_help(problem, arguments, calls, failing, cloud) -> None:
    client, server = failing(itertools.repeat(problem), **arguments)
    with pytest.raises(dict(DESCRIBED).get(problem, api.GraspClientError)):
        client.detect(cloud)
    assert server.calls == calls


def test_requests_of_a_stream_are_sent_once(failing, cloud) -> None:
    client, server = failing([AWAY])
    with pytest.raises(api.ServerUnavailableError):
        [answer.result() for answer in client.detect_stream([StreamRequest(cloud)])]
    assert server.calls == 1


@pytest.mark.parametrize("scheme", ["", "http://"])
def test_without_a_server_calls_fail_and_waiting_ends(scheme: str, make_client, cloud) -> None:
    address = f"{scheme}127.0.0.1:{free_ports(1)[0]}"
    client = make_client(address)
    for call in (client.models, lambda: client.detect(cloud)):
        with pytest.raises(api.ServerUnavailableError, match=f"{address} .*`edgegrasp serve`"):
            call()
    assert not client.ready()
    with pytest.raises(api.DeadlineError, match=r"not ready within 0\.2 s"):
        client.wait_until_ready(0.2)


def test_a_deadline_ends_a_call_or_one_request_of_a_stream(start_dummy, make_client, cloud) -> None:
    with start_dummy(seconds=0.5) as server:
        for address in (server.grpc_address, server.http_url):
            client = make_client(address, timeout=0.1)
            with pytest.raises(api.DeadlineError):
                client.detect(cloud)
            assert client.detect(cloud, timeout=20).grasps
            requests = [StreamRequest(cloud, timeout=0.1), StreamRequest(cloud)]
            hasty, patient = client.detect_stream(requests, timeout=20.0)
            assert isinstance(hasty.error, api.DeadlineError)
            assert patient.error is None


def test_an_address_that_is_none_or_without_tls_is_refused() -> None:
    for address in ("http://[::1", "http://host:port", "http://host:99999"):
        with pytest.raises(api.InvalidRequestError, match="address: got "):
            GraspClient(address)
    for address in ("http://127.0.0.1:8000", "http+unix:/run/http.sock"):
        with pytest.raises(api.InvalidRequestError, match="tls: got a Tls for http"):
            GraspClient(address, tls=Tls(), token="secret")


async def test_closing_ends_a_call_with_an_error(start_dummy, transport: str, cloud) -> None:
    with start_dummy(seconds=2.0) as server:
        client = AsyncGraspClient(server.address(transport))
        call = asyncio.create_task(client.detect(cloud))
        await asyncio.sleep(0.5)
        await client.close()
        with pytest.raises(api.GraspClientError):
            await call


async def test_a_retry_that_starts_too_late_is_refused_as_the_server_is(monkeypatch) -> None:
    sleep = asyncio.sleep
    monkeypatch.setattr(asyncio, "sleep", lambda _: sleep(1.0))
    with pytest.raises((api.DeadlineError, api.ServerUnavailableError)):
        await AsyncGraspClient(f"127.0.0.1:{free_ports(1)[0]}", timeout=0.5).models()


def test_a_closed_client_says_so(client, cloud) -> None:
    begun = client.detect_stream(itertools.repeat(StreamRequest(cloud)))
    next(begun)
    client.close()
    with pytest.raises(api.GraspClientError, match="closed"):
        all(answer.result() for answer in begun)
    stream = client.detect_stream([StreamRequest(cloud)])
    for call in (client.models, client.ready, client.wait_until_ready, lambda: next(stream)):
        with pytest.raises(api.GraspClientError, match="closed"):
            call()
    client.close()


def test_a_timeout_may_be_endless_but_is_a_number(client, cloud) -> None:
    endless = float("inf")
    (answer,) = client.detect_stream([StreamRequest(cloud, timeout=endless)], timeout=endless)
    assert answer.result().grasps
    assert client.detect(cloud, timeout=endless).grasps
    assert client.ready(timeout=endless)
    for call in (client.detect, StreamRequest):
        for none in (float("nan"), 0.0, -1.0):
            with pytest.raises(api.InvalidRequestError, match=f"timeout: got {none}"):
                call(cloud, timeout=none)


def test_a_proxy_is_not_asked_for_this_machine(dummy_server, transport, monkeypatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    with GraspClient(dummy_server.address(transport)) as client:
        assert client.models()


@pytest.mark.parametrize("size", [4_200_000, 9_000_000])  # the latter is over what gRPC reads
def test_a_cloud_that_is_too_large_is_refused(size: int, client) -> None:
    with pytest.raises(api.PayloadTooLargeError):
        client.detect(np.zeros((size, 3), np.float32))
    assert client.ready()


def test_a_rest_answer_that_trickles_in_does_not_outlast_the_timeout() -> None:
    def trickle(listening: socket.socket) -> None:
        with listening.accept()[0] as taken, suppress(OSError):
            taken.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: 100\r\n\r\n")
            for _ in range(100):
                taken.sendall(b" ")
                time.sleep(0.1)

    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor() as pool:
        pool.submit(trickle, listening)
        address = f"http://127.0.0.1:{listening.getsockname()[1]}"
        with GraspClient(address, timeout=1.0) as client, pytest.raises(api.DeadlineError):
            client.models()
