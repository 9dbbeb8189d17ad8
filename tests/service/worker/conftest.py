"""Requests handed to a worker's `answer`, as the front does."""

from typing import Any

from benchmarks.dummy import DummyCatalogue

from edgegrasp_service.errors import Problem
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import answer
from edgegrasp_service.worker.process import Answer, Job


def ask(transport, body, media_type="", query="", scores=False, settings=None) -> Answer:
    """An answer, or an error that is the caller's and can be sent."""
    method: Any = "ScoreGrasps" if scores else "DetectGrasps"
    job = Job(method, transport, body, 60.0, media_type, query)
    told = answer(job, DummyCatalogue(), settings or Settings())
    assert bool(told.body) == (told.error is None)
    if told.error is not None:
        check_problem(told.error, told.facts.traceback)
    return told


def check_problem(problem: Problem, traceback: str = "") -> None:
    """An error of the caller's, which can be sent."""
    assert 400 <= problem.status < 500, traceback or problem
    problem.detail.encode()  # what cannot be encoded cannot be answered
    assert len(problem.detail) < 2000, problem.detail[:200]


def problem(*asked: Any, **more: Any) -> Problem:
    """The error of what `ask` is given, which names field, value and fix."""
    error = ask(*asked, **more).error
    for part in (error.field, error.value, error.fix):
        assert part
        assert part in error.detail
    return error


def form(*parts: tuple[str, bytes], end: bytes = b"--b--\r\n") -> bytes:
    """A form of parts, whose boundary is b."""
    packed = (b"--b\r\n%s\r\n\r\n%s\r\n" % (head.encode(), data) for head, data in parts)
    return b"".join(packed) + end


def part(name: str, data: bytes, more: str = "") -> tuple[str, bytes]:
    return f'Content-Disposition: form-data; name="{name}"{more}', data
