"""Log records as JSON lines or text; a thread writes them, so no log can hold up a request."""

import json
import logging
import os
import queue
import threading
from datetime import UTC, datetime
from typing import TextIO

from edgegrasp_service.request_id import REQUEST_ID
from edgegrasp_service.settings import Settings, one_line

MAX_WAITING = 4096  # lines; more than that, and new ones are dropped
STOP_SECONDS = 1.0


class JsonFormatter(logging.Formatter):
    """One JSON object a line, with `fields` of the record beside its message."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if request_id := REQUEST_ID.get():
            line["request_id"] = request_id
        line |= getattr(record, "fields", {})
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class TextFormatter(logging.Formatter):
    """A line to read; nothing a caller sent can begin another one."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record, and its traceback below."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(" ", "milliseconds")[:23]
        fields = {"request_id": REQUEST_ID.get()} if REQUEST_ID.get() else {}
        fields |= getattr(record, "fields", {})
        words = " ".join(f"{name}={value}" for name, value in fields.items())
        line = f"{time} {record.levelname} {record.name}: {record.getMessage()} {words}".rstrip()
        trace = f"\n{self.formatException(record.exc_info)}" if record.exc_info else ""
        return one_line(line) + trace


class LogWriter(logging.Handler):
    """Writes lines to a stream in a thread of its own, and goes on where that fails.

    Attributes:
        dropped: Lines that no one will read: the disk is full, the stream closed or not read.
    """

    def __init__(self, stream: TextIO | None, formatter: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self.dropped = 0
        self._stream = stream
        self._lines: queue.Queue[str | None] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._write_lines, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line of a record."""
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self.dropped += 1
        except Exception:  # of formatting; a request should not fail for it
            self.dropped += 1

    def close(self) -> None:
        """Write what is queued, unless nobody reads it."""
        try:
            self._lines.put(None, timeout=STOP_SECONDS)
            self._thread.join(STOP_SECONDS)
        except queue.Full:
            pass
        super().close()

    def _write_lines(self) -> None:
        while (line := self._lines.get()) is not None:
            self.dropped += not write_line(self._stream, line)


def write_line(stream: TextIO | None, line: str) -> bool:
    """Write a line past the stream's buffer, which would keep it and fail again on closing.

    Args:
        stream: None: this process was started with it closed.
        line: Without a line end.

    Returns:
        Whether it was written.
    """
    if stream is None:
        return False
    try:
        rest = f"{line}\n".encode("utf-8", "backslashreplace")
        while rest:
            rest = rest[os.write(stream.fileno(), rest) :]
    except (OSError, ValueError):
        return False
    return True


def start_logging(settings: Settings, stream: TextIO | None) -> LogWriter:
    """Send every record of this process to a stream; close what is returned when it ends."""
    terminal = stream is not None and not stream.closed and stream.isatty()
    text = settings.log_format == "text" or (settings.log_format == "auto" and terminal)
    writer = LogWriter(stream, TextFormatter() if text else JsonFormatter())
    logging.basicConfig(level=settings.log_level.upper(), handlers=[writer], force=True)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    return writer
