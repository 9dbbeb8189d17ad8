"""Logs name requests, on both transports, and hold up none when no one can write or read them."""

import asyncio
import io
import json
import logging
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, TextIO

import grpc
import httpx
import numpy as np
import pytest
from grpc import aio
from hypothesis import given
from hypothesis import strategies as st

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import AsyncGraspClient
from edgegrasp_service.observability import CALL, Call, JsonFormatter, LogQueue, TextFormatter

TOKEN = "a-token-of-enough-letters"


async def told(server: Any, transport: str, request_id: str, cloud: np.ndarray) -> str:
    """The request id that comes back."""
    if transport == "rest":
        async with httpx.AsyncClient(base_url=server.http_url) as http:
            headers = [(b"x-request-id", request_id.encode())] if request_id else []
            answer = await http.get("/v1/models", headers=headers)
        assert answer.headers.get_list("x-request-id") == [answer.headers["x-request-id"]]
        return answer.headers["x-request-id"]
    async with aio.insecure_channel(server.grpc_address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        metadata = (("x-request-id", request_id),) if request_id else ()
        call = stub.DetectGrasps(
            grasp_pb2.DetectGraspsRequest(points=cloud.tobytes()), metadata=metadata
        )
        await call
        return dict(await call.trailing_metadata())["x-request-id"]


async def test_request_ids_come_back(dummy_server, transport: str, cloud: np.ndarray) -> None:
    server = dummy_server
    for usable in ("robot-1/42", "a" * 128, "0af7651916cd43dd8448eb211c80319c"):
        assert await told(server, transport, usable, cloud) == usable
    made = {await told(server, transport, bad, cloud) for bad in ("", "two words", "a" * 129)}
    assert len(made) == 3
    assert all(len(request_id) == 32 and request_id.isalnum() for request_id in made)


@pytest.mark.parametrize("path", ["/none", "/v1/grasps"])
async def test_errors_carry_the_request_id(serve, path: str) -> None:
    server = (await serve(max_body_bytes=1024)).server
    async with httpx.AsyncClient(base_url=server.http_url) as http:
        answer = await http.post(path, content=bytes(9000), headers={"x-request-id": "mine"})
    assert answer.status_code in (404, 413)
    assert answer.headers["x-request-id"] == "mine"
    async with aio.insecure_channel(server.grpc_address) as channel:
        call = grasp_pb2_grpc.GraspServiceStub(channel).DetectGrasps(
            grasp_pb2.DetectGraspsRequest(points=b"1"), metadata=(("x-request-id", "mine"),)
        )
        assert await call.code() == grpc.StatusCode.INVALID_ARGUMENT
        assert dict(await call.trailing_metadata())["x-request-id"] == "mine"


async def test_a_stream_is_named_before_its_first_answer(dummy_server) -> None:
    async with aio.insecure_channel(dummy_server.grpc_address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        call = stub.DetectGraspsStream(metadata=(("x-request-id", "mine"),))
        assert dict(await call.initial_metadata())["x-request-id"] == "mine"
        call.cancel()


class Serving:
    """`edgegrasp serve` with what it is given as standard output and error."""

    def __init__(self, *flags: str, folder: Path, closed: bool = False, **streams: Any) -> None:
        program = "from edgegrasp_cli.main import main; main()"
        ports = free_ports()
        self.url, self.address = (f"http://127.0.0.1:{ports[0]}", f"127.0.0.1:{ports[1]}")
        command = [sys.executable, "-c", program, "serve", "--backend", "dummy", *flags]
        command += [f"--http-port={ports[0]}", f"--grpc-port={ports[1]}"]
        if closed:
            command = ["sh", "-c", 'exec "$0" "$@" >&- 2>&-', *command]
        self.process = subprocess.Popen(command, text=True, cwd=folder, **streams)

    def wait(self) -> None:
        for _ in range(600):
            assert self.process.poll() is None
            try:
                if httpx.get(f"{self.url}/health/ready").status_code == 200:
                    return
            except httpx.TransportError:
                pass
            threading.Event().wait(0.1)
        raise AssertionError("not ready within a minute")

    def ask(self, cloud: np.ndarray, request_id: str) -> None:
        """One detection over each transport."""
        headers = {"x-request-id": request_id}
        answer = httpx.post(
            f"{self.url}/v1/grasps", json={"points": cloud.tolist()}, headers=headers, timeout=20
        )
        assert answer.status_code == 200
        with grpc.insecure_channel(self.address) as channel:
            request = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            stub.DetectGrasps(request, timeout=20, metadata=tuple(headers.items()))

    def stop(self) -> int:
        self.process.terminate()
        return self.process.wait(timeout=20)


def free_ports() -> list[int]:
    with socket.socket() as first, socket.socket() as second:
        for one in (first, second):
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in (first, second)]


def test_json_lines_name_requests(tmp_path: Path, cloud: np.ndarray) -> None:
    with (tmp_path / "log").open("w") as log:
        server = Serving(stdout=subprocess.DEVNULL, stderr=log, folder=tmp_path)
        server.wait()
        server.ask(cloud, "robot-1/42")
        with grpc.insecure_channel(
            server.address
        ) as channel:  # gRPC would say something of its own
            call = channel.unary_unary("/edgegrasp.v1.GraspService/ListModels", bytes, bytes)
            with pytest.raises(grpc.RpcError, match="gzip"):
                call(bytes(5000), timeout=20, compression=grpc.Compression.Gzip)
        assert server.stop() == 0
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    ours = [line for line in lines if line.get("request_id") == "robot-1/42"]
    assert [(line["transport"], line["code"], line["message"]) for line in ours] == [
        ("http", "200", "request"),
        ("grpc", "OK", "request"),
    ]
    for line in ours:
        assert line["level"] == "info"
        assert line["time"].endswith("+00:00")
        assert line["seconds"] > 0.0
        assert (line["peer"], line["model"], line["points"]) == ("127.0.0.1", "dummy", 500)
        assert (line["grasps"], line["bytes_in"] > 5000, line["bytes_out"] > 500) == (
            10,
            True,
            True,
        )
        assert {"admission", "read", "wait", "prepare", "network"} <= set(line["milliseconds"])
    assert not any(line.get("method") in ("Ready", "Live") for line in lines)  # probes


@pytest.mark.parametrize("where", ["full disk", "closed", "pipe nobody reads", "pipe with no end"])
def test_requests_outlive_the_log(where: str, tmp_path: Path, cloud: np.ndarray) -> None:
    """Standard output too, where the ready line goes."""
    flags = ["--log-level", "debug"]
    if where == "full disk":
        if not Path("/dev/full").exists():
            pytest.skip("there is no /dev/full here")
        with Path("/dev/full").open("w") as full:
            server = Serving(*flags, stdout=full, stderr=full, folder=tmp_path)
    elif where == "closed":
        server = Serving(*flags, closed=True, folder=tmp_path)
    else:
        read, write = os.pipe()
        if where == "pipe with no end":
            os.close(read)
        else:
            os.set_blocking(write, False)
            try:
                while os.write(write, bytes(4096)):
                    pass
            except BlockingIOError:
                os.set_blocking(write, True)
        server = Serving(*flags, stdout=subprocess.DEVNULL, stderr=write, folder=tmp_path)
        os.close(write)
    try:
        server.wait()
        for number in range(5):
            server.ask(cloud, f"request-{number}")
    finally:
        code = server.stop()
    assert code == 0


class Broken(io.TextIOBase):
    def fileno(self) -> int:
        raise OSError("closed")


@pytest.mark.parametrize("stream", [Broken(), None])
def test_lines_not_written_are_counted(stream: TextIO | None) -> None:
    writer = LogQueue(stream, TextFormatter())
    for _ in range(3):
        writer.handle(logging.makeLogRecord({"msg": "lost"}))
    writer.handle(logging.makeLogRecord({"msg": "%d", "args": ("no number",)}))
    writer.close()
    assert writer.dropped == 4


@given(st.text(), st.text())
def test_one_record_is_one_line(message: str, value: str) -> None:
    record = logging.makeLogRecord({"msg": "%s", "args": (message,), "fields": {"value": value}})
    line = JsonFormatter().format(record)
    assert "\n" not in line
    assert json.loads(line)["message"] == message
    assert len(TextFormatter().format(record).splitlines()) == 1


async def test_a_token_is_named_and_not_told(serve, cloud, tmp_path: Path, caplog) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "tokens").write_text(f"arm-1:{TOKEN}")
    server = (await serve(token_file=tmp_path / "tokens")).server
    async with AsyncGraspClient(server.grpc_address, token=TOKEN) as client:
        await client.detect(cloud)
        for record in caplog.records:
            assert TOKEN not in str(vars(record))
    async with asyncio.timeout(20):
        while not (told := [vars(record).get("fields", {}) for record in caplog.records]):
            await asyncio.sleep(0.01)
    assert "arm-1" in [fields.get("token") for fields in told]


def test_a_fault_is_logged_with_its_traceback_and_request() -> None:
    queue = LogQueue(None, JsonFormatter())
    CALL.set(Call("http", "DetectGrasps", "mine"))
    try:
        raise ValueError("why")
    except ValueError:
        record = logging.makeLogRecord({"msg": "failed", "exc_info": sys.exc_info()})
    line = json.loads(queue.prepare(record))
    assert line["request_id"] == "mine"
    assert "ValueError: why" in line["exception"]
    assert "ValueError: why" in TextFormatter().format(record).splitlines()[-1]
    CALL.set(None)
    queue.close()
