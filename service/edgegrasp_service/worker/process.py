"""The nursery, which loads everything once, and the workers that fork from it.

usage: python -m edgegrasp_service.worker.process SETTINGS    as JSON; standard input: the pool's
socket

`main` runs the nursery. It imports and loads what a worker needs, then forks a worker whenever the
pool asks for one; that takes milliseconds, and memory is shared until written to. The nursery never
has a second thread.
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
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import WorkerLost, report
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.job import Answer, Facts, Ready, pack, receive

ORPHAN_SECONDS = 10.0  # seconds after its deadline at which a worker ends itself if nobody kills it
ENDED = struct.Struct("=ii")  # the nursery's message about a worker: process id and wait status
LOST = "The worker of this request died or ran out of memory. Try again, or send fewer points."


def main(settings_json: str, load: Callable[[Settings], Any] | None = None) -> None:
    """Load, then fork a worker for each socket received on standard input, until it closes.

    `settings_json` holds the settings; `load` replaces `load_catalogue`.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the pool decides when to end
    # Imported here, since the front imports this module but must not load parsers.
    from edgegrasp_service.worker.answer import load_catalogue

    pool, settings = socket.socket(fileno=0), Settings(**json.loads(settings_json))
    loading = partial(load or load_catalogue, settings)
    try:
        # A GPU's context cannot be forked: with one, every worker loads the weights for itself.
        catalogue = loading() if settings.device == "cpu" else None
    except EdgeGraspError as error:
        _send(pool, Ready(os.getpid(), [], str(error)))
        return
    _send(pool, Ready(os.getpid(), []))
    signal.signal(signal.SIGCHLD, lambda *_: _tell_of_ended(pool))
    gc.collect()
    gc.freeze()  # collecting garbage would write to shared pages
    gc.disable()  # it would scan millions of lists of points repeatedly
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
    except EdgeGraspError as error:
        _send(pool, Ready(os.getpid(), [], str(error)))
        return
    robots = [robot.describe() for robot in load_robots(settings).values()]
    with limited_memory(settings.max_worker_bytes):
        _send(pool, Ready(os.getpid(), catalogue.describe(), robots=robots))
        _answer_jobs(pool, partial(answer, catalogue=catalogue, settings=settings))


def _answer_jobs(pool: socket.socket, work: Callable[[Any], Answer]) -> None:
    jobs = pool.makefile("rb")
    while (job := receive(jobs)) is not None:
        signal.setitimer(signal.ITIMER_REAL, max(job.remaining, 0.0) + ORPHAN_SECONDS)
        try:
            answer: Answer = work(job)
        except BaseException:  # out of memory
            facts = Facts(traceback=traceback.format_exc())
            _send(pool, Answer(b"", facts, report(WorkerLost(LOST))))
            return
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        _send(pool, answer)
        del job, answer  # otherwise they would add to the next request's
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
    main(sys.argv[1])
