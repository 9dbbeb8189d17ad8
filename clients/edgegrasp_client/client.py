"""The client for asyncio, and the synchronous one, which runs it in a thread."""

import asyncio
import os
import threading
import time
from collections import Counter
from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    AsyncIterator,
    Awaitable,
    Callable,
    Coroutine,
    Iterable,
    Iterator,
)
from concurrent.futures import CancelledError, Future
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec

from typing_extensions import Unpack

from edgegrasp_camera.arrays import Array
from edgegrasp_client import errors
from edgegrasp_client.connection import RETRIES, Tls, checked_timeout, invalid, is_rest, retry_delay
from edgegrasp_client.over_grpc import GrpcTransport
from edgegrasp_client.over_rest import RestTransport
from edgegrasp_client.requests import Cloud, Request, RequestFields, StreamRequest
from edgegrasp_client.results import Answer, Model, Robot, StreamAnswer
from edgegrasp_results import Detection, Grasp, Scoring

DEFAULT_ADDRESS = "127.0.0.1:50051"
POLL_SECONDS = 0.1
CLOSED = "This client is closed, or another process made it. Make a new one."

Parameters = ParamSpec("Parameters")

_LOOPS: dict[int, asyncio.AbstractEventLoop] = {}  # by process
_STARTING = threading.Lock()
_ASKED_OVER_GRPC: set[int] = set()  # this process and its ancestors


class AsyncGraspClient(AbstractAsyncContextManager["AsyncGraspClient"]):
    """Client of one server; use it as an async context manager, or close it.

    Its methods raise GraspClientErrors: see edgegrasp_client.errors.

    Args:
        address: "host:port" for gRPC, "http://host:port" or "https://..." for REST; or the socket
            of a server on this machine: "unix:/run/edgegrasp/grpc.sock" for gRPC,
            "http+unix:/run/edgegrasp/http.sock" for REST.
        timeout: Seconds for one call with its retries, unless the call says otherwise.
        retry: Whether to retry, after short random delays, if the server is unavailable or busy or
            lost the request's worker. Requests of a stream are sent once.
        token: For a server that requires one; send it over TLS only.
        tls: How to verify the server; None: gRPC is not encrypted, and "https://..." trusts the
            authorities that httpx trusts.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        timeout: float = 30.0,
        retry: bool = True,
        token: str | None = None,
        tls: Tls | None = None,
    ) -> None:
        if not is_rest(address):
            _ASKED_OVER_GRPC.add(os.getpid())
            if len(_ASKED_OVER_GRPC) > 1:  # gRPC would wait forever
                fix = "Start processes by `spawn`, or ask over REST."
                raise invalid("address", "gRPC in a fork of a process that has used it", fix)
        self._timeout = checked_timeout(timeout)
        self._retry, self._closed, self._answered = retry, False, False
        self._pid = os.getpid()
        kind = RestTransport if is_rest(address) else GrpcTransport
        self._transport: RestTransport | GrpcTransport = kind(address, token, tls)

    async def detect(
        self,
        cloud: Cloud | None = None,
        *,
        timeout: float | None = None,
        **fields: Unpack[RequestFields],
    ) -> Detection:
        """Find grasps in a cloud.

        Args:
            cloud: (N, 3) float32 or float64, metres; (H, W, 3) with NaN for holes; the path of a
                .npy, .npz, .ply, .pcd or .xyz file; or an object with the attributes of
                sensor_msgs/PointCloud2.
            timeout: Seconds to wait; None: the client's own.
            fields: As in RequestFields: depth images instead of a cloud, arrays for its points, and
                options; an option left out has the server's default.
        """
        request = Request(cloud, fields)
        return await self._retried(partial(self._transport.request, Detection, request), timeout)

    async def score(
        self,
        cloud: Cloud | None = None,
        *,
        edges: Array | None = None,
        hand_poses: Array | None = None,
        timeout: float | None = None,
        **fields: Unpack[RequestFields],
    ) -> Scoring:
        """Score your own edges or hand poses (the paper's grasp evaluation function).

        `edges` are (M, 2) integers: rows of the approach and contact point in the cloud as sent. Or
        give `hand_poses`, (M, 4, 4) T_cloud_hand. Other arguments are those of `detect`.

        Returns:
            An evaluation for each edge or pose, in their order.
        """
        request = Request(cloud, fields, {"edges": edges, "hand_poses": hand_poses})
        return await self._retried(partial(self._transport.request, Scoring, request), timeout)

    def detect_stream(
        self,
        requests: AsyncIterable[StreamRequest] | Iterable[StreamRequest],
        *,
        timeout: float | None = None,
    ) -> AsyncGenerator[StreamAnswer, None]:
        """Find grasps in a sequence of clouds over one stream.

        The next request is sent while earlier ones are processed, but not faster than the server
        accepts them. Over REST, each request waits for the previous answer, on one connection.

        Args:
            requests: Read when they can be sent, in a separate thread if not an AsyncIterable; an
                exception from it ends the stream after the earlier requests are answered.
            timeout: Seconds for each request without its own; None: the client's.

        Yields:
            An answer to each request, in order; an error in one does not end the stream.

        Raises:
            GraspClientError: The stream itself failed, so that no more answers come.
        """
        source = requests if isinstance(requests, AsyncIterable) else _from_thread(requests)
        return self._transport.detect_stream(_sent(source, self._seconds(timeout)))

    async def models(self, *, timeout: float | None = None) -> list[Model]:
        """The weights that `model` can name."""
        return await self._retried(partial(self._transport.list_all, Model), timeout)

    async def robots(self, *, timeout: float | None = None) -> list[Robot]:
        """The robots that `robot` can name."""
        return await self._retried(partial(self._transport.list_all, Robot), timeout)

    async def record_outcome(
        self, detection: Detection, grasp: Grasp, held: bool, *, timeout: float | None = None
    ) -> None:
        """Report to a server with an `outcomes_file` whether a grasp held; REST only."""
        if held not in (True, False):
            raise invalid("held", repr(held), "Give True or False.")
        tried = {"model": detection.model, "score": float(grasp.score), "held": bool(held)}
        # Not retried: it may have been written.
        await self._transport.record_outcome(tried, self._seconds(timeout))

    async def ready(self, *, timeout: float | None = None) -> bool:
        """Whether the server can answer requests; False if it is unreachable or still loading."""
        return await self._transport.ready(self._seconds(timeout))

    async def wait_until_ready(self, timeout: float = 60.0) -> None:
        """Wait until the server can answer; raises DeadlineError after `timeout` seconds."""
        end = time.monotonic() + checked_timeout(timeout)
        while not await self.ready(timeout=max(POLL_SECONDS, end - time.monotonic())):
            if time.monotonic() >= end:
                raise errors.DeadlineError(f"The server was not ready within {timeout:g} s.")
            await asyncio.sleep(POLL_SECONDS)

    async def close(self) -> None:
        """Close the connection."""
        self._retry, self._closed = False, True
        await self._transport.close()

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def _seconds(self, timeout: float | None) -> float:
        """The timeout of a call; raises GraspClientError if it cannot be made any more."""
        if self._closed or self._pid != os.getpid():  # a fork would read its parent's answers
            raise errors.GraspClientError(CLOSED)
        return self._timeout if timeout is None else checked_timeout(timeout)

    async def _retried(
        self, call: Callable[[float], Awaitable[Answer]], timeout: float | None
    ) -> Answer:
        """Make a call, retrying while the server is unavailable or busy and time is left."""
        left = self._seconds(timeout)
        end = time.monotonic() + left
        attempts: Counter[type[Exception]] = Counter()
        while True:
            try:
                answer = await call(left)
                self._answered = True
                return answer
            except asyncio.CancelledError:  # gRPC cancels its calls when it is closed
                if not self._closed:
                    raise
                raise errors.GraspClientError(CLOSED) from None
            except errors.ServerUnavailableError as error:
                delay = retry_delay(error, attempts[type(error)], self._answered)
                if not self._retry or delay is None or time.monotonic() + delay >= end:
                    raise
                # The request itself may have killed the worker, so it is retried only once.
                lost = isinstance(error, errors.WorkerLostError)
                attempts[type(error)] += RETRIES if lost else 1
            await asyncio.sleep(delay)
            left = self._seconds(max(end - time.monotonic(), 1e-3))


async def _sent(
    requests: AsyncIterable[StreamRequest], timeout: float
) -> AsyncIterator[tuple[str, Request, float]]:
    """Each request with its id (default: its number, from 0) and timeout (default: `timeout`)."""
    number = 0
    async for each in requests:
        seconds = timeout if each.timeout is None else each.timeout
        yield each.request_id or str(number), each, seconds
        number += 1


# The synchronous client


def _waiting(
    method: Callable[Concatenate[AsyncGraspClient, Parameters], Coroutine[Any, Any, Answer]],
) -> "Callable[Concatenate[GraspClient, Parameters], Answer]":
    """Runs a method of the asynchronous client and returns its result."""

    @wraps(method)
    def call(self: "GraspClient", /, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Answer:
        return _run(method(self._client, *args, **kwargs))

    return call


class GraspClient(AbstractContextManager["GraspClient"]):
    """Client of one server; use it as a context manager, or close it. Thread-safe.

    Arguments and methods are those of `AsyncGraspClient`.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        timeout: float = 30.0,
        retry: bool = True,
        token: str | None = None,
        tls: Tls | None = None,
    ) -> None:
        async def make() -> AsyncGraspClient:
            return AsyncGraspClient(address, timeout=timeout, retry=retry, token=token, tls=tls)

        self._client = _run(make())

    detect = _waiting(AsyncGraspClient.detect)
    score = _waiting(AsyncGraspClient.score)
    models = _waiting(AsyncGraspClient.models)
    robots = _waiting(AsyncGraspClient.robots)
    record_outcome = _waiting(AsyncGraspClient.record_outcome)
    ready = _waiting(AsyncGraspClient.ready)
    wait_until_ready = _waiting(AsyncGraspClient.wait_until_ready)
    close = _waiting(AsyncGraspClient.close)

    def detect_stream(
        self, requests: Iterable[StreamRequest], *, timeout: float | None = None
    ) -> Iterator[StreamAnswer]:
        """The same as `AsyncGraspClient.detect_stream`."""
        answers = self._client.detect_stream(requests, timeout=timeout)

        async def following() -> StreamAnswer | None:
            return await anext(answers, None)

        try:
            while (answer := _run(following())) is not None:
                yield answer
        finally:  # not awaited, since the garbage collector may call this in the loop's own thread
            asyncio.run_coroutine_threadsafe(answers.aclose(), _loop())

    def __exit__(self, *_: object) -> None:
        self.close()


def _loop() -> asyncio.AbstractEventLoop:
    """The event loop shared by all clients of this process; a forked process starts its own."""
    with _STARTING:
        if os.getpid() not in _LOOPS:
            loop = _LOOPS[os.getpid()] = asyncio.new_event_loop()
            threading.Thread(target=loop.run_forever, name="edgegrasp-client", daemon=True).start()
        return _LOOPS[os.getpid()]


def _run(work: Coroutine[Any, Any, Answer]) -> Answer:
    """Run a coroutine and return its result; it is cancelled if the caller is interrupted."""
    running = asyncio.run_coroutine_threadsafe(work, _loop())
    try:
        return running.result()
    except CancelledError:  # by close() in another thread
        raise errors.GraspClientError(CLOSED) from None
    except BaseException:
        running.cancel()
        raise


async def _from_thread(requests: Iterable[StreamRequest]) -> AsyncIterator[StreamRequest]:
    """The requests, read in daemon threads: waiting for one blocks nothing, not even exit."""
    source = iter(requests)

    def read(found: "Future[StreamRequest | None]") -> None:
        if found.set_running_or_notify_cancel():
            try:
                found.set_result(next(source, None))
            except BaseException as error:  # SystemExit would end the loop of all clients
                known = isinstance(error, Exception)
                found.set_exception(error if known else errors.GraspClientError(repr(error)))

    while True:
        found: Future[StreamRequest | None] = Future()
        threading.Thread(target=read, args=(found,), daemon=True).start()
        if (request := await asyncio.wrap_future(found)) is None:
            return
        yield request
