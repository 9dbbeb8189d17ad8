"""Worker processes as the front sees them: their messages, and the pool that runs jobs in them.

`WorkerPool` runs jobs, replaces dead processes and reloads. A `ForkServer`, a process that runs
`fork_server.py`, forks its workers. A message is plain values as JSON and a body as bytes.
"""

import asyncio
import contextlib
import json
import logging
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service import errors
from edgegrasp_service.settings import Settings

# -P: nothing is imported from the folder the server was started in.
FORK_SERVER_COMMAND = (sys.executable, "-P", "-m", "edgegrasp_service.worker.fork_server")
ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
# Freed memory is kept for the next request: the system hands out new pages slowly.
KEPT_MEMORY = {"MALLOC_TRIM_THRESHOLD_": str(2**26), "MALLOC_MMAP_THRESHOLD_": str(2**24)}

MAX_DEATHS = 3  # dead workers after which a request is refused; a crash counts as this many
CRASH_SIGNALS = {signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE, signal.SIGILL}
STATUS_SECONDS = 1.0  # seconds to learn how a worker ended
START_SECONDS = 20.0  # seconds for a worker to fork, if it need not load
HEARTBEAT_SECONDS = 3.0  # seconds between two checks that a worker is alive
HEARTBEAT_TIMEOUT = 10.0  # seconds for the worker to answer the check
KILL_SECONDS = 0.5  # seconds that a worker may use to finish an abandoned job
RETRY_SECONDS = 1.0  # seconds after a worker or the fork server failed to start

ENDED = struct.Struct("=ii")  # the fork server's message about a worker: process id and wait status
LOST = "The worker of this request died or ran out of memory. Try again, or send fewer points."
MESSAGE_HEADER = struct.Struct(">QQ")  # bytes of a message's JSON, and of the body that follows it
PIECE_BYTES = 2**16  # bytes of a body that the front reads or writes at a time

logger = logging.getLogger(__name__)

Method = Literal["DetectGrasps", "ScoreGrasps", "RecordOutcome", "Beat"]  # Beat: is it alive?
Transport = Literal["http", "grpc"]


@dataclass(frozen=True)
class Job:
    """One request as it arrived; the front passes it on undecoded."""

    method: Method
    transport: Transport
    body: bytes  # HTTP: the body, a bytearray in the front; gRPC: the serialized message
    remaining: float = 0.0  # seconds until its deadline at the time it was handed over
    content_type: str = ""  # HTTP: the header as sent
    query: str = ""  # HTTP: the query string, without the question mark
    request_id: str = ""  # for the worker's log


@dataclass
class Facts:
    """Facts about a request for logs and metrics, as far as it got."""

    model: str = ""  # name of the weights
    points: int = 0  # in the cloud as sent, holes included
    grasps: int = 0  # returned, or evaluated if given by the caller
    seconds: dict[str, float] = field(default_factory=dict)  # of each stage, in order
    counts: dict[str, int] = field(default_factory=dict)  # what passed each stage
    deaths: int = 0  # number of workers that the request killed
    options: str = ""  # options that differ from the defaults, as shortened JSON
    traceback: str = ""  # of an internal error


@dataclass(frozen=True)
class Answer:
    """The result of a job."""

    body: bytes  # JSON, or the serialized response message; empty for an error
    facts: Facts
    error: errors.Problem | None = None  # None: a success


@dataclass(frozen=True)
class Ready:
    """The first message of the fork server and of each worker."""

    pid: int
    models: list[dict[str, Any]]  # the catalogue's description of its weights; from workers
    failure: str = ""  # why loading failed
    robots: list[dict[str, Any]] = field(default_factory=list)  # the description of each robot


MESSAGES = {kind.__name__: kind for kind in (Ready, Job, Answer)}


def pack(message: Any) -> Sequence[bytes | bytearray]:
    """Serialize one of MESSAGES: lengths, plain fields as JSON, and the body without a copy."""
    fields = dict(vars(message))
    body = fields.pop("body", b"")
    text = json.dumps([type(message).__name__, fields], default=vars).encode()
    return MESSAGE_HEADER.pack(len(text), len(body)) + text, body


def unpack(text: bytes, body: bytes) -> Any:
    """Deserialize a message from its plain fields, as JSON, and its body."""
    name, fields = json.loads(text)
    if name != "Ready":
        fields["body"] = body
    if name == "Answer":
        fields["facts"] = Facts(**fields["facts"])
        fields["error"] = fields["error"] and errors.Problem(**fields["error"])
    return MESSAGES[name](**fields)


def send(to: socket.socket, message: object) -> None:
    """Send a message to the other end."""
    for part in pack(message):
        to.sendall(part)


def receive(file: BinaryIO) -> Any:
    """The next message; None at the end."""
    head = file.read(MESSAGE_HEADER.size)
    if len(head) < MESSAGE_HEADER.size:
        return None
    length, body_length = MESSAGE_HEADER.unpack(head)
    return unpack(file.read(length), file.read(body_length))


async def received(reader: asyncio.StreamReader) -> Any:
    """The same as `receive`, for the event loop of the front."""
    try:
        length, body_length = MESSAGE_HEADER.unpack(await reader.readexactly(MESSAGE_HEADER.size))
        return unpack(await reader.readexactly(length), await reader.readexactly(body_length))
    except (asyncio.IncompleteReadError, OSError):
        return None


async def _ready(reader: asyncio.StreamReader) -> Ready:
    """The first message of a process; raises InvalidSettings if it could not load."""
    ready: Ready | None = await received(reader)
    if ready is None or ready.failure:
        raise errors.InvalidSettings(ready.failure if ready else "a process died as it started")
    return ready


# The pool


class WorkerPool:
    """Runs each job in an idle worker process."""

    def __init__(
        self,
        settings: Settings,
        replaced: Callable[[], None],  # called for each worker that died
        fork_server: "ForkServer | None",  # one that is already loading
    ) -> None:
        self._settings = settings
        self.command: Sequence[str] = ()  # in place of FORK_SERVER_COMMAND
        self._replaced = replaced
        self._launched = fork_server
        self.models: list[dict[str, Any]] = []  # facts of loaded weights; empty before `start`
        self.robots: list[dict[str, Any]] = []
        self.size = settings.workers or len(os.sched_getaffinity(0))
        self._fork_server: ForkServer | None = None
        self._workers: set[_Worker] = set()
        # Last in, first out: the caches of the latest worker are warm.
        self._idle: asyncio.LifoQueue[_Worker] = asyncio.LifoQueue()
        self._tasks: set[asyncio.Task[Any]] = set()

    @property
    def alive(self) -> bool:
        """Whether there is a worker; one that does not answer in time is killed."""
        return any(not worker.killed for worker in self._workers)

    @property
    def pids(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.ready.pid for worker in self._workers]

    async def start(self) -> None:
        """Load weights and start workers; workers of an earlier start finish their request and end.

        Raises EdgeGraspError if the weights cannot be used.
        """
        fork_server = self._launched or ForkServer(self._settings, self.command)
        self._launched = None
        workers = [_Worker(fork_server) for _ in range(self.size)]
        try:
            await fork_server.wait_until_loaded()
            await asyncio.gather(*(worker.start() for worker in workers))
        except BaseException:
            fork_server.close()
            for worker in workers:
                worker.close()
            raise
        old_fork_server, old_workers = self._fork_server, self._workers
        self._fork_server, self._workers = fork_server, set(workers)
        while not self._idle.empty():
            self._idle.get_nowait()
        self.models, self.robots = workers[0].ready.models, workers[0].ready.robots
        self.spawn(self._watch(fork_server))
        for worker in workers:
            self.spawn(self._tend(worker))
        if old_fork_server is None:
            self.spawn(self._beat())
        else:
            old_fork_server.close()
        for worker in old_workers:
            if worker.answer is None:  # the others finish their current job
                worker.close()

    async def take(self) -> "_Worker":
        """The next idle worker for a job; first come, first served."""
        while True:
            worker = await self._idle.get()
            if worker in self._workers:  # and not dead
                return worker

    def spawn(self, work: Any) -> None:
        """Run a coroutine in the background, until it ends or the pool is closed."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def close(self) -> None:
        """Kill every worker."""
        for task in self._tasks:
            task.cancel()
        for worker in list(self._workers):
            worker.kill()
            worker.close()
        if self._fork_server is not None:
            self._fork_server.close()

    async def _beat(self) -> None:
        """Check regularly that an idle worker answers; one that does not is killed."""
        while True:
            await asyncio.sleep(HEARTBEAT_SECONDS)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(HEARTBEAT_TIMEOUT):
                    worker, beat = await self.take(), Job("Beat", "http", b"", 0.0)
                    await worker.run(beat, time.monotonic() + HEARTBEAT_TIMEOUT)

    async def _tend(self, worker: "_Worker") -> None:
        """Offer a worker for jobs until it dies, then replace it."""
        deaths = 1
        try:
            while True:
                if worker not in self._workers:
                    worker.close()  # newer workers have replaced it
                elif not worker.killed:  # the last answer may arrive after the kill
                    self._idle.put_nowait(worker)
                answer = await received(worker.reader)
                if answer is None:
                    break
                worker.finish(answer)
                if answer.facts.deaths:
                    worker.kill()  # it ran out of memory: its state cannot be trusted
            self._workers.discard(worker)  # `take` skips it
            if await worker.fork_server.crashed(worker.ready.pid):
                deaths = MAX_DEATHS
        finally:
            error = errors.WorkerLost(LOST) if deaths < MAX_DEATHS else errors.HarmfulRequest()
            worker.finish(Answer(b"", Facts(deaths=deaths), errors.to_problem(error)))
            worker.close()
        if worker.fork_server is self._fork_server:
            logger.warning("worker %d died and is replaced", worker.ready.pid)
            self._replaced()
            await self._until_done(worker.fork_server, lambda: self._replace(worker.fork_server))

    async def _replace(self, fork_server: "ForkServer") -> None:
        worker = _Worker(fork_server)
        try:
            async with asyncio.timeout(START_SECONDS if self._settings.device == "cpu" else None):
                await worker.start()
        except TimeoutError:  # it is stopped or hangs; its death is handled like any other
            worker.close()
            fork_server.close()
            why = "the process that workers fork from does not answer"
            raise errors.InvalidSettings(why) from None
        except BaseException:
            worker.close()
            raise
        if fork_server is self._fork_server:
            self._workers.add(worker)
        self.spawn(self._tend(worker))

    async def _until_done(
        self, fork_server: "ForkServer", start: Callable[[], Awaitable[None]]
    ) -> None:
        """Retry a start until it succeeds or there is a newer fork server."""
        while fork_server is self._fork_server:
            try:
                return await start()
            except (EdgeGraspError, OSError) as error:
                logger.error("a dead process cannot be replaced yet: %s", error)
                await asyncio.sleep(RETRY_SECONDS)

    async def _watch(self, fork_server: "ForkServer") -> None:
        """When a fork server dies, load the weights in a new one; the workers go on meanwhile."""
        await fork_server.watch()
        if fork_server is self._fork_server:
            logger.error("the process that workers fork from died; weights are loaded again")
            await self._until_done(fork_server, self.start)


class ForkServer:
    """The process that loads the weights, then forks workers; `command` replaces its command."""

    def __init__(self, settings: Settings, command: Sequence[str] = ()) -> None:
        self._control, theirs = socket.socketpair()
        with theirs:
            environment = KEPT_MEMORY | os.environ | dict.fromkeys(ONE_THREAD, "1")
            words = [*(command or FORK_SERVER_COMMAND), settings.model_dump_json()]
            self._process = subprocess.Popen(words, stdin=theirs.fileno(), env=environment)
        self._writer: asyncio.StreamWriter | None = None  # once it has loaded
        # By process id of an ended worker: whether it crashed or exited, not killed by the pool.
        self._crashed: defaultdict[int, asyncio.Future[bool]] = defaultdict(asyncio.Future)

    async def wait_until_loaded(self) -> None:
        """Wait until it has loaded; raises InvalidSettings on failure."""
        self._reader, self._writer = await asyncio.open_unix_connection(sock=self._control)
        self.pid = (await _ready(self._reader)).pid

    async def watch(self) -> None:
        """Note how its workers end, until it dies itself."""
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            while True:
                pid, status = ENDED.unpack(await self._reader.readexactly(ENDED.size))
                crashed = os.WIFSIGNALED(status) and os.WTERMSIG(status) in CRASH_SIGNALS
                if not self._crashed[pid].done():
                    self._crashed[pid].set_result(crashed or os.WIFEXITED(status))

    async def crashed(self, pid: int) -> bool:
        """Whether a dead worker crashed or exited, and was not killed."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATUS_SECONDS):
                return await self._crashed[pid]
        return False

    def fork(self, its_end: socket.socket) -> None:
        """Fork a worker that talks over a socket."""
        socket.send_fds(self._control, [b"w"], [its_end.fileno()])

    def close(self) -> None:
        """Kill the fork server, even if it is stopped; `watch` notices; its workers continue."""
        self._process.kill()
        self._process.wait()
        (self._writer or self._control).close()


class _Worker:
    """One worker process, at the other end of a socket."""

    def __init__(self, fork_server: ForkServer) -> None:
        self.fork_server = fork_server
        self.ready = Ready(0, [])  # the message that it sent when it had loaded
        self.answer: asyncio.Future[Answer] | None = None  # of the job that it works on
        self._writer: asyncio.StreamWriter | None = None
        self.killed = False

    async def start(self) -> None:
        """Fork the worker and wait until it is ready; raises InvalidSettings if it cannot load."""
        ours, theirs = socket.socketpair()
        with theirs:
            self.reader, self._writer = await asyncio.open_unix_connection(sock=ours)
            self.fork_server.fork(theirs)
        self.ready = await _ready(self.reader)

    async def run(self, job: Job, deadline: float) -> Answer:
        """Run a job until a deadline on the event loop's clock; if cancelled, kill the worker soon.

        The error of the answer is HarmfulRequest if the job killed the process, WorkerLost if it
        died for another reason.
        """
        loop = asyncio.get_running_loop()
        answer = self.answer = loop.create_future()
        assert self._writer is not None
        try:
            with contextlib.suppress(OSError):  # the worker has died, which the answer reports
                for part in pack(replace(job, remaining=deadline - loop.time())):
                    for place in range(0, len(part), PIECE_BYTES):
                        self._writer.write(memoryview(part)[place : place + PIECE_BYTES])
                        await self._writer.drain()
            return await asyncio.shield(answer)
        except asyncio.CancelledError:
            killing = loop.call_later(KILL_SECONDS, self.kill)
            answer.add_done_callback(lambda _: killing.cancel())
            raise

    def finish(self, answer: Answer) -> None:
        """Complete the worker's job, if any."""
        waiting, self.answer = self.answer, None
        if waiting is not None:
            waiting.set_result(answer)

    def kill(self) -> None:
        """Kill the worker."""
        self.killed = True
        if self.ready.pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.ready.pid, signal.SIGKILL)

    def close(self) -> None:
        """Close the connection; the process ends when it is idle."""
        if self._writer is not None:
            self._writer.close()


# In a worker


@contextlib.contextmanager
def limited_memory(most: int) -> Iterator[None]:
    """Limit this process to `most` bytes more than now; allocations beyond that fail."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    data_pages = int(Path("/proc/self/statm").read_text().split()[5])
    limit = data_pages * resource.getpagesize() + most
    if before[0] != resource.RLIM_INFINITY:
        limit = min(limit, before[0])
    resource.setrlimit(resource.RLIMIT_DATA, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
