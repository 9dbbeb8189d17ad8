"""Requests and their answers in a folder, for the day a robot misses: recorded, and replayed."""

import dataclasses
import json
import logging
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from edgegrasp_service.observability import Call
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.job import Answer, Job

logger = logging.getLogger(__name__)


class Recorder:
    """Writes each request as NAME.job, its body, NAME.json, what is known of it, and NAME.answer.

    NAME is the time and the request's id, so that names sort by time.

    Args:
        folder: Made if it is not there.
        most: Bytes of all files; the oldest are deleted.
    """

    def __init__(self, folder: Path, most: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._most = most
        self._thread = ThreadPoolExecutor(1, "recorder")

    def record(self, call: Call, job: Job, answer: Answer) -> None:
        """Write one request and its answer, soon."""
        self._thread.submit(self._write, datetime.now(UTC), call.peer, job, answer)

    def close(self) -> None:
        """Write what is left."""
        self._thread.shutdown()

    def _write(self, time: datetime, peer: str, job: Job, answer: Answer) -> None:
        letters = [letter if letter.isalnum() else "_" for letter in job.request_id]
        path = self._folder / f"{time:%Y%m%dT%H%M%S%fZ}-{''.join(letters)}"
        known = {
            "time": time.isoformat(),
            "peer": peer,
            "job": dataclasses.asdict(dataclasses.replace(job, body=b"")) | {"body": ""},
            "facts": dataclasses.asdict(answer.facts),
            "error": None if answer.error is None else dataclasses.asdict(answer.error),
        }
        try:
            path.with_name(f"{path.name}.job").write_bytes(job.body)
            path.with_name(f"{path.name}.answer").write_bytes(answer.body)
            path.with_name(f"{path.name}.json").write_text(json.dumps(known, indent=2))
            self._delete_oldest()
        except OSError as error:
            logger.warning("%s is not recorded: %s", job.request_id, error)

    def _delete_oldest(self) -> None:
        files = sorted(self._folder.iterdir())
        sizes = {path: path.stat().st_size for path in files}
        total = sum(sizes.values())
        for path in files:
            if total <= self._most:
                return
            if path.suffix in (".job", ".answer", ".json"):
                path.unlink(missing_ok=True)
                total -= sizes[path]


class Replay(NamedTuple):
    """A recorded request, answered again."""

    job: Job
    recorded: bytes  # the answer's body then; empty for an error
    answer: Answer  # now


def replay(path: Path, settings: Settings) -> Replay:
    """Answer a recorded request again, in this process.

    Args:
        path: NAME.job, NAME.json or NAME.answer.
        settings: Weights and limits.

    Raises:
        OSError: A file of the recording cannot be read.
        EdgeGraspError: Weights cannot be used.
    """
    from edgegrasp_service.worker.answer import Answerer, load_catalogue
    from edgegrasp_service.worker.process import limits

    known = json.loads(path.with_suffix(".json").read_text())
    fields = known["job"] | {"body": path.with_suffix(".job").read_bytes()}
    job = Job(**fields | {"remaining": settings.max_request_seconds})
    answer = Answerer(load_catalogue(settings), limits(settings)).answer(job)
    return Replay(job, path.with_suffix(".answer").read_bytes(), answer)
