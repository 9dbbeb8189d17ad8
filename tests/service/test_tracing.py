"""One span for each request and one for each of its stages, over both transports."""

import httpx
import pytest
from grpc import aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_service.errors import DetectorFailed, report
from edgegrasp_service.observability import Call, Tracer

pytest.importorskip("opentelemetry.sdk", reason="the extra `otel` is not installed")

from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import (
    InMemorySpanExporter,
)

TRACE = "0af7651916cd43dd8448eb211c80319c"
CALLER = "b7ad6b7169203331"
HEADERS = {"traceparent": f"00-{TRACE}-{CALLER}-01", "x-request-id": "mine"}


@pytest.fixture
def exporter() -> InMemorySpanExporter:
    return InMemorySpanExporter()


@pytest.fixture
def tracer(exporter: InMemorySpanExporter) -> Tracer:
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    return Tracer(provider)


async def test_a_span_for_each_stage(serve, exporter, tracer, transport: str, cloud) -> None:
    running = await serve()
    if transport == "rest":
        async with httpx.AsyncClient(base_url=running.server.http_url) as http:
            body = {"points": cloud.tolist()}
            answer = await http.post("/v1/grasps", json=body, headers=HEADERS)
        assert answer.status_code == 200
    else:
        async with aio.insecure_channel(running.server.grpc_address) as channel:
            request = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            await stub.DetectGrasps(request, metadata=tuple(HEADERS.items()))
    await running.until(lambda: len(running.calls) == 1)
    tracer.trace_call(running.calls[0])
    spans = {span.name: span for span in exporter.get_finished_spans()}
    root = spans.pop("DetectGrasps")
    assert {"admission", "decode", "prepare", "finish"} <= set(spans)
    assert f"{root.context.trace_id:032x}" == TRACE
    assert f"{root.parent.span_id:016x}" == CALLER
    assert root.attributes["edgegrasp.request_id"] == "mine"
    assert root.attributes["edgegrasp.model"] == "dummy"
    assert root.attributes["edgegrasp.count.points"] == 500
    assert root.attributes["edgegrasp.code"] == "OK"
    for stage in spans.values():
        assert stage.parent.span_id == root.context.span_id
        assert root.start_time - 10_000_000 <= stage.start_time <= stage.end_time
        assert stage.end_time <= root.end_time + 10_000_000


def test_a_fault_marks_the_span(exporter, tracer: Tracer) -> None:
    problem = report(DetectorFailed("why"))
    call = Call("grpc", "DetectGrasps", problem=problem, traceparent="nonsense")
    call.end_stage("admission")
    tracer.trace_call(call)
    tracer.trace_call(Call("http", "Live"))  # has none
    root = exporter.get_finished_spans()[-1]
    assert (root.name, root.status.description) == ("DetectGrasps", "detector-failed")
    assert root.parent is None
