"""The fork server, the process that workers are forked from, and the loop of a worker.

usage: python -m edgegrasp_service.worker.fork_server SETTINGS    as JSON; standard input: the
pool's socket

It imports and loads what a worker needs, then forks a worker whenever the pool asks for one; that
takes milliseconds, and memory is shared until written to. It never has a second thread.
"""

import contextlib
import gc
import json
import os
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from typing import Any

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service import errors
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.process import (
    ENDED,
    LOST,
    Answer,
    Facts,
    Ready,
    limited_memory,
    receive,
    send,
)

ORPHAN_SECONDS = 10.0  # seconds after its deadline at which a worker ends itself if nobody kills it


def main(settings_json: str, load: Callable[[Settings], Any] | None = None) -> None:
    """Load, then fork a worker for each socket received on standard input, until it closes.

    `settings_json` holds the settings; `load` replaces `load_catalogue`.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the pool decides when to end
    gc.disable()  # it takes a fifth of the start-up, and would later scan millions of point lists
    from edgegrasp_service.worker.answer import load_catalogue  # takes most of the start

    pool, settings = socket.socket(fileno=0), Settings(**json.loads(settings_json))
    load = load or load_catalogue
    # A GPU's context cannot be forked: with one, every worker loads the weights for itself.
    catalogue = _load_or_exit(pool, settings, load) if settings.device == "cpu" else None
    send(pool, Ready(os.getpid(), []))
    signal.signal(signal.SIGCHLD, lambda *_: _report_exits(pool))
    gc.freeze()  # collecting garbage would write to shared pages
    while True:
        _, descriptors, _, _ = socket.recv_fds(pool, 1, 1)
        if not descriptors:
            return
        if os.fork() == 0:
            try:
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                pool.close()
                _work(socket.socket(fileno=descriptors[0]), settings, catalogue, load)
            except Exception:
                traceback.print_exc()
            finally:
                os._exit(0)
        os.close(descriptors[0])


def _report_exits(pool: socket.socket) -> None:
    with contextlib.suppress(OSError):  # no children are left
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            pool.send(ENDED.pack(*ended), socket.MSG_DONTWAIT)


def _load_or_exit(pool: socket.socket, settings: Settings, load: Callable[[Settings], Any]) -> Any:
    """Load what answers requests; if that fails, tell the pool why and end this process."""
    try:
        return load(settings)
    except (EdgeGraspError, ModuleNotFoundError) as error:
        with contextlib.suppress(OSError):  # another worker has reported it already
            send(pool, Ready(os.getpid(), [], str(error)))
        sys.exit()


def _work(
    pool: socket.socket, settings: Settings, catalogue: Any, load: Callable[[Settings], Any]
) -> None:
    """Answer jobs, one after another, until the pool closes the socket."""
    from edgegrasp_service.worker.answer import answer, load_robots

    catalogue = catalogue or _load_or_exit(pool, settings, load)
    robots = [robot.describe() for robot in load_robots(settings).values()]
    with limited_memory(settings.max_worker_bytes):
        send(pool, Ready(os.getpid(), catalogue.describe(), robots=robots))
        jobs = pool.makefile("rb")
        while (job := receive(jobs)) is not None:
            signal.setitimer(signal.ITIMER_REAL, max(job.remaining, 0.0) + ORPHAN_SECONDS)
            try:
                found = answer(job, catalogue, settings)
            except BaseException:  # out of memory
                facts = Facts(traceback=traceback.format_exc(), deaths=1)
                send(pool, Answer(b"", facts, errors.to_problem(errors.WorkerLost(LOST))))
                return
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            send(pool, found)
            del job, found  # otherwise their memory would add to the next request's
            gc.collect()


if __name__ == "__main__":
    main(sys.argv[1])
