"""Files that the server writes: recorded requests for `edgegrasp replay`, and outcomes."""

import asyncio
import errno
import fcntl
import logging
import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from edgegrasp_service.errors import DiskFull, InvalidSettings, PayloadTooLarge
from edgegrasp_service.worker.process import Answer, Job, pack

logger = logging.getLogger(__name__)

MAX_LINE_BYTES = 4096  # more than the bytes of one outcome
MAX_OUTCOMES_BYTES = 64 * 2**20  # a file of outcomes larger than this takes no more


class Recorder:
    """Writes each request and its answer to a file TIME-ID.job, in the workers' message format.

    The oldest files are deleted beyond `most` bytes in total. `hold` reserves the bytes waiting to
    be written and frees them (negative); a request for which there is no room is not recorded.

    Raises:
        InvalidSettings: The folder cannot be made or read.
    """

    def __init__(self, folder: Path, most: int, hold: Callable[[int], bool]) -> None:
        try:
            folder.mkdir(exist_ok=True)
            files = [(one, one.stat().st_size) for one in folder.iterdir() if one.suffix == ".job"]
        except OSError as error:
            why = f"record_folder: got {str(folder)!r}. {error.strerror}."
            raise InvalidSettings(why) from None
        self._folder = folder
        self._most = most
        self._hold = hold
        self._files = deque(sorted(files))  # path and size, the oldest first
        self._bytes = sum(size for _, size in files)
        self._thread = ThreadPoolExecutor(1, "recorder")

    def record(self, job: Job, answer: Answer) -> None:
        """Queue one request and its answer for writing."""
        size = len(job.body) + len(answer.body)
        if not self._hold(size):
            logger.warning("%s is not recorded: the disk is too slow", job.request_id)
            return
        loop = asyncio.get_running_loop()
        writing = loop.run_in_executor(self._thread, self._write, datetime.now(UTC), job, answer)
        writing.add_done_callback(lambda _: self._hold(-size))

    def close(self) -> None:
        """Write the queued recordings."""
        self._thread.shutdown()

    def _write(self, time: datetime, job: Job, answer: Answer) -> None:
        name = "".join(letter if letter.isalnum() else "_" for letter in job.request_id)
        path = self._folder / f"{time:%Y%m%dT%H%M%S%fZ}-{name}.job"
        parts = *pack(job), *pack(answer)
        try:
            if (size := sum(map(len, parts))) > self._most:
                raise OSError(f"it has {size} bytes, more than record_bytes")
            with path.open("wb") as file:
                file.writelines(parts)
            self._files.append((path, size))
            self._bytes += size
            while self._bytes > self._most:
                oldest, size = self._files.popleft()
                self._bytes -= size
                oldest.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("%s is not recorded: %s", job.request_id, error)
            path.unlink(missing_ok=True)


# Outcomes: what became of grasps, a line each, for `edgegrasp train --outcomes`


class TriedGrasp(BaseModel):
    """A grasp that a robot executed."""

    model_config = ConfigDict(extra="forbid", strict=True)

    model: str = Field(min_length=1, max_length=200, description="weights that scored it")
    score: float = Field(ge=0.0, le=1.0, description="as it was answered")
    held: bool = Field(description="whether it held")
    request_id: str = Field("", max_length=200, description="of the request that found it")


def append_line(path: Path, line: bytes) -> None:
    """Append a whole line or nothing; an incomplete last line is replaced.

    Raises PayloadTooLarge if the file is full, and DiskFull if the disk is full or the file cannot
    be written.
    """
    try:
        with os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), "r+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # workers write one at a time
            end = file.seek(0, os.SEEK_END)
            if end > MAX_OUTCOMES_BYTES:
                raise PayloadTooLarge("outcomes", "more than the file takes", "Move the file away.")
            if not line:
                return
            start = file.seek(max(0, end - MAX_LINE_BYTES))
            tail = file.read(MAX_LINE_BYTES)
            if tail.endswith(b"}"):  # complete; an editor left out the newline
                line = b"\n" + line
            else:
                end = start + tail.rfind(b"\n") + 1
            file.truncate(end)
            file.seek(end)
            if file.write(line) != len(line):
                file.truncate(end)
                raise OSError(errno.ENOSPC, "No space left on device")
    except OSError as error:
        raise DiskFull(f"The outcome is not kept: {error.strerror}.") from None


def check_outcomes(path: Path) -> None:
    """Raise InvalidSettings unless outcomes can be written to the file."""
    try:
        append_line(path, b"")
    except (DiskFull, PayloadTooLarge) as error:
        raise InvalidSettings(f"outcomes_file: got {str(path)!r}. {error}") from None
