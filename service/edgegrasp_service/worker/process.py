"""Worker processes: their messages with the front, the workers, and the nursery they fork from.

usage: python -m edgegrasp_service.worker.process SETTINGS    as JSON; standard input: the pool's
socket

`main` runs the nursery. It imports and loads what a worker needs, then forks a worker whenever the
pool asks for one; that takes milliseconds, and memory is shared until written to. The nursery never
has a second thread. A message has plain values as JSON, and a body as bytes.
"""

import contextlib
import gc
import json
import os
import resource
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import Problem, WorkerLost, report
from edgegrasp_service.settings import Settings

ORPHAN_SECONDS = 10.0  # seconds after its deadline at which a worker ends itself if nobody kills it
ENDED = struct.Struct("=ii")  # the nursery's message about a worker: process id and wait status
LOST = "The worker of this request died or ran out of memory. Try again, or send fewer points."
HEADER = struct.Struct(">QQ")  # bytes of a message's JSON, and of the body that follows it
PIECE = 2**16  # bytes of a body that the front reads or writes at a time

Method = Literal["DetectGrasps", "ScoreGrasps", "RecordOutcome", "Beat"]  # Beat: is it alive?
Transport = Literal["http", "grpc"]


@dataclass(frozen=True)
class Job:
    """One request as it arrived; the front passes it on undecoded."""

    method: Method
    transport: Transport
    body: bytes  # of HTTP, in the front a bytearray; or the serialized request message
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
    options: str = ""  # options that differ from the defaults, as shortened JSON
    traceback: str = ""  # of an internal error


@dataclass(frozen=True)
class Answer:
    """The result of a job."""

    body: bytes  # JSON, or the serialized response message; empty for an error
    facts: Facts
    error: Problem | None = None  # None: a success


@dataclass(frozen=True)
class Ready:
    """The first message of the nursery and of each worker."""

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
    return HEADER.pack(len(text), len(body)) + text, body


def unpack(text: bytes, body: bytes) -> Any:
    """Deserialize a message from its plain fields, as JSON, and its body."""
    name, fields = json.loads(text)
    if name != "Ready":
        fields["body"] = body
    if name == "Answer":
        fields["facts"] = Facts(**fields["facts"])
        fields["error"] = fields["error"] and Problem(**fields["error"])
    return MESSAGES[name](**fields)


def receive(file: BinaryIO) -> Any:
    """The next message; None at the end."""
    head = file.read(HEADER.size)
    if len(head) < HEADER.size:
        return None
    length, body_length = HEADER.unpack(head)
    return unpack(file.read(length), file.read(body_length))


# The nursery and its workers


def main(settings_json: str, load: Callable[[Settings], Any] | None = None) -> None:
    """Load, then fork a worker for each socket received on standard input, until it closes.

    `settings_json` holds the settings; `load` replaces `load_catalogue`.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the pool decides when to end
    gc.disable()  # it would take a fifth of the start, and scan millions of lists of points later
    # Imported here, since the front imports this module but must not load parsers.
    from edgegrasp_service.worker.answer import load_catalogue

    pool, settings = socket.socket(fileno=0), Settings(**json.loads(settings_json))
    loading = partial(load or load_catalogue, settings)
    try:
        # A GPU's context cannot be forked: with one, every worker loads the weights for itself.
        catalogue = loading() if settings.device == "cpu" else None
    except (EdgeGraspError, ModuleNotFoundError) as error:
        _send(pool, Ready(os.getpid(), [], str(error)))
        return
    _send(pool, Ready(os.getpid(), []))
    signal.signal(signal.SIGCHLD, lambda *_: _tell_of_ended(pool))
    gc.freeze()  # collecting garbage would write to shared pages
    while True:
        _, descriptors, _, _ = socket.recv_fds(pool, 1, 1)
        if not descriptors:
            return
        if os.fork() == 0:
            try:
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                pool.close()
                _work(socket.socket(fileno=descriptors[0]), settings, catalogue, loading)
            except Exception:
                traceback.print_exc()
            finally:
                os._exit(0)
        os.close(descriptors[0])


def _tell_of_ended(pool: socket.socket) -> None:
    with contextlib.suppress(OSError):  # there are no more
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            pool.send(ENDED.pack(*ended), socket.MSG_DONTWAIT)


def _work(
    pool: socket.socket, settings: Settings, catalogue: Any, loading: Callable[[], Any]
) -> None:
    """Answer jobs, one after the other, until the pool closes the socket."""
    from edgegrasp_service.worker.answer import answer, load_robots

    try:
        catalogue = catalogue or loading()
    except (EdgeGraspError, ModuleNotFoundError) as error:
        _send(pool, Ready(os.getpid(), [], str(error)))
        return
    robots = [robot.describe() for robot in load_robots(settings).values()]
    with limited_memory(settings.max_worker_bytes):
        _send(pool, Ready(os.getpid(), catalogue.describe(), robots=robots))
        jobs = pool.makefile("rb")
        while (job := receive(jobs)) is not None:
            signal.setitimer(signal.ITIMER_REAL, max(job.remaining, 0.0) + ORPHAN_SECONDS)
            try:
                found = answer(job, catalogue, settings)
            except BaseException:  # out of memory
                facts = Facts(traceback=traceback.format_exc())
                _send(pool, Answer(b"", facts, report(WorkerLost(LOST))))
                return
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            _send(pool, found)
            del job, found  # otherwise they would add to the next request's
            gc.collect()


@contextlib.contextmanager
def limited_memory(most: int) -> Iterator[None]:
    """Limit this process to so many more bytes; allocations beyond that fail."""
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


def _send(to: socket.socket, message: object) -> None:
    for part in pack(message):
        to.sendall(part)


if __name__ == "__main__":
    from edgegrasp_service.worker import process  # whose messages workers make

    process.main(sys.argv[1])
