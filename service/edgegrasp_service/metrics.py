"""What Prometheus reads at /metrics. Every label has few values, whatever callers send."""

import contextlib
import http
from collections import deque
from collections.abc import Callable, Iterator, Sequence

import grpc
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from edgegrasp_model.results import Detection, Scoring
from edgegrasp_service.call import Call
from edgegrasp_service.core import ModelInfo
from edgegrasp_service.errors import ErrorReport, NotReady
from edgegrasp_service.observer import STAGES, Observer

OTHER = "other"
SECONDS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
FEW = (0, 1, 2, 4, 8, 16, 32, 64, 128, 256)
MANY = (0, 10, 100, 300, 1000, 2000, 4000, 8000, 16000)

_CODES = {code.name for code in grpc.StatusCode} | {str(status.value) for status in http.HTTPStatus}
_CODES |= {"499"}  # the caller went away


class Metrics(Observer):
    """Counts, gauges and histograms of one server."""

    def __init__(self, methods: Sequence[str]) -> None:
        """Start at zero.

        Args:
            methods: Values of the label `method`; any other counts as "other".
        """
        self.registry = CollectorRegistry()
        self._methods = frozenset(methods)
        ProcessCollector(registry=self.registry)
        # Counted once a request is answered, or metrics are read: it takes tens of microseconds.
        self._noted: deque[tuple[Callable[[float], None], float]] = deque()
        calls = ("transport", "method")
        self._requests = self._counter("requests", "requests answered", (*calls, "code"))
        self._seconds = self._histogram("request_seconds", "from headers to answer", SECONDS, calls)
        self._in_flight = self._gauge("requests_in_flight", "requests not yet answered")
        self._stages = self._histogram("stage_seconds", "stages of a request", SECONDS, ("stage",))
        self._stage = {stage: self._stages.labels(stage) for stage in STAGES}
        self._active = self._gauge("requests_active", "requests that are worked on")
        self._waiting = self._gauge("queue_depth", "requests that wait to be worked on")
        self._batch_requests = self._histogram("batch_requests", "requests of a forward pass", FEW)
        self._batch_balls = self._histogram("batch_balls", "balls of a forward pass", FEW)
        self._candidates = self._histogram("candidates", "candidates of a detection", MANY)
        self._grasps = self._histogram("grasps_returned", "grasps of a detection", FEW)
        self._results = self._counter("stream_results", "results sent on streams", ("code",))
        self._workers = self._counter("workers_replaced", "network threads that died")
        self._reloads = self._counter("reloads", "weights loaded anew", ("outcome",))

    def request(self, transport: str, method: str, code: str, seconds: float | None) -> None:
        """Count a request that is answered; a stream has no `seconds`."""
        self._take_noted()
        method = method if method in self._methods else OTHER
        self._requests.labels(transport, method, code if code in _CODES else OTHER).inc()
        if seconds is not None:
            self._seconds.labels(transport, method).observe(seconds)

    def in_flight(self, change: int) -> None:
        """Count a request that came in, +1, or is answered, -1."""
        self._noted.append((self._in_flight.inc, change))

    def reloaded(self, succeeded: bool) -> None:
        """Count a reload."""
        self._reloads.labels("succeeded" if succeeded else "failed").inc()

    def stage(self, call: Call, name: str, seconds: float) -> None:
        """Take the duration of a stage."""
        stage = self._stage.get(name) or self._stages.labels(OTHER)
        self._noted.append((stage.observe, seconds))

    def places(self, active: int, waiting: int) -> None:
        """Take the numbers of requests in work and in the queue."""
        self._noted += (self._active.set, active), (self._waiting.set, waiting)

    def batched(self, requests: int, balls: int, points: int) -> None:
        """Take the size of a batch."""
        self._noted += (self._batch_requests.observe, requests), (self._batch_balls.observe, balls)

    def answered(self, call: Call, answer: Detection | Scoring) -> None:
        """Take the size of an answer."""
        if isinstance(answer, Detection):
            self._candidates.observe(answer.counts.get("candidates", 0))
            self._grasps.observe(len(answer.grasps))

    def worker_replaced(self, reason: str) -> None:
        """Count a network thread that died."""
        self._workers.inc()

    def finished(self, call: Call, problem: ErrorReport | None) -> None:
        """Count a result of a stream; requests are counted at the transports' edge."""
        self._take_noted()
        if call.method.endswith("Stream"):
            self._results.labels("OK" if problem is None else problem.code.name).inc()

    def watch(self, name: str, meaning: str, value: Callable[[], float]) -> None:
        """Show a number that is asked for when metrics are read."""
        self._gauge(name, meaning).set_function(value)

    def describe_models(self, models: Callable[[], Sequence[ModelInfo]]) -> None:
        """Show the loaded weights, whichever they are when metrics are read."""
        self.registry.register(_ModelCollector(models))

    def page(self, accept: str) -> tuple[bytes, str]:
        """All metrics as text, and its content type.

        Args:
            accept: The header of that name; OpenMetrics to whom asks for it.
        """
        self._take_noted()
        encoder, content_type = choose_encoder(accept)
        return encoder(self.registry), content_type

    def _take_noted(self) -> None:
        """Count what was noted while requests were on their way."""
        with contextlib.suppress(IndexError):
            while True:
                count, value = self._noted.popleft()
                count(value)

    def _counter(self, name: str, meaning: str, labels: Sequence[str] = ()) -> Counter:
        return Counter(f"edgegrasp_{name}", meaning, labels, registry=self.registry)

    def _gauge(self, name: str, meaning: str) -> Gauge:
        return Gauge(f"edgegrasp_{name}", meaning, registry=self.registry)

    def _histogram(
        self, name: str, meaning: str, buckets: Sequence[float], labels: Sequence[str] = ()
    ) -> Histogram:
        return Histogram(
            f"edgegrasp_{name}", meaning, labels, buckets=buckets, registry=self.registry
        )


class _ModelCollector(Collector):
    def __init__(self, models: Callable[[], Sequence[ModelInfo]]) -> None:
        self._models = models

    def collect(self) -> Iterator[GaugeMetricFamily]:
        labels = ("name", "digest", "architecture", "default", "device")
        family = GaugeMetricFamily("edgegrasp_model_info", "loaded weights", labels=labels)
        models: Sequence[ModelInfo] = ()
        with contextlib.suppress(NotReady):  # still loading, or stopping
            models = self._models()
        for model in models:
            default = str(model.default).lower()
            facts = (model.name, model.digest, model.architecture, default, model.device)
            family.add_metric(facts, 1.0)
        yield family
