"""What Prometheus reads at /metrics. Every label has few values, whatever callers send."""

import http
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from edgegrasp_service.call import Call
from edgegrasp_service.errors import STATUS

OTHER = "other"
SECONDS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
FEW = (0, 1, 2, 4, 8, 16, 32, 64, 128, 256)
MANY = (0, 10, 100, 300, 1000, 2000, 4000, 8000, 16000)

_CODES = {"OK", "UNKNOWN", "499"} | {code for code, _ in STATUS.values()}
_CODES |= {str(status.value) for status in http.HTTPStatus}


class Metrics:
    """Counts, gauges and histograms of one server.

    Args:
        methods: Values of the label `method`; any other counts as "other".
    """

    def __init__(self, methods: Sequence[str]) -> None:
        self.registry = CollectorRegistry()
        self._methods = frozenset(methods)
        ProcessCollector(registry=self.registry)
        calls = ("transport", "method")
        self._requests = self._counter("requests", "requests answered", (*calls, "code"))
        self._seconds = self._histogram("request_seconds", "from headers to answer", SECONDS, calls)
        self._stages = self._histogram("stage_seconds", "stages of a request", SECONDS, ("stage",))
        self._candidates = self._histogram("candidates", "candidates of a detection", MANY)
        self._grasps = self._histogram("grasps_returned", "grasps of a detection", FEW)
        self._results = self._counter("stream_results", "results sent on streams", ("code",))
        self._workers = self._counter("workers_replaced", "worker processes that died")
        self._reloads = self._counter("reloads", "weights loaded anew", ("outcome",))

    def count_call(self, call: Call) -> None:
        """Count a call that has ended; a request of a stream as a result of it."""
        code = call.code if call.code in _CODES else OTHER
        if call.in_stream:
            self._results.labels(code).inc()
        else:
            method = call.method if call.method in self._methods else OTHER
            self._requests.labels(call.transport, method, code).inc()
            if not call.long:
                self._seconds.labels(call.transport, method).observe(call.seconds)
        for stage, seconds in call.stages.items():
            self._stages.labels(stage).observe(seconds)
        if call.problem is None and call.method.startswith("DetectGrasps") and call.facts.model:
            self._candidates.observe(call.facts.counts.get("candidates", 0))
            self._grasps.observe(call.facts.grasps)

    def reloaded(self, succeeded: bool) -> None:
        """Count a reload."""
        self._reloads.labels("succeeded" if succeeded else "failed").inc()

    def worker_replaced(self) -> None:
        """Count a worker that died."""
        self._workers.inc()

    def watch(self, name: str, meaning: str, value: Callable[[], float]) -> None:
        """Show a number that is asked for when metrics are read."""
        Gauge(f"edgegrasp_{name}", meaning, registry=self.registry).set_function(value)

    def describe_models(self, models: Callable[[], Sequence[dict[str, Any]]]) -> None:
        """Show the loaded weights, whichever they are when metrics are read."""
        self.registry.register(_ModelCollector(models))

    def page(self, accept: str) -> tuple[bytes, str]:
        """All metrics as text, and its content type.

        Args:
            accept: The header of that name; OpenMetrics to whom asks for it.
        """
        encoder, content_type = choose_encoder(accept)
        return encoder(self.registry), content_type

    def _counter(self, name: str, meaning: str, labels: Sequence[str] = ()) -> Counter:
        return Counter(f"edgegrasp_{name}", meaning, labels, registry=self.registry)

    def _histogram(
        self, name: str, meaning: str, buckets: Sequence[float], labels: Sequence[str] = ()
    ) -> Histogram:
        return Histogram(
            f"edgegrasp_{name}", meaning, labels, buckets=buckets, registry=self.registry
        )


class _ModelCollector(Collector):
    def __init__(self, models: Callable[[], Sequence[dict[str, Any]]]) -> None:
        self._models = models

    def collect(self) -> Iterator[GaugeMetricFamily]:
        labels = ("name", "digest", "architecture", "default", "device")
        family = GaugeMetricFamily("edgegrasp_model_info", "loaded weights", labels=labels)
        for model in self._models():
            default = str(model.get("default", False)).lower()
            facts = [str((model | {"default": default}).get(label, "")) for label in labels]
            family.add_metric(facts, 1.0)
        yield family
