"""Outcomes of executed grasps: a line each in a file, for `edgegrasp train --outcomes`."""

import errno
import fcntl
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import orjson
from pydantic import BaseModel, ConfigDict, Field

from edgegrasp_service.errors import DiskFull, InvalidSettings, PayloadTooLarge

MAX_LINE = 4096  # bytes of an outcome, and more
MAX_OUTCOMES = 64 * 2**20  # bytes at which their file takes no more


class TriedGrasp(BaseModel):
    """A grasp that a robot executed."""

    model_config = ConfigDict(extra="forbid")

    model: str = Field(min_length=1, max_length=200, description="weights that scored it")
    score: float = Field(ge=0.0, le=1.0, description="as it was answered")
    held: bool = Field(description="whether it held")
    request_id: str = Field("", max_length=200, description="of the request that found it")


def append_outcome(tried: TriedGrasp, catalogue: Any, path: Path) -> None:
    """Append a grasp and the digest of its weights.

    Raises:
        UnknownModel: There are no such weights.
        PayloadTooLarge: The file is full.
        DiskFull: The disk is, or the file cannot be written.
    """
    catalogue.get(tried.model)
    digest = {row["name"]: row["digest"] for row in catalogue.describe()}[tried.model]
    line = tried.model_dump() | {"digest": digest, "time": datetime.now(UTC).isoformat()}
    append_line(path, orjson.dumps(line) + b"\n")


def append_line(path: Path, line: bytes) -> None:
    """Append a whole line or nothing; an incomplete last line is removed first.

    Raises PayloadTooLarge where the file is full, DiskFull where the disk is, or it cannot be
    written.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        with os.fdopen(descriptor, "r+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # workers write one at a time
            end = file.seek(0, os.SEEK_END)
            if end > MAX_OUTCOMES:
                raise PayloadTooLarge("outcomes", "more than the file takes", "Move the file away.")
            start = file.seek(max(0, end - MAX_LINE))
            end = start + file.read(MAX_LINE).rfind(b"\n") + 1
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
