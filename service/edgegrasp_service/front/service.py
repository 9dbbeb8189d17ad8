"""The core of both transports: check, admit, run, record and report a request.

`Admission` limits how many requests and bytes the server holds, shared fairly between clients;
`EvictingLimiter` does the same for connections, streams, pages and reads.
"""

import asyncio
import contextlib
import hashlib
import logging
import math
import statistics
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service import errors
from edgegrasp_service.observability import CALL, Call, Metrics, log_call
from edgegrasp_service.security import ADMIN_FIX, TOKEN_HEADER, ServerTls, Tokens
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.process import MAX_DEATHS, Answer, Job, WorkerPool
from edgegrasp_service.worker.recording import Recorder

logger = logging.getLogger(__name__)

MAX_HARMFUL = 1000  # remembered requests that killed workers
HARMFUL_SECONDS = 600.0  # seconds for which a request that killed workers is refused
LATEST_TIMES = 15  # the median of the latest service times ignores a single slow request
SEND_SECONDS = 1.0  # seconds for the errors of abandoned requests to be sent
WAIT_FACTOR = 1.5  # the wait is estimated from a median, and half of the requests take longer

MAX_HEADERS = 64  # or entries of gRPC's metadata


class GraspService:
    """The front process without its transports."""

    def __init__(self, settings: Settings, pool: WorkerPool, metrics: Metrics) -> None:
        self.settings = settings
        self.pool = pool
        self.tokens = Tokens(settings)  # replaced on reload
        self.tls = ServerTls(settings) if settings.tls_certificate else None
        self.stopping = asyncio.Event()  # when set, new requests are refused
        self.in_flight = 0  # number of calls in progress
        self.admission = Admission(pool.size, settings.max_queue_length, settings.max_held_bytes)
        # Called with each call that has ended.
        self.observers: list[Callable[[Call], None]] = [metrics.count_call, log_call]
        folder, most = settings.record_folder, settings.record_bytes
        self.recorder = None if folder is None else Recorder(folder, most, self.admission.hold)
        # By digest of a request that killed workers: until when it is remembered, how many died.
        self._deaths: dict[bytes, tuple[float, int]] = {}
        self._reloads = metrics.reloads
        self._reloading = asyncio.Lock()

    @property
    def ready(self) -> bool:
        """Whether requests can be answered."""
        return bool(self.pool.models) and self.pool.alive and not self.stopping.is_set()

    def require_pool(self) -> WorkerPool:
        """The workers; raises NotReady while weights are loading or the server is stopping."""
        if self.stopping.is_set():
            raise errors.NotReady(errors.STOPPING_MESSAGE)
        if not self.pool.models:
            raise errors.NotReady("Weights are still loading. Try again in some seconds.")
        return self.pool

    @contextmanager
    def observe(self, call: Call) -> Iterator[None]:
        """Process a call, and notify the observers when it has ended; HTTP sets its `code`."""
        CALL.set(call)
        self.in_flight += 1
        try:
            yield
        except BaseException as error:
            gone = errors.Cancelled("The caller cancelled the request.")
            known = error if isinstance(error, Exception) else gone
            call.problem = call.problem or errors.to_problem(known)
            raise
        finally:
            self.in_flight -= 1
            call.seconds = time.monotonic() - call.start
            if call.transport == "http":
                call.code = call.code or "499"  # the caller disconnected; nginx's code
            else:
                call.code = "OK" if call.problem is None else call.problem.code
            loop = asyncio.get_running_loop()
            for observer in self.observers:
                loop.call_soon(observer, call)  # once the answer is being sent

    def authorize(self, call: Call, authorization: str | None) -> None:
        """Check the token of a call that needs one; raises Unauthenticated."""
        if self.tokens.required or (call.method == "ReloadModels" and self.tokens.known):
            known = self.tokens.check(authorization)
            call.token = call.client = known.name
            call.is_admin = known.is_admin

    def admit(self, call: Call, size: int, timeout: float) -> AbstractAsyncContextManager[None]:
        """Hold a slot and `size` bytes until the answer is sent or the deadline passes.

        The deadline is `timeout` seconds after the call's start, or earlier by the settings.

        Raises:
            NotReady: Weights are not loaded yet, or the server is stopping.
            Overloaded: The server is full, or could not answer before the deadline.
            PayloadTooLarge: The body is over the limit.
            DeadlineExceeded: The deadline passed.
        """
        self.require_pool()
        self.check_size(size)
        call.deadline = call.start + min(timeout, self.settings.max_request_seconds)
        return self.admission.admit(call, size)

    async def answer(self, call: Call, job: Job) -> Answer:
        """Let a worker answer an admitted request whose body has arrived.

        Raises:
            PayloadTooLarge: The body is over the limit.
            HarmfulRequest: This request killed workers.
        """
        call.end_stage("read")
        call.bytes_in = len(job.body)
        self.check_size(call.bytes_in)
        self.admission.resize(call, call.bytes_in)
        job = replace(job, request_id=call.request_id)
        now = time.monotonic()
        self._deaths = {one: found for one, found in self._deaths.items() if found[0] > now}
        digest = await asyncio.to_thread(_digest, job) if self._deaths else b""
        if self._deaths.get(digest, (0.0, 0))[1] >= MAX_DEATHS:
            raise errors.HarmfulRequest()
        worker = await self.pool.take()
        call.end_stage("wait")
        call.at_work, began = True, time.monotonic()
        try:
            answer = await worker.run(job, call.deadline)
        finally:
            self.admission.service_seconds.append(time.monotonic() - began)
            call.at_work = False
        if answer.facts.deaths or self._deaths:
            await self._note_deaths(job, answer)
        call.facts, call.problem = answer.facts, answer.error
        call.stages |= answer.facts.seconds
        call.bytes_out = len(answer.body)
        self.admission.resize(call, call.bytes_out)
        if self.recorder is not None:
            self.recorder.record(job, answer)
        return answer

    async def receive(self, part: Awaitable[Any], received: int = 0, start: float = 0.0) -> Any:
        """The next part of a body; raises RequestTimeout if it arrives too slowly.

        Args:
            part: Reads it.
            received: Bytes that came before.
            start: When the body began, by the clock of the event loop; 0: now.
        """
        slowest = self.settings.min_bytes_per_second
        seconds = self.settings.read_seconds + received / slowest
        try:
            async with asyncio.timeout_at((start or time.monotonic()) + seconds):
                return await part
        except TimeoutError:
            fix = f"Send at least {slowest} bytes a second."
            value = f"{received} bytes in {seconds:.0f} s"
            raise errors.RequestTimeout("body", value, fix) from None

    @asynccontextmanager
    async def sending(self, size: int) -> AsyncIterator[None]:
        """Limit the time to send `size` bytes; raises Cancelled if they are not taken in time."""
        seconds = self.settings.write_seconds + size / self.settings.min_bytes_per_second
        try:
            async with asyncio.timeout(seconds):
                yield
        except TimeoutError:
            raise errors.Cancelled(f"The client did not take {size} bytes.") from None

    async def _note_deaths(self, job: Job, answer: Answer) -> None:
        """Count the workers that a request has killed; forget them once it is answered."""
        digest = await asyncio.to_thread(_digest, job)
        if answer.facts.deaths:
            _, before = self._deaths.pop(digest, (0.0, 0))
            until = time.monotonic() + HARMFUL_SECONDS
            self._deaths[digest] = until, before + answer.facts.deaths
            if len(self._deaths) > MAX_HARMFUL:
                del self._deaths[next(iter(self._deaths))]
        elif answer.error is None:
            self._deaths.pop(digest, None)

    async def drain(self, grace: float) -> None:
        """Refuse new requests and wait for accepted ones; abandon them after `grace` seconds."""
        self.stopping.set()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(grace):
                return await self.admission.wait_until_empty()
        logger.warning("grace is over: requests in flight are abandoned")
        late = errors.NotReady("The server stopped before there was an answer. Try another one.")
        for call in self.admission.calls:
            call.refuse(late)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SEND_SECONDS):
                await self.admission.wait_until_empty()

    async def reload(self, call: Call | None = None) -> list[dict[str, Any]]:
        """Reload weights, tokens and certificates; the old ones stay in use meanwhile.

        Returns what is loaded now.

        Raises:
            PermissionDenied: The caller has no admin token.
            NotReady: The first weights are still loading, or the server is stopping.
            ReloadFailed: A file cannot be used, and nothing was changed; or another reload is in
                progress.
        """
        if call is not None and not call.is_admin:  # here, so that no spelling of a path evades it
            raise errors.PermissionDenied(TOKEN_HEADER, "no token of an administrator", ADMIN_FIX)
        self.require_pool()
        if self._reloading.locked():
            raise errors.ReloadFailed("A reload is under way already. Try again later.")
        async with self._reloading:
            try:
                tokens = Tokens(self.settings)
                certificates = self.tls and self.tls.read()
                await self.pool.start()
            except Exception as error:
                self._reloads.labels("failed").inc()
                known = isinstance(error, EdgeGraspError)
                logger.error("reload failed: %s", error, exc_info=not known)
                why = error if known else "The log says why."
                raise errors.ReloadFailed(f"The old weights still serve. {why}") from None
            self.tokens = tokens
            if self.tls and certificates:
                self.tls.use(certificates)
            self._reloads.labels("succeeded").inc()
            digests = {model["name"]: model["digest"] for model in self.pool.models}
            logger.info("reloaded", extra={"fields": {"digests": digests}})
            return self.pool.models

    def check_size(self, size: int) -> None:
        """Raise PayloadTooLarge for a body over the limit."""
        most = self.settings.max_body_bytes
        if size > most:
            fix = f"Send at most {most} bytes, e.g. float32 points or a downsampled cloud."
            raise errors.PayloadTooLarge("body", f"{size} bytes", fix)


def _digest(job: Job) -> bytes:
    """Digest of a request as a worker sees it; run it in a thread, as bodies may be large."""
    kind = f"{job.method}\n{job.transport}\n{job.content_type}\n{job.query}\n"
    digest = hashlib.sha256(kind.encode("utf-8", "surrogateescape"))
    digest.update(job.body)
    return digest.digest()


# Admission


class Admission:
    """Limits the requests and bytes in the server; used in the event loop only.

    A single client may use all slots and half of the bytes. When the server is full, the client
    that holds the most loses a request to a client that would still hold fewer.

    Args:
        workers: Number of requests processed at a time.
        max_waiting: Number of further requests in the server.
        max_bytes: Total bytes of the bodies held; one client holds at most half of them.
    """

    def __init__(self, workers: int, max_waiting: int, max_bytes: int) -> None:
        self._workers, self._max_calls, self._max_bytes = workers, workers + max_waiting, max_bytes
        self.calls: list[Call] = []  # of the requests in the server, in the order they came
        self._bytes_beside = 0  # held, but not for these requests
        self._freed = asyncio.Event()  # set when a request frees bytes or its place
        self.service_seconds: deque[float] = deque(maxlen=LATEST_TIMES)  # of workers' latest jobs

    @asynccontextmanager
    async def admit(self, call: Call, size: int) -> AsyncIterator[None]:
        """Hold a place in the server for a request until its deadline.

        The body of the context is cancelled at the deadline, on the event loop's clock. Waits for
        room for `size` bytes, the maximum of the request's body. Raises as `GraspService.admit`.
        """
        remaining = call.deadline - asyncio.get_running_loop().time()
        if remaining <= 0.0:
            raise errors.DeadlineExceeded()
        if self.calls and (wait := self._estimated_wait) * WAIT_FACTOR > remaining:
            raise self._overloaded(
                f"{len(self.calls)} requests come first, which take about {wait:.3g} s, and "
                f"the deadline is {remaining:.3g} s away"
            )
        if len(self.calls) >= self._max_calls:
            counts = Counter(other.client for other in self.calls)
            holder, count = counts.most_common(1)[0]
            if count <= counts[call.client] + 1 or not self._refuse_latest(holder):
                raise self._overloaded(f"it holds {len(self.calls)} requests")
        call.timeout = asyncio.timeout_at(call.deadline)
        self.calls.append(call)
        try:
            async with call.timeout:
                await self._reserve(call, size)
                call.end_stage("admission")
                yield
                call.end_stage("write")
        except TimeoutError:
            if not call.timeout.expired():
                raise
            raise call.refusal or errors.DeadlineExceeded() from None
        finally:
            call.timeout = None
            if call in self.calls:  # not refused
                self.calls.remove(call)
            self._freed.set()

    @property
    def num_at_work(self) -> int:
        """Number of requests that workers are processing."""
        return sum(call.at_work for call in self.calls)

    @property
    def held_bytes(self) -> int:
        """Bytes held for requests, or reserved with `hold`."""
        return self._bytes_beside + sum(call.held_bytes for call in self.calls)

    def _refuse_latest(self, holder: str) -> bool:
        """Refuse a client's latest request that no worker has; returns whether there is one."""
        for call in reversed(self.calls):
            if call.client == holder and not call.at_work:
                held = sum(one.client == holder for one in self.calls)
                why = f"this client holds {held} of {self._max_calls} places, and others wait"
                call.refuse(self._overloaded(why))
                self.calls.remove(call)
                self._freed.set()
                return True
        return False

    def resize(self, call: Call, size: int) -> None:
        """Set the number of bytes that a request holds."""
        call.held_bytes = size
        self._freed.set()

    def hold(self, size: int) -> bool:
        """Reserve bytes outside of requests, or free them (negative); returns whether they fit."""
        if size > 0 and self.held_bytes + size > self._max_bytes:
            return False
        self._bytes_beside += size
        self._freed.set()
        return True

    async def wait_until_empty(self) -> None:
        """Return once no request is in the server."""
        while self.calls:
            self._freed.clear()
            await self._freed.wait()

    @property
    def _estimated_wait(self) -> float:
        """Estimated seconds until a worker begins a new request."""
        pace = statistics.median(self.service_seconds) if self.service_seconds else 0.0
        ahead = sum("read" in call.stages for call in self.calls)  # other bodies may arrive late
        return max(0, ahead + 1 - self._workers) * pace / self._workers

    def _overloaded(self, why: str) -> errors.Overloaded:
        seconds = max(1, math.ceil(self._estimated_wait))  # the header Retry-After has integers
        return errors.Overloaded(f"The server is busy: {why}. Try again in {seconds} s.", seconds)

    async def _reserve(self, call: Call, size: int) -> None:
        """Wait until `size` more bytes fit into the total limit and into the client's limit."""
        while True:
            held: Counter[str] = Counter()
            for one in self.calls:
                held[one.client] += one.held_bytes
            mine, total = held[call.client], held.total() + self._bytes_beside
            fits = not total or total + size <= self._max_bytes
            if fits and (not mine or mine + size <= self._max_bytes // 2):
                break
            holder, most = held.most_common(1)[0]
            several = sum(one.client == holder and one.held_bytes > 0 for one in self.calls) > 1
            if not (several and most > mine + size and self._refuse_latest(holder)):
                self._freed.clear()
                await self._freed.wait()
        self.resize(call, size)


# Limits of connections, streams and pages


@dataclass(eq=False)
class Permit:
    """A slot of an `EvictingLimiter`."""

    owner: str
    on_eviction: Callable[[], None]
    idle: bool = True  # can be evicted
    used: float = field(default_factory=time.monotonic)


class EvictingLimiter:
    """A limited number of connections, streams, pages or reads.

    When all permits are taken, a newcomer evicts an idle one: the longest idle of the client that
    has most idle permits. One used within the last `grace` seconds is evicted only for a client
    that then still has fewer. `spare` permits cannot be busy, so that one is always left.
    """

    def __init__(self, most: int, grace: float = 0.0, spare: int = 0) -> None:
        self._most, self._grace, self._spare = most + spare, grace, spare
        self.taken: dict[Permit, None] = {}  # the most recently used at the end

    def acquire(self, owner: str, on_eviction: Callable[[], None]) -> Permit:
        """Take a permit until `release`, or until it is evicted. Raises Overloaded."""
        if len(self.taken) >= self._most:
            since = time.monotonic() - self._grace
            counts = Counter(one.owner for one in self.taken)
            mine = counts[owner] + 1
            idle = [
                permit
                for permit in self.taken
                if permit.idle and (permit.used <= since or counts[permit.owner] > mine)
            ]
            if not idle:
                raise errors.Overloaded(f"All {self._most} places are in use. Try again in 1 s.")
            greedy = Counter(permit.owner for permit in idle).most_common(1)[0][0]
            evicted = next(permit for permit in idle if permit.owner == greedy)
            self.release(evicted)
            evicted.on_eviction()
        permit = Permit(owner, on_eviction)
        self.taken[permit] = None
        return permit

    def use(self, permit: Permit, idle: bool = True) -> None:
        """Mark a permit as used now, and as idle or busy. Raises Overloaded."""
        if permit.idle and not idle and self._spare:
            busy = sum(not other.idle for other in self.taken)
            if busy >= self._most - self._spare:
                raise errors.Overloaded(f"{busy} connections have requests. Try again in 1 s.")
        permit.idle, permit.used = idle, time.monotonic()
        if permit in self.taken:
            self.taken[permit] = self.taken.pop(permit)

    def release(self, permit: Permit) -> None:
        """Return a permit."""
        self.taken.pop(permit, None)

    @asynccontextmanager
    async def hold(self, owner: str) -> AsyncIterator[Permit]:
        """Hold a permit. Raises Overloaded if there is none, or on eviction, and ends the body."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(None) as eviction:
                permit = self.acquire(owner, lambda: eviction.reschedule(loop.time()))
                try:
                    yield permit
                finally:
                    self.release(permit)
        except TimeoutError:
            if not eviction.expired():
                raise
            raise errors.Overloaded("Another client got this place. Try again in 1 s.") from None
