"""Request state, logs and metrics."""

import asyncio
import contextlib
import ipaddress
import json
import logging
import logging.handlers
import os
import queue
import re
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache, partial
from typing import Any, TextIO

import prometheus_client as prometheus

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import Problem
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.process import Facts, Transport

REQUEST_ID_HEADER = "x-request-id"  # of HTTP requests and answers, and in gRPC metadata of both

_USABLE_ID = re.compile(r"[\w.:+/=@-]{1,128}", re.ASCII)


@dataclass(eq=False)
class Call:
    """One request, or one stream of them."""

    transport: Transport
    method: str  # the gRPC method's name, for either transport
    request_id: str = ""  # the caller's own if usable, else a new one
    peer: str = ""  # address without port
    token: str = ""  # name of the token it came with
    client: str = ""  # whose share of the server it uses: the token's name or the network
    is_admin: bool = False
    in_stream: bool = False  # one request of a stream
    start: float = field(default_factory=time.monotonic)  # the same clock as the event loop's
    deadline: float = float("inf")
    timeout: asyncio.Timeout | None = None  # ends it at its deadline; set once it is admitted
    refusal: EdgeGraspError | None = None  # why it was ended before its deadline
    held_bytes: int = 0
    at_work: bool = False  # whether a worker has it
    bytes_in: int = 0
    bytes_out: int = 0
    code: str = ""  # gRPC code or HTTP status that it ended with
    problem: Problem | None = None
    facts: Facts = field(default_factory=Facts)
    stages: dict[str, float] = field(default_factory=dict)  # seconds of each, in order
    seconds: float = 0.0  # from its start to its end

    def __post_init__(self) -> None:
        if not _USABLE_ID.fullmatch(self.request_id):
            self.request_id = uuid.uuid4().hex
        self.client = self.token or network_of(self.peer)

    def end_stage(self, name: str) -> None:
        """Record the end of a stage, which began when the previous one ended."""
        self.stages[name] = time.monotonic() - self.start - sum(self.stages.values())

    def refuse(self, reason: EdgeGraspError) -> None:
        """End it with an error, at any stage."""
        self.refusal = reason
        if self.timeout is not None and not self.timeout.expired():
            self.timeout.reschedule(asyncio.get_running_loop().time())


@lru_cache(1024)
def network_of(address: str) -> str:
    """The address; for IPv6 its /64 network, since one machine may use all of it."""
    try:
        found = ipaddress.IPv6Address(address)
    except ValueError:
        return address
    return str(found.ipv4_mapped or ipaddress.ip_network((int(found) >> 64 << 64, 64)))


CALL: ContextVar[Call | None] = ContextVar("call", default=None)  # of the running task, for logs


# Logs: JSON lines, written by a thread so that logging never delays a request

MAX_WAITING_LINES = 4096  # queued records; further ones are dropped
STOP_SECONDS = 1.0
UNTIMED_METHODS = ("DetectGraspsStream", "HealthWatch", "Reflection")  # of any duration
PROBE_METHODS = ("Live", "Ready", "HealthCheck", "Metrics")  # called every few seconds; not logged
LOGGED = ("request_id", "transport", "method", "code", "peer", "token", "bytes_in", "bytes_out")

requests = logging.getLogger("edgegrasp_service.requests")


def log_call(call: Call) -> None:
    """Write one line about a call that has ended, and another about a fault of the server."""
    if call.facts.traceback:
        fault = {"traceback": call.facts.traceback}
        requests.error("%s failed with %s", call.method, call.facts.options, extra=fault)
    level = logging.DEBUG if call.method in PROBE_METHODS else logging.INFO
    if call.problem is not None and call.problem.status >= 500:
        level = logging.WARNING
    if not requests.isEnabledFor(level):
        return
    facts, problem = call.facts, call.problem
    fields = {name: getattr(call, name) for name in LOGGED} | {
        "error": problem and problem.kind,
        "detail": problem and problem.detail,
        "seconds": round(call.seconds, 6),
        "model": facts.model,
        "points": facts.points,
        "voxels": facts.counts.get("voxels"),
        "grasps": facts.grasps,
        "milliseconds": {name: round(took * 1e3, 1) for name, took in call.stages.items()},
    }
    known = {name: value for name, value in fields.items() if value}
    requests.log(level, "request", extra={"fields": known})


class JsonFormatter(logging.Formatter):
    """One JSON object per line, with the record's message and `fields`."""

    def format(self, record: logging.LogRecord) -> str:
        """A record as one line of JSON."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= getattr(record, "fields", {})
        if traceback := getattr(record, "traceback", ""):  # of an error in a worker
            line["exception"] = traceback
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class LogQueue(logging.handlers.QueueHandler):
    """Passes lines to a writer thread; a failing stream does not stop the server."""

    def __init__(self, stream: TextIO | None) -> None:
        self._lines: queue.Queue[str | None] = queue.Queue(MAX_WAITING_LINES)
        super().__init__(self._lines)
        self.setFormatter(JsonFormatter())
        self.dropped = 0  # lines lost as the disk is full, or the stream closed or not read
        self._stream = stream
        self._writer = threading.Thread(target=self._write, daemon=True)
        self._writer.start()

    def prepare(self, record: logging.LogRecord) -> str:
        """Format a record in the task that logs it, which has the request id."""
        call = CALL.get()
        if call is not None and not hasattr(record, "fields"):
            record.fields = {"request_id": call.request_id}
        return self.format(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Count a line that cannot be formatted or queued."""
        self.dropped += 1

    def close(self) -> None:
        """Write the queued lines, unless the stream is stuck."""
        with contextlib.suppress(queue.Full):
            self._lines.put(None, timeout=STOP_SECONDS)
            self._writer.join(STOP_SECONDS)
        super().close()

    def _write(self) -> None:
        start = ""
        for line in iter(self._lines.get, None):
            written = write_line(self._stream, start + line)
            start = "" if written else "\n"  # ends a line that was written in part
            self.dropped += not written


def write_line(stream: TextIO | None, line: str) -> bool:
    """Write a line unbuffered: a failing stream's buffer would fail again on closing.

    Returns whether it was written; no stream: this process was started with it closed.
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
    """Send every record of this process to a stream; close the returned queue at the end."""
    handler = LogQueue(stream)
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler], force=True)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    return handler


# Metrics: every label has few values, whatever callers send

SECONDS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
GRASPS = (0, 1, 2, 4, 8, 16, 32, 64, 128, 256)
MODEL_LABELS = ("name", "digest", "architecture", "default", "device")
CANDIDATES = (0, 10, 100, 300, 1000, 2000, 4000, 8000, 16000)


class Metrics:
    """Counts, gauges and histograms of one server."""

    def __init__(self, models: Callable[[], Sequence[dict[str, Any]]]) -> None:
        self._models = models
        self.registry = prometheus.CollectorRegistry()
        prometheus.ProcessCollector(registry=self.registry)
        counter = partial(prometheus.Counter, namespace="edgegrasp", registry=self.registry)
        histogram = partial(prometheus.Histogram, namespace="edgegrasp", registry=self.registry)
        self._gauge = partial(prometheus.Gauge, namespace="edgegrasp", registry=self.registry)
        calls = ("transport", "method")
        self._requests = counter("requests", "requests answered", (*calls, "code"))
        seconds = partial(histogram, buckets=SECONDS)
        self._seconds = seconds("request_seconds", "from headers to answer", calls)
        self._stages = seconds("stage_seconds", "stages of a request", ("stage",))
        self._candidates = histogram("candidates", "candidates of a detection", buckets=CANDIDATES)
        self._grasps = histogram("grasps_returned", "grasps of a detection", buckets=GRASPS)
        self._results = counter("stream_results", "results sent on streams", ("code",))
        self.workers_replaced = counter("workers_replaced", "worker processes that died")
        self._model_info = self._gauge("model_info", "loaded weights", MODEL_LABELS)
        self.reloads = counter("reloads", "reloads of the weights", ("outcome",))
        for outcome in ("succeeded", "failed"):  # start at 0: the first reload is an increase
            self.reloads.labels(outcome)

    def count_call(self, call: Call) -> None:
        """Count a call that has ended; a request within a stream counts as a result."""
        if call.in_stream:
            self._results.labels(call.code).inc()
        else:
            self._requests.labels(call.transport, call.method, call.code).inc()
            if call.method not in UNTIMED_METHODS:
                self._seconds.labels(call.transport, call.method).observe(call.seconds)
        for stage, seconds in call.stages.items():
            self._stages.labels(stage).observe(seconds)
        if call.problem is None and call.method.startswith("DetectGrasps") and call.facts.model:
            self._candidates.observe(call.facts.counts.get("candidates", 0))
            self._grasps.observe(call.facts.grasps)

    def add_gauge(self, name: str, meaning: str, value: Callable[[], float]) -> None:
        """Add a gauge whose value is computed when metrics are read."""
        self._gauge(name, meaning).set_function(value)

    def page(self) -> bytes:
        """All metrics, as text in Prometheus' format."""
        self._model_info.clear()
        for facts in self._models():
            shown = facts | {"default": str(facts.get("default", False)).lower()}
            self._model_info.labels(*(str(shown.get(name, "")) for name in MODEL_LABELS)).set(1.0)
        return prometheus.generate_latest(self.registry)
