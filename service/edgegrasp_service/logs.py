"""Log records as JSON lines or text; a thread writes them, so no log can hold up a request."""

import contextlib
import json
import logging
import logging.handlers
import os
import queue
import threading
from datetime import UTC, datetime
from typing import TextIO

from edgegrasp_service.call import CALL, Call
from edgegrasp_service.settings import Settings, one_line

MAX_WAITING = 4096  # records; more than that, and new ones are dropped
STOP_SECONDS = 1.0
PROBES = ("Live", "Ready", "HealthCheck", "Metrics")  # every few seconds; not worth a line

requests = logging.getLogger("edgegrasp_service.requests")


def log_call(call: Call) -> None:
    """Write one line about a call that has ended, and another about a fault of the server."""
    if call.facts.traceback:
        fault = {"traceback": call.facts.traceback}
        requests.error("%s failed with %s", call.method, call.facts.options, extra=fault)
    level = logging.DEBUG if call.method in PROBES else logging.INFO
    if call.problem is not None and call.problem.status >= 500:
        level = logging.WARNING
    if not requests.isEnabledFor(level):
        return
    milliseconds = {name: round(seconds * 1e3, 1) for name, seconds in call.stages.items()}
    fields = {
        "transport": call.transport,
        "method": call.method,
        "code": call.code,
        "error": "" if call.problem is None else call.problem.kind,
        "detail": "" if call.problem is None else call.problem.detail,
        "seconds": round(call.seconds, 6),
        "peer": call.peer,
        "token": call.token,
        "bytes_in": call.bytes_in,
        "bytes_out": call.bytes_out,
        "model": call.facts.model,
        "points": call.facts.points,
        "voxels": call.facts.voxels,
        "grasps": call.facts.grasps,
        "milliseconds": milliseconds,
    }
    known = {name: value for name, value in fields.items() if value not in ("", 0, {})}
    requests.log(level, "request", extra={"fields": {"request_id": call.request_id} | known})


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
        line |= getattr(record, "fields", {})
        if trace := _traceback(self, record):
            line["exception"] = trace
        return json.dumps(line, default=str)


class TextFormatter(logging.Formatter):
    """A line to read; nothing a caller sent can begin another one."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record, and its traceback below."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(" ", "milliseconds")[:23]
        fields = getattr(record, "fields", {})
        words = " ".join(f"{name}={value}" for name, value in fields.items())
        line = f"{time} {record.levelname} {record.name}: {record.getMessage()} {words}"
        trace = _traceback(self, record)
        return one_line(line.rstrip()) + (f"\n{trace}" if trace else "")


def _traceback(formatter: logging.Formatter, record: logging.LogRecord) -> str:
    """Of this process, or of the worker that told of it; empty: there is none."""
    told: str = getattr(record, "traceback", "")
    return formatter.formatException(record.exc_info) if record.exc_info else told


class LogQueue(logging.handlers.QueueHandler):
    """Hands lines to a thread that writes them, and goes on where that fails.

    Attributes:
        dropped: Lines that no one will read: the disk is full, the stream closed or not read.
    """

    def __init__(self, stream: TextIO | None, formatter: logging.Formatter) -> None:
        super().__init__(queue.Queue(MAX_WAITING))
        self.setFormatter(formatter)
        self.dropped = 0
        self._closed = False
        self._stream = stream
        writer = logging.Handler()
        writer.handle = self._write  # type: ignore[method-assign, assignment]
        self._listener = logging.handlers.QueueListener(self.queue, writer)
        self._listener.start()

    def prepare(self, record: logging.LogRecord) -> str:
        """The line of a record, while its request is known."""
        call = CALL.get()
        if call is not None and not hasattr(record, "fields"):
            record.fields = {"request_id": call.request_id}
        return self.format(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Count a line that cannot be formatted, or that there is no room for."""
        self.dropped += 1

    def close(self) -> None:
        """Write what is queued, unless nobody reads it."""
        if self._closed:
            return
        self._closed = True
        stop = threading.Thread(target=self._stop, daemon=True)
        stop.start()
        stop.join(STOP_SECONDS)
        super().close()

    def _stop(self) -> None:
        with contextlib.suppress(queue.Full):
            self._listener.stop()

    def _write(self, line: str) -> None:
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


def start_logging(settings: Settings, stream: TextIO | None) -> LogQueue:
    """Send every record of this process to a stream; close what is returned when it ends."""
    terminal = stream is not None and not stream.closed and stream.isatty()
    text = settings.log_format == "text" or (settings.log_format == "auto" and terminal)
    handler = LogQueue(stream, TextFormatter() if text else JsonFormatter())
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler], force=True)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    return handler
