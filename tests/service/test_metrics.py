"""What /metrics shows, and that no caller can make it grow."""

import asyncio
import json
import re
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from grpc import aio
from prometheus_client.parser import text_string_to_metric_families

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import AsyncGraspClient, StreamRequest

DASHBOARD = Path(__file__).parents[2] / "docker" / "grafana" / "edgegrasp.json"


def samples(page: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(page)
        for sample in family.samples
    }


async def read(server: Any, **headers: str) -> dict[Any, float]:
    async with httpx.AsyncClient(base_url=server.http_url) as http:
        answer = await http.get("/metrics", headers=headers)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    return samples(answer.text)


def requests_total(found: dict[Any, float]) -> dict[tuple[str, str, str], float]:
    return {
        tuple(dict(labels)[name] for name in ("transport", "method", "code")): value
        for (name, labels), value in found.items()
        if name == "edgegrasp_requests_total"
    }


async def test_requests_are_counted_on_both_transports(serve, cloud: np.ndarray) -> None:
    server = (await serve()).server
    for address in (server.grpc_address, server.http_url):
        async with AsyncGraspClient(address) as client:
            await client.detect(cloud)
            await client.score(cloud, edges=np.array([[0, 1]]))
            await client.models()
            with pytest.raises(Exception, match="points"):
                await client.detect(cloud[:0])
    found = await read(server)
    total = requests_total(found)
    for transport, fine, bad in (("grpc", "OK", "INVALID_ARGUMENT"), ("http", "200", "400")):
        for method in ("DetectGrasps", "ScoreGrasps", "ListModels"):
            assert total[transport, method, fine] == 1.0
        assert total[transport, "DetectGrasps", bad] == 1.0
        timed = (
            "edgegrasp_request_seconds_count",
            (("method", "DetectGrasps"), ("transport", transport)),
        )
        assert found[timed] == 2.0
    for stage in ("decode", "prepare", "finish"):
        assert found["edgegrasp_stage_seconds_count", (("stage", stage),)] >= 2.0
    assert found["edgegrasp_grasps_returned_sum", ()] == 20.0
    assert found["edgegrasp_queue_depth", ()] == 0.0
    assert found["edgegrasp_requests_active", ()] == 0.0
    assert found["edgegrasp_ready", ()] == 1.0
    info = [dict(labels) for name, labels in found if name == "edgegrasp_model_info"]
    assert [(one["name"], one["default"], "digest" in one, one["device"]) for one in info] == [
        ("dummy", "true", True, "cpu")
    ]


async def test_streams_are_counted_by_result(serve, cloud: np.ndarray) -> None:
    server = (await serve()).server
    async with AsyncGraspClient(server.grpc_address) as client:
        requests = [StreamRequest(points) for points in (cloud, cloud[:0], cloud)]
        answers = [answer async for answer in client.detect_stream(requests)]
    assert len(answers) == 3
    found = await read(server)
    assert found["edgegrasp_stream_results_total", (("code", "OK"),)] == 2.0
    assert found["edgegrasp_stream_results_total", (("code", "INVALID_ARGUMENT"),)] == 1.0
    assert requests_total(found)["grpc", "DetectGraspsStream", "OK"] == 1.0


async def test_hostile_callers_add_no_labels(serve, cloud: np.ndarray) -> None:
    server = (await serve()).server
    before = set(await read(server))
    async with httpx.AsyncClient(base_url=server.http_url) as http:
        for number in range(5):
            await http.get(f"/v1/{number}/none")
            await http.get("/v1/grasps")
            await http.post(
                "/v1/grasps",
                json={"points": cloud.tolist(), "options": {"model": f"evil-{number}\n{{}}"}},
            )
    async with aio.insecure_channel(server.grpc_address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        for number in range(5):
            request = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
            request.options.model = f"evil-{number}"
            unknown = channel.unary_unary(f"/evil.Service{number}/Method", bytes, bytes)
            await asyncio.gather(unknown(b""), stub.DetectGrasps(request), return_exceptions=True)
    after = await read(server)
    added = {
        tuple(dict(labels)[name] for name in ("transport", "method", "code"))
        for name, labels in set(after) - before
        if name == "edgegrasp_requests_total"
    }
    assert added == {
        ("http", "Metrics", "200"),
        ("http", "other", "404"),
        ("http", "DetectGrasps", "405"),
        ("http", "DetectGrasps", "404"),
        ("grpc", "other", "UNIMPLEMENTED"),
        ("grpc", "DetectGrasps", "NOT_FOUND"),
    }
    assert not any("evil" in str(key) for key in after)


async def test_the_dashboard_names_metrics_that_exist(serve, cloud: np.ndarray) -> None:
    server = (await serve(admin_tokens=["admin-token-0123456789"])).server
    async with AsyncGraspClient(server.http_url) as client:
        await client.detect(cloud)
    server.metrics.watch("log_lines_dropped", "as `edgegrasp serve` adds it", lambda: 0)
    page = server.metrics.page("")[0].decode()
    kinds = [line.split()[2:] for line in page.splitlines() if line.startswith("# TYPE ")]
    exist = {name: "histogram" if kind == "histogram" else "" for name, kind in kinds}
    dashboard = json.loads(DASHBOARD.read_text())
    queries = " ".join(
        target["expr"] for panel in dashboard["panels"] for target in panel["targets"]
    )
    named = {
        name if name in exist else re.sub("_(bucket|sum|count)$", "", name)
        for name in re.findall(r"\b(?:edgegrasp|process)_\w+", queries)
    }
    assert named <= set(exist), named - set(exist)
    ours = {name for name in exist if name.startswith("edgegrasp_")}
    assert {name for name in ours if not name.endswith("_created")} <= named, "it has no panel"
