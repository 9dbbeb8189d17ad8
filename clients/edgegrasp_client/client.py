"""The synchronous client: the asynchronous one, run in a thread."""

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator
from concurrent.futures import Future
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import httpx
from typing_extensions import Self

from edgegrasp_client.async_client import AsyncGraspClient
from edgegrasp_client.connection import DEFAULT_ADDRESS, Tls, is_rest
from edgegrasp_client.errors import invalid
from edgegrasp_client.requests import StreamRequest
from edgegrasp_client.results import StreamAnswer

Parameters = ParamSpec("Parameters")
Answer = TypeVar("Answer")

_LOOPS: dict[int, asyncio.AbstractEventLoop] = {}  # by process
_STARTING = threading.Lock()
_ASKED_OVER_GRPC: set[int] = set()  # this process, and those that it was forked from


def _waiting(
    method: Callable[Concatenate[AsyncGraspClient, Parameters], Coroutine[Any, Any, Answer]],
) -> "Callable[Concatenate[GraspClient, Parameters], Answer]":
    """A method of the asynchronous client that returns its answer."""

    @wraps(method)
    def call(self: "GraspClient", /, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Answer:
        return _run(method(self._client, *args, **kwargs))

    return call


class GraspClient:
    """Asks one server for grasps; use as a context manager, or close it. Any thread may call it.

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
        http_transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        if not is_rest(address):
            _ASKED_OVER_GRPC.add(os.getpid())
            if len(_ASKED_OVER_GRPC) > 1:  # gRPC would wait for ever, for threads of the parent's
                fix = "Start processes by `spawn`, or ask over REST."
                raise invalid("address", "gRPC in a fork of a process that has used it", fix)

        async def make() -> AsyncGraspClient:
            return AsyncGraspClient(
                address,
                timeout=timeout,
                retry=retry,
                token=token,
                tls=tls,
                http_transport=http_transport,
            )

        self._client = _run(make())

    detect = _waiting(AsyncGraspClient.detect)
    score = _waiting(AsyncGraspClient.score)
    models = _waiting(AsyncGraspClient.models)
    record_outcome = _waiting(AsyncGraspClient.record_outcome)
    ready = _waiting(AsyncGraspClient.ready)
    wait_until_ready = _waiting(AsyncGraspClient.wait_until_ready)
    close = _waiting(AsyncGraspClient.close)

    def detect_stream(
        self, requests: Iterable[StreamRequest], *, timeout: float | None = None
    ) -> Iterator[StreamAnswer]:
        """As `AsyncGraspClient.detect_stream`; the requests are read in a thread of their own."""
        answers = self._client.detect_stream(_from_thread(requests), timeout=timeout)

        async def following() -> StreamAnswer | None:
            return await anext(answers, None)

        async def end() -> None:
            await answers.aclose()

        try:
            while (answer := _run(following())) is not None:
                yield answer
        finally:  # not waited for: the garbage collector may come here in the loop's own thread
            asyncio.run_coroutine_threadsafe(end(), _loop())

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()


def _loop() -> asyncio.AbstractEventLoop:
    """The event loop of all clients of this process; a forked one has none of its parent's."""
    with _STARTING:
        if os.getpid() not in _LOOPS:
            loop = _LOOPS[os.getpid()] = asyncio.new_event_loop()
            threading.Thread(target=loop.run_forever, name="edgegrasp-client", daemon=True).start()
        return _LOOPS[os.getpid()]


def _run(work: Coroutine[Any, Any, Answer]) -> Answer:
    """What the work gives; where its caller is interrupted, it is cancelled."""
    running = asyncio.run_coroutine_threadsafe(work, _loop())
    try:
        return running.result()
    except BaseException:
        running.cancel()
        raise


async def _from_thread(requests: Iterable[StreamRequest]) -> AsyncIterator[StreamRequest]:
    """The requests; to wait for the next one holds up nothing, not even the program's end."""
    source = iter(requests)

    def read(found: "Future[StreamRequest | None]") -> None:
        if found.set_running_or_notify_cancel():
            try:
                found.set_result(next(source, None))
            except Exception as error:
                found.set_exception(error)

    while True:
        found: Future[StreamRequest | None] = Future()
        threading.Thread(target=read, args=(found,), daemon=True).start()
        if (request := await asyncio.wrap_future(found)) is None:
            return
        yield request
