"""The worker processes as the front sees them: run a job, replace what died, load anew."""

import asyncio
import contextlib
import logging
import os
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import InvalidSettings, WorkerLost, kind_of
from edgegrasp_service.settings import SECRETS, Settings
from edgegrasp_service.worker.job import Answer, Job
from edgegrasp_service.worker.process import (
    HEADER,
    LOST,
    Ready,
    Start,
    pack,
    receive,
    send,
    unpack,
)

# -P: nothing is imported from the folder the server was started in.
NURSERY = (
    sys.executable, "-P", "-c", "from edgegrasp_service.worker.process import main; main()"
)  # fmt: skip
ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

WORKER_LOST = kind_of(WorkerLost)
KILL_SECONDS = 0.5  # a worker whose answer nobody waits for may finish for so long
RETRY_SECONDS = 1.0  # after a worker, or the nursery, failed to start

logger = logging.getLogger(__name__)


class WorkerPool:
    """Runs each job in a worker process of its own.

    Args:
        settings: How many workers, and what they load.
        nursery: The command that starts the process which they fork from.
        replaced: Called for each worker that dies and is replaced.

    Attributes:
        models: Facts of the loaded weights; empty before `start`.
    """

    def __init__(
        self,
        settings: Settings,
        nursery: Sequence[str] = NURSERY,
        replaced: Callable[[], None] = lambda: None,
    ) -> None:
        self._settings = settings
        self._nursery_command = nursery
        self._replaced = replaced
        self.models: list[dict[str, Any]] = []
        self.size = worker_count(settings)
        self._nursery: _Nursery | None = None
        self._workers: set[_Worker] = set()
        # The last one in is the first one out: its caches are warm.
        self._idle: asyncio.LifoQueue[_Worker] = asyncio.LifoQueue()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._closed = False

    @property
    def pids(self) -> list[int]:
        """Of the workers."""
        return [worker.pid for worker in self._workers]

    @property
    def busy(self) -> int:
        """Workers that have a job."""
        return sum(worker.answer is not None for worker in self._workers)

    @property
    def resident_bytes(self) -> int:
        """Memory of the workers; what they share is counted for each."""
        pages = 0
        for pid in self.pids:
            with contextlib.suppress(OSError):  # it died just now, or there is no /proc
                pages += int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * resource.getpagesize()

    async def start(self) -> None:
        """Load, and start the workers; those of a start before end when they have answered.

        Raises:
            EdgeGraspError: Weights cannot be used.
        """
        nursery = await _Nursery.start(self._nursery_command, self._settings)
        workers = [_Worker(self, nursery) for _ in range(self.size)]
        try:
            await asyncio.gather(*(worker.start() for worker in workers))
        except BaseException:
            nursery.close()
            for worker in workers:
                worker.close()
            raise
        old_nursery, old_workers = self._nursery, self._workers
        self._nursery, self._workers = nursery, set(workers)
        while not self._idle.empty():
            self._idle.get_nowait()
        self.models = workers[0].models
        nursery.watch(lambda: self._nursery_lost(nursery))
        for worker in workers:
            self._free(worker)
        if old_nursery is not None:
            old_nursery.close()
        for worker in old_workers:
            if worker.answer is None:  # the others finish what they have begun
                worker.close()

    async def run(
        self, job: Job, deadline: float, begun: Callable[[], None] = lambda: None
    ) -> Answer:
        """Have a worker do a job, as soon as one is free; first come, first served.

        Where this is cancelled the job is dropped, or its worker soon killed if it has begun.

        Args:
            job: What to do.
            deadline: By the clock of the event loop; the worker gives up after it.
            begun: Called when a worker has the job.

        Raises:
            WorkerLost: The worker died.
        """
        worker = await self._take()
        begun()
        remaining = deadline - asyncio.get_running_loop().time()
        answer = worker.begin(replace(job, remaining=remaining))
        try:
            return await asyncio.shield(answer)
        except asyncio.CancelledError:
            worker.abandon()
            raise

    def close(self) -> None:
        """End every worker, whatever it does."""
        self._closed = True
        for task in self._tasks:
            task.cancel()
        for worker in list(self._workers):
            worker.kill()
            worker.close()
        if self._nursery is not None:
            self._nursery.close()

    async def _take(self) -> "_Worker":
        while True:
            worker = await self._idle.get()
            if worker in self._workers:  # and not dead
                return worker

    def _free(self, worker: "_Worker") -> None:
        """A worker has nothing to do: the next job, or the end where there are newer ones."""
        if worker in self._workers:
            self._idle.put_nowait(worker)
        else:
            worker.close()

    def _lost(self, worker: "_Worker") -> None:
        """A worker died: start another in its place."""
        if worker in self._workers and not self._closed:
            logger.warning("worker %d died and is replaced", worker.pid)
            self._workers.discard(worker)
            self._replaced()
            self._spawn(self._until_done(worker.nursery, lambda: self._replace(worker.nursery)))

    async def _replace(self, nursery: "_Nursery") -> None:
        worker = _Worker(self, nursery)
        await worker.start()
        if nursery is not self._nursery:
            worker.close()
            return
        self._workers.add(worker)
        self._free(worker)

    async def _until_done(self, nursery: "_Nursery", start: Callable[[], Awaitable[None]]) -> None:
        """Start again what died of a nursery, until that succeeds or there is a newer nursery."""
        while nursery is self._nursery:
            try:
                return await start()
            except (EdgeGraspError, OSError) as error:
                logger.error("what died cannot be replaced yet: %s", error)
                await asyncio.sleep(RETRY_SECONDS)

    def _nursery_lost(self, nursery: "_Nursery") -> None:
        """Load again, while the workers that it left go on."""
        logger.error("the process that workers fork from died; weights are loaded again")
        self._spawn(self._until_done(nursery, self.start))

    def _spawn(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def worker_count(settings: Settings) -> int:
    """How many workers there are: as set, or one for each core this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return settings.workers or cores or 1


class _Nursery:
    """The process that has loaded everything, and forks workers."""

    def __init__(self, process: subprocess.Popen[bytes], control: socket.socket) -> None:
        self._process = process
        self._control = control

    @classmethod
    async def start(cls, command: Sequence[str], settings: Settings) -> "_Nursery":
        """Start it, and wait until it has loaded; raises InvalidSettings where it cannot."""
        control, theirs = socket.socketpair()
        with theirs:
            environment = os.environ | dict.fromkeys(ONE_THREAD, "1")
            process = subprocess.Popen(command, stdin=theirs.fileno(), env=environment)
        nursery = cls(process, control)
        try:
            send(control, Start(settings.model_dump(mode="json", exclude=set(SECRETS))))
            answer = await asyncio.to_thread(receive, control.recv_into)
        except BaseException:
            nursery.close()
            raise
        if answer is None or answer.failure:
            nursery.close()
            raise InvalidSettings(
                answer.failure if answer else "the process that loads weights died"
            )
        control.setblocking(False)
        return nursery

    def watch(self, lost: Callable[[], None]) -> None:
        """Call `lost` when it dies."""
        loop = asyncio.get_running_loop()

        def readable() -> None:
            loop.remove_reader(self._control)
            lost()

        loop.add_reader(self._control, readable)

    def fork(self) -> socket.socket:
        """A socket to a new worker."""
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                socket.send_fds(self._control, [b"w"], [theirs.fileno()])
            except OSError:
                ours.close()
                raise
        return ours

    def close(self) -> None:
        """End it; the workers that it forked go on."""
        with contextlib.suppress(RuntimeError, ValueError):
            asyncio.get_running_loop().remove_reader(self._control)
        self._process.kill()
        self._process.wait()
        self._control.close()


class _Worker(asyncio.Protocol):
    """One worker process, at the other end of a socket."""

    def __init__(self, pool: WorkerPool, nursery: _Nursery) -> None:
        loop = asyncio.get_running_loop()
        self.nursery = nursery
        self.pid = 0
        self.models: list[dict[str, Any]] = []
        self.answer: asyncio.Future[Answer] | None = None  # of the job that it works on
        self._pool = pool
        self._ready: asyncio.Future[None] = loop.create_future()
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()
        self._killing: asyncio.TimerHandle | None = None

    async def start(self) -> None:
        """Fork it, and wait until it is ready; raises InvalidSettings where it cannot load."""
        loop = asyncio.get_running_loop()
        ours = self.nursery.fork()
        ours.setblocking(False)
        await loop.create_unix_connection(lambda: self, sock=ours)
        await self._ready

    def begin(self, job: Job) -> asyncio.Future[Answer]:
        """Give it a job."""
        self.answer = asyncio.get_running_loop().create_future()
        self.answer.add_done_callback(lambda answer: answer.exception())  # nobody may be waiting
        assert self._transport is not None
        for part in pack(job):
            self._transport.write(part)
        return self.answer

    def abandon(self) -> None:
        """Nobody waits for its answer: kill it unless it is done soon."""
        if self.answer is not None and self._killing is None:
            loop = asyncio.get_running_loop()
            self._killing = loop.call_later(KILL_SECONDS, self.kill)

    def kill(self) -> None:
        """End it at once."""
        if self.pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """Let it end, which it does when it has nothing to do."""
        if self._transport is not None:
            self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Of asyncio: the socket is ours."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Of asyncio: a part of a message."""
        self._received += data
        if len(self._received) < HEADER.size:
            return
        length, body_length = HEADER.unpack_from(self._received)
        end = HEADER.size + length
        if len(self._received) < end + body_length:
            return
        message = unpack(self._received[HEADER.size : end], bytes(memoryview(self._received)[end:]))
        self._received = bytearray()
        self._take(message)

    def _take(self, message: object) -> None:
        if isinstance(message, Ready) and message.failure:
            self._ready.set_exception(InvalidSettings(message.failure))
        elif isinstance(message, Ready):
            self.pid, self.models = message.pid, message.models
            self._ready.set_result(None)
        elif isinstance(message, Answer) and self.answer is not None:
            answer, self.answer = self.answer, None
            if self._killing is not None:
                self._killing.cancel()
                self._killing = None
            answer.set_result(message)
            if message.error is not None and message.error.kind == WORKER_LOST:
                self.kill()  # it ran out of memory: what is left of it cannot be trusted
            else:
                self._pool._free(self)

    def connection_lost(self, error: Exception | None) -> None:
        """Of asyncio: the process ended."""
        if self._killing is not None:
            self._killing.cancel()
        if not self._ready.done():
            self._ready.set_exception(InvalidSettings("a worker died as it started"))
        if self.answer is not None:
            answer, self.answer = self.answer, None
            answer.set_exception(WorkerLost(LOST))
        self._pool._lost(self)
