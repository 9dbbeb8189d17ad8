"""The processes that test servers' workers fork from: dummies whose stages wait and fail as told.

usage: fork_server.py SOCKET    import everything once, then fork a fork server per request
"""

import contextlib
import fcntl
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.dummy import DummyCatalogue, DummyDetector

from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, UnknownModel
from edgegrasp_service import errors
from edgegrasp_service.errors import Overloaded, kind_of
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker import answer as answer  # what a fork server imports
from edgegrasp_service.worker.fork_server import main

PATIENCE = 20  # seconds; longer than anything takes
FOLDER = Path()  # what a test writes into it tells what happens


def answer_fork_requests(path: str) -> None:
    """A client sends its pool's socket, a folder and settings; its fork server ends with it."""
    global FOLDER
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(path)
    listening.listen()
    os.write(1, b"ready\n")
    while True:
        asked, _ = listening.accept()
        told, pools, _, _ = socket.recv_fds(asked, 2**16, 1)
        if pools and os.fork() == 0:
            listening.close()
            fcntl.fcntl(asked, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(asked, fcntl.F_SETFL, os.O_ASYNC)  # SIGIO once who asked is gone: the end
            os.dup2(pools[0], 0)
            os.close(pools[0])
            folder, settings_json = told.decode().split("\n")
            FOLDER = Path(folder)
            try:
                main(settings_json, load)
            finally:
                os._exit(0)
        for pool in pools:
            os.close(pool)
        asked.close()


def stage(name: str) -> None:
    """Note that a stage begins, then wait while it is shut, and fail where it is to."""
    with (FOLDER / "begun").open("a") as begun:
        begun.write(f"{name}\n")
    end = time.monotonic() + PATIENCE
    while (FOLDER / f"shut-{name}").exists():
        assert time.monotonic() < end, f"the gate of {name} stayed shut"
        time.sleep(0.002)
    with contextlib.suppress(FileNotFoundError):
        fault = FOLDER / f"fault-{name}"
        kind = fault.read_text()
        fault.unlink()
        fail(kind)


def fail(kind: str) -> None:
    """Die, spin or raise; once for each file that says so."""
    match kind:
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "spin":
            while True:
                pass
        case "eat":
            blocks = []
            while True:
                blocks.append(bytearray(2**24))
        case "ValueError":
            raise ValueError("secret")
        case "MemoryError":
            raise RuntimeError("DefaultCPUAllocator: can't allocate memory: secret")
        case _:
            raise example(kind)


def example(kind: str) -> Exception:
    """An error of the table."""
    found = next(error for error in errors.STATUS if kind_of(error) == kind)
    if found is UnknownModel:
        return UnknownModel("wanted", ["a", "b"])
    if found is errors.HarmfulRequest:
        return errors.HarmfulRequest()
    if found is Overloaded:
        return Overloaded("What happened.", 7.0)
    if issubclass(found, InvalidRequest):
        return found("cloud", "a value", "Fix it.")
    return found("What happened.")


class Detector(DummyDetector):
    def prepare(self, *given: Any, **named: Any) -> Any:
        stage("prepare")
        return super().prepare(*given, **named)

    def evaluate(self, prepared: Any) -> Any:
        stage("evaluate")
        return super().evaluate(prepared)

    def finish(self, *given: Any) -> Any:
        stage("finish")
        return super().finish(*given)

    def score(self, *given: Any, **named: Any) -> Any:
        stage("score")
        return super().score(*given, **named)


class Catalogue(DummyCatalogue):
    """Every load gives the next digest."""

    def __init__(self) -> None:
        stage("load")
        self.digest = str((FOLDER / "begun").read_text().split().count("load"))
        self._detector = Detector()

    def describe(self) -> Sequence[Mapping[str, Any]]:
        return [{**super().describe()[0], "digest": self.digest}]


def load(settings: Settings) -> Catalogue:
    failing = FOLDER / "fault-weights"  # stays until it is deleted
    if failing.exists():
        raise EdgeGraspError(failing.read_text())
    return Catalogue()


if __name__ == "__main__":
    answer_fork_requests(sys.argv[1])
