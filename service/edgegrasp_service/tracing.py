"""OpenTelemetry traces: a span for each request, and one for each of its stages inside it."""

import time
from typing import Any

from edgegrasp_service.call import Call
from edgegrasp_service.errors import InvalidSettings

NANOSECONDS = 1_000_000_000


class Tracer:
    """Makes spans of calls; a caller's `traceparent` is the parent of its request's.

    Args:
        provider: An OpenTelemetry tracer provider.
    """

    def __init__(self, provider: Any) -> None:
        from opentelemetry import trace
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        self._trace = trace
        self._propagator = TraceContextTextMapPropagator()
        self._tracer = provider.get_tracer("edgegrasp_service")

    def trace_call(self, call: Call) -> None:
        """Make the spans of a call that has ended; of those only that had to do with grasps."""
        if "admission" not in call.stages:
            return
        start = time.time_ns() - int((time.monotonic() - call.start) * NANOSECONDS)
        attributes: dict[str, str | int] = {
            "edgegrasp.transport": call.transport,
            "edgegrasp.request_id": call.request_id,
            "edgegrasp.model": call.facts.model,
            "edgegrasp.code": "OK" if call.problem is None else call.problem.code,
        }
        for name, count in call.facts.counts.items():
            attributes[f"edgegrasp.count.{name}"] = count
        span = self._tracer.start_span(
            call.method,
            context=self._propagator.extract({"traceparent": call.traceparent}),
            kind=self._trace.SpanKind.SERVER,
            start_time=start,
            attributes=attributes,
        )
        if call.problem is not None and call.problem.status >= 500:
            span.set_status(self._trace.StatusCode.ERROR, call.problem.kind)
        inside = self._trace.set_span_in_context(span)
        begin = start
        for name, seconds in call.stages.items():
            end = begin + int(seconds * NANOSECONDS)
            self._tracer.start_span(name, context=inside, start_time=begin).end(end)
            begin = end
        span.end(start + int(call.seconds * NANOSECONDS))


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
