"""The processes that work: one that loads everything once, and those that fork from it.

`main` is the nursery's. It imports and loads what a worker needs, and then forks a worker whenever
the pool asks for one: there in milliseconds, its memory shared with all others until it is written
to. The nursery never has a second thread.
"""

import contextlib
import gc
import json
import os
import resource
import signal
import socket
import struct
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import Problem, WorkerLost, report
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.job import Answer, Facts, Job, Limits

ORPHAN_SECONDS = 10.0  # after its deadline a worker ends itself, should nobody be left to kill it
HEADER = struct.Struct(">QQ")  # bytes of a message's JSON, and of the body that follows it
LOST = "The worker of this request died or ran out of memory. Try again, or send fewer points."


def main(load: Callable[[Settings], Any] | None = None) -> None:
    """Load, then fork a worker for each socket that comes; until the pool is gone.

    Args:
        load: Makes the catalogue; None: `load_catalogue`.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the pool says when to end
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # no zombies
    pool = socket.socket(fileno=0)
    if (told := receive(pool.recv_into)) is None:
        return
    settings = Settings(**told.settings)
    try:
        start = _prepare(settings, load)
        send(pool, Ready(os.getpid(), []))
    except EdgeGraspError as error:
        send(pool, Ready(os.getpid(), [], str(error)))
        return
    gc.collect()
    gc.freeze()  # collecting would write to pages that are shared
    while True:
        _, descriptors, _, _ = socket.recv_fds(pool, 1, 1)
        if not descriptors:
            return
        if os.fork() == 0:
            try:
                pool.close()
                _work(socket.socket(fileno=descriptors[0]), settings, start)
            except Exception:
                traceback.print_exc()
            finally:
                os._exit(0)
        os.close(descriptors[0])


def _prepare(settings: Settings, load: Callable[[Settings], Any] | None) -> Callable[[], Any]:
    """Import and load; returns what gives each worker its answerer and facts of its models.

    A GPU's context cannot be forked: with one, every worker loads the weights for itself.
    """
    from edgegrasp_service.worker import answer

    load = load or answer.load_catalogue
    catalogue = load(settings) if settings.device == "cpu" else None

    def start() -> tuple[Any, list[dict[str, Any]]]:
        loaded = catalogue or load(settings)
        return answer.Answerer(loaded, limits(settings)), answer.describe(loaded)

    return start


def limits(settings: Settings) -> Limits:
    """The settings that bound one request."""
    return Limits(**{name: getattr(settings, name) for name in Limits.__dataclass_fields__})


def _work(pool: socket.socket, settings: Settings, start: Callable[[], Any]) -> None:
    """Answer jobs, one after the other, until the pool closes the socket."""
    try:
        answerer, models = start()
    except EdgeGraspError as error:
        send(pool, Ready(os.getpid(), [], str(error)))
        return
    _limit_memory(settings.max_worker_bytes)
    send(pool, Ready(os.getpid(), models))
    while (job := receive(pool.recv_into)) is not None:
        signal.setitimer(signal.ITIMER_REAL, max(job.remaining, 0.0) + ORPHAN_SECONDS)
        try:
            answer: Answer = answerer.answer(job)
        except BaseException:  # out of memory
            facts = Facts(traceback=traceback.format_exc())
            send(pool, Answer(b"", facts, report(WorkerLost(LOST))))
            return
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        send(pool, answer)
        del job, answer  # or the next request would add to them


def _limit_memory(most: int) -> None:
    """Let this process take so many bytes more than it has; an allocation beyond that fails."""
    with contextlib.suppress(OSError):  # no /proc: no limit
        data_pages = int(Path("/proc/self/statm").read_text().split()[5])
        limit = data_pages * resource.getpagesize() + most
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


# Messages between the pool and its processes: plain JSON, and bodies as bytes


@dataclass(frozen=True)
class Start:
    """What the nursery is told first."""

    settings: dict[str, Any]  # those that are not secret


@dataclass(frozen=True)
class Ready:
    """What the nursery and its workers say first."""

    pid: int
    models: list[dict[str, Any]]  # as `answer.describe` gives them; of workers
    failure: str = ""  # why there is none after all


MESSAGES = {kind.__name__: kind for kind in (Start, Ready, Job, Answer)}


def send(to: socket.socket, message: object) -> None:
    """Send one message."""
    head, body = pack(message)
    to.sendall(head)
    to.sendall(body)


def receive(read_into: Callable[[memoryview], int]) -> Any:
    """The next message of a socket or a file; None: it has ended."""
    if not (head := _read(read_into, HEADER.size)):
        return None
    length, body_length = HEADER.unpack(head)
    return unpack(_read(read_into, length), bytes(_read(read_into, body_length)))


def pack(message: object) -> tuple[bytes, bytes]:
    """One of MESSAGES as bytes: the lengths and its plain fields, and its body, not copied."""
    text = json.dumps([type(message).__name__, message], default=_plain).encode()
    body: bytes = getattr(message, "body", b"")
    return HEADER.pack(len(text), len(body)) + text, body


def unpack(text: bytes | bytearray, body: bytes) -> Any:
    """The message of its plain fields, as JSON, and its body."""
    name, fields = json.loads(text)
    if "body" in fields:
        fields["body"] = body
    if name == "Answer":
        fields["facts"] = Facts(**fields["facts"])
        fields["error"] = fields["error"] and Problem(**fields["error"])
    return MESSAGES[name](**fields)


def _plain(value: Any) -> Any:
    """Of JSON, where it does not know a value: the fields of a message, and nothing of a body."""
    return "" if isinstance(value, bytes) else vars(value)


def _read(read_into: Callable[[memoryview], int], size: int) -> bytearray:
    """So many bytes; empty where there are not so many any more."""
    data = bytearray(size)
    view, done = memoryview(data), 0
    with contextlib.suppress(ConnectionError):
        while done < size and (count := read_into(view[done:])):
            done += count
    return data if done == size else bytearray()
