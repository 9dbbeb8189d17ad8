"""The core of both transports: check, admit, run, record and report a request."""

import asyncio
import contextlib
import hashlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from typing import Any

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import (
    STOPPING,
    Cancelled,
    HarmfulRequest,
    NotReady,
    PayloadTooLarge,
    PermissionDenied,
    ReloadFailed,
    WorkerLost,
    report,
)
from edgegrasp_service.front.admission import Admission, Ticket
from edgegrasp_service.observability import CALL, Call
from edgegrasp_service.security import ADMIN_FIX, HEADER, ServerTls, load_tokens
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.pool import CRASH_FIX, CRASHED, WORKER_LOST, WorkerPool
from edgegrasp_service.worker.process import Answer, Job

logger = logging.getLogger(__name__)

MOST_DEATHS = 3  # dead workers after which a request is refused; a crash counts as 3
HARMFUL_SECONDS = 600.0  # seconds for which it is refused
MOST_HARMFUL = 1000  # requests remembered

Observer = Callable[[Call], None]
Recorder = Callable[[Job, Answer], None]


class GraspService:
    """The front process without its transports."""

    def __init__(
        self,
        settings: Settings,
        pool: WorkerPool,
        tls: ServerTls | None,
        observers: Sequence[Observer],
        reloaded: Callable[[bool], None],  # told of every reload whether it succeeded
    ) -> None:
        self.settings = settings
        self.pool = pool
        self.tokens = load_tokens(settings)  # replaced on reload
        self.stopping = asyncio.Event()  # when set, new requests are refused
        self.in_flight = 0  # number of calls in progress
        self.admission = Admission(pool.size, settings.max_queue_length, settings.max_held_bytes)
        self._observers = observers
        self.record: Recorder | None = None  # called with each job and its answer
        self._harmful = HarmfulRequests()
        self._tls = tls
        self._reloaded = reloaded
        self._reloading = asyncio.Lock()
        self._tasks: set[asyncio.Task[Any]] = set()

    @property
    def ready(self) -> bool:
        """Whether requests can be answered."""
        return bool(self.pool.models) and self.pool.alive and not self.stopping.is_set()

    def loaded(self) -> WorkerPool:
        """The workers; raises NotReady while weights are loading or the server is stopping."""
        if self.stopping.is_set():
            raise NotReady(STOPPING)
        if not self.pool.models:
            raise NotReady("Weights are still loading. Try again in some seconds.")
        return self.pool

    @contextmanager
    def observe(self, call: Call) -> Iterator[None]:
        """Process a call, and notify the observers when it has ended; HTTP sets its `code`."""
        CALL.set(call)
        self.in_flight += 1
        try:
            yield
        except BaseException as error:
            gone = Cancelled("The caller cancelled the request.")
            call.problem = call.problem or report(error if isinstance(error, Exception) else gone)
            raise
        finally:
            self.in_flight -= 1
            call.seconds = time.monotonic() - call.start
            if call.transport == "http":
                call.code = call.code or "499"  # the caller disconnected; nginx's code
            else:
                call.code = "OK" if call.problem is None else call.problem.code
            loop = asyncio.get_running_loop()
            for observer in self._observers:
                loop.call_soon(observer, call)  # once the answer is being sent

    def authorize(self, call: Call, authorization: str | None) -> None:
        """Check the token of a call; raises Unauthenticated or PermissionDenied."""
        known = self.tokens.check(authorization, admin=call.method == "ReloadModels")
        if known is not None:
            call.token, call.is_admin = known.name, known.is_admin

    @asynccontextmanager
    async def admit(self, call: Call, size: int) -> AsyncIterator[Ticket]:
        """Hold a slot and `size` bytes until the answer is sent or the deadline passes.

        Raises:
            NotReady: Weights are not loaded yet, or the server is stopping.
            Overloaded: The server is full, or its turn would come too late.
            PayloadTooLarge: The body is over the limit.
            DeadlineExceeded: The deadline passed.
        """
        self.loaded()
        self.check_size(size)
        call.limit(self.settings.max_request_seconds)
        async with self.admission.admit(call.client, call.deadline, size) as ticket:
            call.end_stage("admission")
            yield ticket
            call.end_stage("write")

    async def answer(self, call: Call, ticket: Ticket, job: Job) -> Answer:
        """Let a worker answer an admitted request whose body has arrived.

        Raises:
            PayloadTooLarge: The body is over the limit.
            HarmfulRequest: This request killed workers.
            WorkerLost: The worker died for another reason.
        """
        call.end_stage("read")
        call.bytes_in = job.size
        self.check_size(call.bytes_in)
        self.admission.resize(ticket, call.bytes_in)
        ticket.whole = True
        job = replace(job, request_id=call.request_id)
        await self._harmful.check(job)
        worker = await self.pool.take()
        call.end_stage("wait")
        ticket.at_work, began = True, time.monotonic()
        try:
            answer = await worker.run(job, call.deadline)
        except (HarmfulRequest, WorkerLost) as error:
            await self._harmful.note(job, 1 if isinstance(error, WorkerLost) else MOST_DEATHS)
            raise
        finally:
            self.admission.took.append(time.monotonic() - began)
            ticket.at_work = False
        if answer.error is None:
            await self._harmful.forget(job)
        elif answer.error.kind == WORKER_LOST:
            await self._harmful.note(job, 1)
        call.facts, call.problem = answer.facts, answer.error
        call.stages |= answer.facts.seconds
        call.bytes_out = len(answer.body)
        self.admission.resize(ticket, call.bytes_out)
        if self.record is not None:
            self.record(job, answer)
        return answer

    async def drain(self, grace: float) -> None:
        """Refuse new requests and wait for accepted ones; abandon them after `grace` seconds."""
        self.stopping.set()
        try:
            async with asyncio.timeout(grace):
                await self.admission.empty()
        except TimeoutError:
            logger.warning("grace is over: requests in flight are abandoned")
            gone = "The server stopped before there was an answer. Try another one."
            self.admission.refuse_all(NotReady(gone))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):  # time for the errors to be sent
                    await self.admission.empty()

    def reload_soon(self) -> None:
        """Start a reload in the running event loop; the log has its outcome."""
        task = asyncio.get_running_loop().create_task(self.reload())
        self._tasks.add(task)
        task.add_done_callback(self._reloaded_soon)

    def _reloaded_soon(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()):
            logger.warning("SIGHUP: %s", error)

    async def reload(self, call: Call | None = None) -> list[dict[str, Any]]:
        """Reload weights, tokens and certificates; the old ones stay in use meanwhile.

        Returns what is loaded now.

        Raises:
            PermissionDenied: The caller has no admin token.
            NotReady: The first weights are still loading, or the server is stopping.
            ReloadFailed: Something cannot be used, and nothing was changed; or a reload is under
                way.
        """
        if call is not None and not call.is_admin:  # however its path is spelled
            raise PermissionDenied(HEADER, "a call for administrators", ADMIN_FIX)
        self.loaded()
        if self._reloading.locked():
            raise ReloadFailed("A reload is under way already. Try again later.")
        async with self._reloading:
            try:
                tokens = load_tokens(self.settings)
                certificates = self._tls and self._tls.read()
                await self.pool.start()
            except Exception as error:
                self._reloaded(False)
                known = isinstance(error, EdgeGraspError)
                logger.error("reload failed: %s", error, exc_info=not known)
                why = error if known else "The log says why."
                raise ReloadFailed(f"The old weights still serve. {why}") from None
            self.tokens = tokens
            if self._tls and certificates:
                self._tls.use(certificates)
            self._reloaded(True)
            digests = {model["name"]: model["digest"] for model in self.pool.models}
            logger.info("reloaded", extra={"fields": {"digests": digests}})
            return self.pool.models

    def check_size(self, size: int) -> None:
        """Raise PayloadTooLarge for a body over the limit."""
        most = self.settings.max_body_bytes
        if size > most:
            fix = f"Send at most {most} bytes, e.g. float32 points or a downsampled cloud."
            raise PayloadTooLarge("body", f"{size} bytes", fix)


class HarmfulRequests:
    """Requests that killed workers, by digest: their expiry and the number of dead workers."""

    def __init__(self) -> None:
        self._deaths: dict[bytes, tuple[float, int]] = {}

    async def check(self, job: Job) -> None:
        """Raise HarmfulRequest for a request that must not run again."""
        if self._deaths:
            until, deaths = self._deaths.get(await asyncio.to_thread(_digest, job), (0.0, 0))
            if deaths >= MOST_DEATHS and time.monotonic() < until:
                raise HarmfulRequest("request", CRASHED, CRASH_FIX)

    async def note(self, job: Job, deaths: int) -> None:
        """Count workers killed by a request; a crash counts more than a kill."""
        digest, now = await asyncio.to_thread(_digest, job), time.monotonic()
        until, before = self._deaths.pop(digest, (0.0, 0))
        self._deaths[digest] = now + HARMFUL_SECONDS, deaths + (before if now < until else 0)
        if len(self._deaths) > MOST_HARMFUL:
            del self._deaths[next(iter(self._deaths))]

    async def forget(self, job: Job) -> None:
        """Clear a request that was answered, so its worker had died for another reason."""
        if self._deaths:
            self._deaths.pop(await asyncio.to_thread(_digest, job), None)


def _digest(job: Job) -> bytes:
    """Digest of a request as a worker sees it; run it in a thread, as bodies may be large."""
    kind = f"{job.method}\n{job.transport}\n{job.content_type}\n{job.query}\n"
    digest = hashlib.sha256(kind.encode("utf-8", "surrogateescape"))
    for part in job.parts:
        digest.update(part)
    return digest.digest()
