"""What both transports do with a request: name it, let it in, hand it on, and tell of it."""

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import (
    Cancelled,
    HeadersTooLarge,
    NotReady,
    PayloadTooLarge,
    PermissionDenied,
    ReloadFailed,
    RequestTimeout,
    report,
)
from edgegrasp_service.front.admission import Admission, Ticket
from edgegrasp_service.observability import CALL, REQUEST_ID_HEADER, Call
from edgegrasp_service.security import ADMIN_FIX, HEADER, ServerTls, Tokens
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.job import Answer, Job, Method, Transport
from edgegrasp_service.worker.pool import WorkerPool

logger = logging.getLogger(__name__)

STOPPING = "The server is stopping. Try another one."
GIVEN_UP = "The server stopped before there was an answer. Try another one."
MAX_HEADERS = 64

Observer = Callable[[Call], None]
Recorder = Callable[[Call, Job, Answer], None]


@dataclass(frozen=True)
class ModelInfo:
    """Loaded weights; the fields of edgegrasp.v1.Model."""

    name: str
    architecture: str = ""
    digest: str = ""
    parameters: int = 0
    crop_radius: float = 0.0  # metres
    voxel_size: float = 0.0  # metres
    gripper: str = ""
    default: bool = False
    hand_description: bool = False
    device: str = ""


class GraspService:
    """The front without a transport.

    Args:
        settings: Its bounds.
        pool: The workers.
        tokens: Who may ask.
        observers: Told of every call when it has ended.
        record: Told of every job and its answer.

    Attributes:
        tokens: Replaced when they are read anew.
        stopping: Set: new requests are refused.
        in_flight: Calls that have not ended.
    """

    def __init__(
        self,
        settings: Settings,
        pool: WorkerPool,
        tokens: Tokens,
        observers: Sequence[Observer] = (),
        record: Recorder | None = None,
    ) -> None:
        self.settings = settings
        self.pool = pool
        self.tokens = tokens
        self.stopping = asyncio.Event()
        self.in_flight = 0
        self.admission = Admission(pool.size, settings.max_queue_length, settings.max_held_bytes)
        self._observers = observers
        self._record = record

    @property
    def ready(self) -> bool:
        """Whether requests are answered."""
        return bool(self.pool.models) and not self.stopping.is_set()

    def models(self) -> list[ModelInfo]:
        """The weights a request can name; raises NotReady."""
        self.check_ready()
        known = ModelInfo.__dataclass_fields__
        return [
            ModelInfo(**{name: value for name, value in facts.items() if name in known})
            for facts in self.pool.models
        ]

    def check_ready(self) -> None:
        """Raise NotReady while weights are loading, and when the server is stopping."""
        if self.stopping.is_set():
            raise NotReady(STOPPING)
        if not self.pool.models:
            raise NotReady("Weights are still loading. Try again in some seconds.")

    @contextmanager
    def call(
        self, transport: Transport, method: str, headers: Mapping[str, str], peer: str
    ) -> Iterator[Call]:
        """Name one call, and tell the observers when it has ended.

        Args:
            transport: The way it came.
            method: For metrics and the log.
            headers: By their lower-case names.
            peer: Its address.

        Yields:
            The call; the transport sets its `code`.
        """
        call = Call(transport, method, headers.get(REQUEST_ID_HEADER, ""), peer)
        call.traceparent = headers.get("traceparent", "")
        CALL.set(call)
        self.in_flight += 1
        try:
            yield call
        finally:
            self.in_flight -= 1
            self._ended(call)

    def authorize(self, call: Call, authorization: str | None) -> None:
        """Check the token of a call; raises Unauthenticated or PermissionDenied."""
        known = self.tokens.check(authorization, admin=call.method == "ReloadModels")
        if known is not None:
            call.token, call.is_admin = known.name, known.is_admin

    @asynccontextmanager
    async def admit(self, call: Call, size: int) -> AsyncIterator[Ticket]:
        """A place in the server, taken before the body of a request is read.

        Args:
            call: The request; the ticket ends with its deadline.
            size: Bytes that its body may have.

        Raises:
            NotReady: Weights are not loaded yet, or the server is stopping.
            Overloaded: There is no place, or its turn would come too late.
            DeadlineExceeded: The deadline passed.
        """
        self.check_ready()
        call.limit(self.settings.max_request_seconds)
        try:
            async with self.admission.admit(call.client, call.deadline, size) as ticket:
                call.end_stage("admission")
                yield ticket
        except Exception as error:
            call.problem = call.problem or report(error)  # gRPC aborts with an error of its own
            raise
        except BaseException:
            call.problem = report(Cancelled("The caller cancelled the request."))
            raise

    async def answer(
        self,
        call: Call,
        ticket: Ticket,
        method: Method,
        body: bytes,
        content_type: str = "",
        query: str = "",
    ) -> Answer:
        """Have a worker answer a request whose body is there.

        Raises:
            WorkerLost: The worker died.
        """
        call.end_stage("read")
        call.bytes_in = len(body)
        self.admission.resize(ticket, len(body))
        job = Job(method, call.transport, body, 0.0, content_type, query, call.request_id)
        began = 0.0

        def begun() -> None:
            nonlocal began
            call.end_stage("wait")
            began = time.monotonic()
            ticket.at_work = True

        try:
            answer = await self.pool.run(job, call.deadline, begun)
        finally:
            if began:
                self.admission.worked(time.monotonic() - began)
            ticket.at_work = False
        call.facts, call.problem = answer.facts, answer.error
        call.bytes_out = len(answer.body)
        call.stages |= answer.facts.seconds
        self.admission.resize(ticket, len(answer.body))
        if self._record is not None:
            self._record(call, job, answer)
        return answer

    @contextmanager
    def stream_call(self, stream: Call, request_id: str) -> Iterator[Call]:
        """One request of a stream."""
        call = Call(
            stream.transport, stream.method, request_id, stream.peer, stream.token, in_stream=True
        )
        call.traceparent = stream.traceparent
        CALL.set(call)
        try:
            yield call
        except Exception as error:
            call.problem = report(error)
            raise
        except BaseException:
            call.problem = report(Cancelled("The caller cancelled the request."))
            raise
        finally:
            call.code = "OK" if call.problem is None else call.problem.code
            self._ended(call)

    async def drain(self, grace: float) -> bool:
        """Refuse new requests, and wait until those accepted are answered.

        Args:
            grace: Seconds to wait at most; then they are given up.

        Returns:
            Whether every one of them was answered.
        """
        self.stopping.set()
        try:
            async with asyncio.timeout(grace):
                await self.admission.empty()
        except TimeoutError:
            self.admission.refuse_all(NotReady(GIVEN_UP))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):  # to be told
                    await self.admission.empty()
            return False
        return True

    def time_to_read(self, received: int) -> float:
        """Seconds after which so many bytes are too few."""
        return self.settings.read_seconds + received / self.settings.min_bytes_per_second

    def time_to_write(self, size: int) -> float:
        """Seconds in which an answer of so many bytes must be taken."""
        return self.settings.write_seconds + size / self.settings.min_bytes_per_second

    def check_size(self, size: int) -> None:
        """Raise PayloadTooLarge for a body over the limit."""
        most = self.settings.max_body_bytes
        if size > most:
            fix = f"Send at most {most} bytes, e.g. float32 points or a downsampled cloud."
            raise PayloadTooLarge("body", f"{size} bytes", fix)

    def too_slow(self, received: int) -> RequestTimeout:
        """The error for a body of which only so much came in time."""
        value = f"{received} bytes in {self.time_to_read(received):.0f} s"
        fix = f"Send at least {self.settings.min_bytes_per_second} bytes a second."
        return RequestTimeout("body", value, fix)

    def _ended(self, call: Call) -> None:
        call.seconds = time.monotonic() - call.start
        loop = asyncio.get_running_loop()
        for observer in self._observers:
            loop.call_soon(observer, call)  # once the answer is on its way


class Reloader:
    """Reloads one server, one reload after the other.

    Args:
        service: Whose weights and tokens are loaded beside the old ones, which serve meanwhile.
        read_tokens: Reads them.
        tls: Whose certificates are read anew; None: there are none.
        reloaded: Told of each reload whether it succeeded.
    """

    def __init__(
        self,
        service: GraspService,
        read_tokens: Callable[[], Tokens],
        tls: ServerTls | None,
        reloaded: Callable[[bool], None],
    ) -> None:
        self._service = service
        self._read_tokens = read_tokens
        self._tls = tls
        self._reloaded = reloaded
        self._turn = asyncio.Lock()
        self._waiting = False
        self._tasks: set[asyncio.Task[None]] = set()

    async def reload(self, call: Call) -> list[ModelInfo]:
        """Load weights, tokens and certificates anew, for a caller with an admin token.

        Returns:
            What is loaded now.

        Raises:
            PermissionDenied: The caller has none.
            NotReady: The first weights are still loading, or the server is stopping.
            ReloadFailed: Something cannot be used, and all is as before; or a reload waits already.
        """
        if not call.is_admin:
            raise PermissionDenied(HEADER, "a call for administrators", ADMIN_FIX)
        return await self._in_turn()

    def reload_soon(self) -> None:
        """Begin a reload in the running event loop; what comes of it is in the log."""
        task = asyncio.get_running_loop().create_task(self._reload_quietly())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _reload_quietly(self) -> None:
        try:
            await self._in_turn()
        except EdgeGraspError as error:
            logger.warning("SIGHUP: %s", error)

    async def _in_turn(self) -> list[ModelInfo]:
        self._service.check_ready()
        if self._waiting:
            raise ReloadFailed("A reload waits for another one already. Try again later.")
        self._waiting = self._turn.locked()
        try:
            await self._turn.acquire()
        finally:
            self._waiting = False
        try:
            return await self._reload()
        finally:
            self._turn.release()

    async def _reload(self) -> list[ModelInfo]:
        try:
            tokens = self._read_tokens()
            certificates = None if self._tls is None else self._tls.read()
            await self._service.pool.reload()
        except EdgeGraspError as error:
            self._reloaded(False)
            logger.error("reload failed, the old weights still serve: %s", error)
            raise ReloadFailed(f"The old weights still serve. {error}") from None
        except Exception:
            self._reloaded(False)
            logger.exception("reload failed, the old weights still serve")
            raise ReloadFailed("The old weights still serve; the log says why.") from None
        self._service.tokens = tokens
        if self._tls is not None and certificates is not None:
            self._tls.use(certificates)
        self._reloaded(True)
        models = self._service.models()
        digests = {model.name: model.digest for model in models}
        logger.info("reloaded", extra={"fields": {"digests": digests}})
        return models


def check_headers(kind: str, count: int, size: int = 0, most: int = 0) -> None:
    """Raise HeadersTooLarge for more than MAX_HEADERS, or than `most` bytes in all."""
    if count > MAX_HEADERS:
        raise HeadersTooLarge(kind, f"{count} entries", f"Send at most {MAX_HEADERS}.")
    if size > most:
        raise HeadersTooLarge(kind, f"{size} bytes", f"Send at most {most}.")
