"""OpenTelemetry traces: a span for each request, and one for each of its stages inside it."""

import threading
import time
from typing import Any
from weakref import WeakKeyDictionary

from edgegrasp_model.results import Detection, Scoring
from edgegrasp_service.call import Call
from edgegrasp_service.errors import ErrorReport, InvalidSettings
from edgegrasp_service.observer import Observer
from edgegrasp_service.request_id import TRACEPARENT

NANOSECONDS = 1_000_000_000


class Tracer(Observer):
    """Makes spans of what it observes; a caller's `traceparent` is the parent of its request's.

    Args:
        provider: An OpenTelemetry tracer provider.
    """

    def __init__(self, provider: Any) -> None:
        from opentelemetry import trace
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        self._trace = trace
        self._propagator = TraceContextTextMapPropagator()
        self._tracer = provider.get_tracer("edgegrasp_service")
        self._spans: WeakKeyDictionary[Call, Any] = WeakKeyDictionary()
        self._lock = threading.Lock()

    def started(self, call: Call) -> None:
        """Begin the span of a request."""
        parent = self._propagator.extract({"traceparent": TRACEPARENT.get()})
        span = self._tracer.start_span(
            call.method,
            context=parent,
            kind=self._trace.SpanKind.SERVER,
            start_time=time.time_ns() - int(call.seconds * NANOSECONDS),
            attributes={
                "edgegrasp.transport": call.transport,
                "edgegrasp.request_id": call.request_id,
            },
        )
        with self._lock:
            self._spans[call] = span

    def stage(self, call: Call, name: str, seconds: float) -> None:
        """Add the span of a stage that ended now."""
        if (parent := self._span(call)) is None:
            return
        end = time.time_ns()
        context = self._trace.set_span_in_context(parent)
        start = end - int(seconds * NANOSECONDS)
        self._tracer.start_span(name, context=context, start_time=start).end(end)

    def answered(self, call: Call, answer: Detection | Scoring) -> None:
        """Note the weights and the counts."""
        if (span := self._span(call)) is not None:
            span.set_attribute("edgegrasp.model", answer.model)
            for name, count in answer.counts.items():
                span.set_attribute(f"edgegrasp.count.{name}", int(count))

    def finished(self, call: Call, problem: ErrorReport | None) -> None:
        """End the span of a request."""
        if (span := self._span(call)) is None:
            return
        span.set_attribute("edgegrasp.code", "OK" if problem is None else problem.code.name)
        if problem is not None and problem.status >= 500:
            span.set_status(self._trace.StatusCode.ERROR, problem.kind)
        span.end()
        with self._lock:
            self._spans.pop(call, None)

    def _span(self, call: Call) -> Any:
        with self._lock:
            return self._spans.get(call)


def otlp_provider(endpoint: str) -> Any:
    """A tracer provider that posts spans to an OTLP/HTTP endpoint; shut it down in the end.

    Raises:
        InvalidSettings: The OpenTelemetry packages are not installed.
    """
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import SERVICE_NAME, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ModuleNotFoundError as error:
        raise InvalidSettings(
            f"otlp_endpoint: got {endpoint!r}. {error}: pip install 'edgegrasp[otel]'."
        ) from None
    provider = TracerProvider(resource=Resource.create({SERVICE_NAME: "edgegrasp"}))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=endpoint, timeout=5)))
    return provider
