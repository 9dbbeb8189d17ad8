"""Requests and answers in a folder, for the day a robot misses; `edgegrasp replay` reads it."""

import logging
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from edgegrasp_service.worker.job import Answer, Job, pack

logger = logging.getLogger(__name__)


class Recorder:
    """Writes each request and its answer to a file TIME-ID.job, as the messages of a worker.

    Beyond `most` bytes of all files the oldest are deleted.
    """

    def __init__(self, folder: Path, most: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._most = most
        self._thread = ThreadPoolExecutor(1, "recorder")

    def record(self, job: Job, answer: Answer) -> None:
        """Write one request and its answer, soon."""
        self._thread.submit(self._write, datetime.now(UTC), job, answer)

    def close(self) -> None:
        """Write what is left."""
        self._thread.shutdown()

    def _write(self, time: datetime, job: Job, answer: Answer) -> None:
        name = "".join(letter if letter.isalnum() else "_" for letter in job.request_id)
        path = self._folder / f"{time:%Y%m%dT%H%M%S%fZ}-{name}.job"
        try:
            with path.open("wb") as file:
                file.writelines((*pack(job), *pack(answer)))
            files = sorted(self._folder.glob("*.job"))
            sizes = [path.stat().st_size for path in files]
            while sum(sizes) > self._most:
                files.pop(0).unlink(missing_ok=True)
                sizes.pop(0)
        except OSError as error:
            logger.warning("%s is not recorded: %s", job.request_id, error)
