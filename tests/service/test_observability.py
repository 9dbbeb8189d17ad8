"""Logs name requests, on both transports, and hold up none when no one can write or read them."""

import asyncio
import contextlib
import json
import logging
import os
import re
from pathlib import Path
from typing import Any, TextIO
from unittest.mock import Mock

import grpc
import httpx
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from tests.programs import until

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import GraspClient, StreamRequest
from edgegrasp_service.observability import JsonFormatter, LogQueue

from .conftest import ADMIN, USER, WRONG


def told(server: Any, transport: str, headers: dict[str, str]) -> str:
    """The request id that comes back."""
    if transport == "rest":
        answer = httpx.get(f"{server.http_url}/v1/models", headers=headers).headers
        assert answer.get_list("x-request-id") == [answer["x-request-id"]]
        return answer["x-request-id"]
    with grpc.insecure_channel(server.grpc_address) as channel:
        models = grasp_pb2_grpc.GraspServiceStub(channel).ListModels
        _, call = models.with_call(grasp_pb2.ListModelsRequest(), metadata=tuple(headers.items()))
        return dict(call.trailing_metadata())["x-request-id"]


def test_request_ids_come_back(dummy_server, transport: str) -> None:
    for usable in ("robot-1/42", "a" * 128, "0af7651916cd43dd8448eb211c80319c"):
        assert told(dummy_server, transport, {"x-request-id": usable}) == usable
    bad = [{}, {"x-request-id": "two words"}, {"x-request-id": "a" * 129}]
    made = {told(dummy_server, transport, headers) for headers in bad}
    assert len(made) == 3
    assert all(len(request_id) == 32 and request_id.isalnum() for request_id in made)


async def test_errors_and_streams_carry_the_request_id(serve) -> None:
    running = await serve(max_body_bytes=1024)
    headers = {"x-request-id": "mine"}
    for path, status in (("/none", 404), ("/v1/grasps", 413)):
        answer = await running.http().post(path, content=bytes(9000), headers=headers)
        assert (answer.status_code, answer.headers["x-request-id"]) == (status, "mine")
    stub, metadata = running.stub(), tuple(headers.items())
    call = stub.DetectGrasps(grasp_pb2.DetectGraspsRequest(points=b"1"), metadata=metadata)
    assert await call.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert dict(await call.trailing_metadata())["x-request-id"] == "mine"
    stream = stub.DetectGraspsStream(metadata=metadata)  # before its first answer
    assert dict(await stream.initial_metadata())["x-request-id"] == "mine"
    stream.cancel()


async def test_json_lines_name_requests_and_no_secrets(serve, cloud, caplog) -> None:
    caplog.set_level(logging.DEBUG, logger="edgegrasp_service")
    running = await serve(tokens=[f"arm-1:{USER}"], admin_tokens=[ADMIN])
    for transport in ("rest", "grpc"):
        client = running.ours(transport, token=USER)
        await client.ready()
        await client.detect(cloud)
        for token in (ADMIN, WRONG):
            listing = running.ours(transport, token=token).models()
            await asyncio.gather(listing, return_exceptions=True)
    await running.until(lambda: len(running.calls) == 2)
    ours = [record for record in caplog.records if record.name.startswith("edgegrasp")]
    lines = [json.loads(JsonFormatter().format(record)) for record in ours]
    assert not any(word in str(lines) + caplog.text for word in (USER, ADMIN, WRONG))
    probes = [line["level"] for line in lines if line.get("method") in ("Ready", "HealthCheck")]
    assert probes == ["debug", "debug"]
    detected = [line for line in lines if line.get("method") == "DetectGrasps"]
    assert [f"{line['transport']} {line['code']}" for line in detected] == ["http 200", "grpc OK"]
    for line in detected:
        assert line["level"] == "info"
        assert line["time"].endswith("+00:00")
        assert line["seconds"] > 0.0
        assert len(line["request_id"]) == 32
        told = [line[name] for name in ("peer", "token", "model", "points", "grasps")]
        assert told == ["127.0.0.1", "arm-1", "dummy", 500, 10]
        assert line["bytes_in"] > 5000
        assert line["bytes_out"] > 500
        assert {"admission", "read", "wait", "prepare", "network"} <= set(line["milliseconds"])


def test_requests_outlive_a_log_that_nobody_reads(start_dummy, cloud: np.ndarray) -> None:
    """Standard error is a full pipe, which would block who writes to it."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    with contextlib.suppress(BlockingIOError):
        while os.write(write, bytes(4096)):
            pass
    os.set_blocking(write, True)
    with start_dummy("--log-level", "debug", stderr=write) as running:
        for address in (running.http_url, running.grpc_address):
            with GraspClient(address) as client:
                for _ in range(5):
                    assert len(client.detect(cloud).grasps) == 10
        assert running.stop() == 0
    os.close(read)
    os.close(write)


@pytest.mark.parametrize("name", ["closed", "none", "full disk", "pipe with no end"])
def test_lines_not_written_are_counted(name: str) -> None:
    with contextlib.ExitStack() as ends:
        stream: TextIO | None = {"closed": Mock(fileno=Mock(side_effect=OSError))}.get(name)
        if name == "full disk":
            stream = ends.enter_context(Path("/dev/full").open("w"))
        elif name == "pipe with no end":
            read, write = os.pipe()
            os.close(read)
            stream = ends.enter_context(os.fdopen(write, "w"))
        writer = LogQueue(stream)
        for _ in range(3):
            writer.handle(logging.makeLogRecord({"msg": "lost"}))
        writer.handle(logging.makeLogRecord({"msg": "%d", "args": ("no number",)}))
        writer.close()
    assert writer.dropped == 4


def test_a_line_after_a_lost_one_is_whole() -> None:
    """The pipe takes only a part of the first, as a disk does that is nearly full."""
    ends = os.pipe()
    with os.fdopen(ends[0]) as log, os.fdopen(ends[1], "w") as stream:
        os.set_blocking(stream.fileno(), False)
        writer = LogQueue(stream)
        writer.handle(logging.makeLogRecord({"msg": "lost" * 2**18}))
        until(lambda: writer.dropped)
        part = os.read(log.fileno(), 2**20).decode()
        writer.handle(logging.makeLogRecord({"msg": "whole"}))
        writer.close()
        stream.close()
        assert json.loads((part + log.read()).splitlines()[-1])["message"] == "whole"


async def read(running: Any) -> dict[Any, float]:
    """The samples by their name and labels."""
    answer = await running.http().get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def requests_total(found: dict[Any, float]) -> dict[tuple[str, str, str], float]:
    return {
        tuple(dict(labels)[name] for name in ("transport", "method", "code")): value
        for (name, labels), value in found.items()
        if name == "edgegrasp_requests_total"
    }


async def test_requests_and_results_of_streams_are_counted(running, cloud: np.ndarray) -> None:
    for transport in ("grpc", "rest"):
        client = running.ours(transport)
        await client.detect(cloud)
        await client.score(cloud, edges=np.array([[0, 1]]))
        await client.models()
        with pytest.raises(Exception, match="points"):
            await client.detect(cloud[:0])
    found = await read(running)
    total = requests_total(found)
    for transport, fine, bad in (("grpc", "OK", "INVALID_ARGUMENT"), ("http", "200", "400")):
        for method in ("DetectGrasps", "ScoreGrasps", "ListModels"):
            assert total[transport, method, fine] == 1.0
        assert total[transport, "DetectGrasps", bad] == 1.0
        labels = ("method", "DetectGrasps"), ("transport", transport)
        assert found["edgegrasp_request_seconds_count", labels] == 2.0
    for stage in ("decode", "prepare", "finish"):
        assert found["edgegrasp_stage_seconds_count", (("stage", stage),)] >= 2.0
    assert found["edgegrasp_grasps_returned_sum", ()] == 20.0
    assert found["edgegrasp_queue_depth", ()] == 0.0
    assert found["edgegrasp_requests_active", ()] == 0.0
    assert found["edgegrasp_ready", ()] == 1.0
    (info,) = (dict(labels) for name, labels in found if name == "edgegrasp_model_info")
    assert info.keys() >= {"name", "digest"}
    assert (info["name"], info["default"], info["device"]) == ("dummy", "true", "cpu")
    requests = [StreamRequest(points) for points in (cloud, cloud[:0], cloud)]
    assert len([answer async for answer in running.ours("grpc").detect_stream(requests)]) == 3
    found = await read(running)
    assert found["edgegrasp_stream_results_total", (("code", "OK"),)] == 2.0
    assert found["edgegrasp_stream_results_total", (("code", "INVALID_ARGUMENT"),)] == 1.0
    assert requests_total(found)["grpc", "DetectGraspsStream", "OK"] == 1.0


async def test_hostile_callers_add_no_labels(running, cloud: np.ndarray) -> None:
    before, http, client = set(await read(running)), running.http(), running.connect("grpc")
    for number in range(5):
        evil = {"model": f"evil-{number}\n{{}}"}
        await http.get(f"/v1/{number}/none")
        await http.get("/v1/grasps")
        await http.post("/v1/grasps", json={"points": cloud.tolist(), "options": evil})
        assert not (await client.detect(cloud, **evil)).fine
        unknown = client.channel.unary_unary(f"/evil.Service{number}/Method", bytes, bytes)
        assert await unknown(b"").code() is grpc.StatusCode.UNIMPLEMENTED
    after = await read(running)
    assert set(requests_total({key: after[key] for key in set(after) - before})) == {
        ("http", "Metrics", "200"),
        ("http", "other", "404"),
        ("http", "DetectGrasps", "405"),
        ("http", "DetectGrasps", "404"),
        ("grpc", "other", "UNIMPLEMENTED"),
        ("grpc", "DetectGrasps", "NOT_FOUND"),
    }
    assert not any("evil" in str(key) for key in after)


async def test_the_dashboard_names_metrics_that_exist(serve, cloud: np.ndarray) -> None:
    running = await serve(admin_tokens=[ADMIN])
    await running.ours("rest").detect(cloud)
    server = running.server
    server.metrics.add_gauge("log_lines_dropped", "as `edgegrasp serve` adds it", lambda: 0)
    page = server.metrics.page().decode()
    kinds = [line.split()[2:] for line in page.splitlines() if line.startswith("# TYPE ")]
    exist = {name: "histogram" if kind == "histogram" else "" for name, kind in kinds}
    file = Path(__file__).parents[2] / "docker" / "grafana" / "edgegrasp.json"
    dashboard = json.loads(file.read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    named = {
        name if name in exist else re.sub("_(bucket|sum|count)$", "", name)
        for name in re.findall(r"\b(?:edgegrasp|process)_\w+", " ".join(queries))
    }
    assert named <= set(exist), named - set(exist)
    ours = {name for name in exist if name.startswith("edgegrasp_")}
    assert {name for name in ours if not name.endswith("_created")} <= named, "it has no panel"
