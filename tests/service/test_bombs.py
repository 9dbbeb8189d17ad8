"""What is small on the way in and large inside is refused, before it is large."""

import ast
import asyncio
import gzip
from pathlib import Path

import grpc
import httpx
import numpy as np
import pytest
from grpc import StatusCode, aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc

ROOT = Path(__file__).parents[2]
MIB = 2**20


async def send(url: str, head: bytes) -> bytes:
    """Send bytes of one's own over a connection; what comes back until it closes."""
    host, _, port = url.removeprefix("http://").partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    answer = b""
    try:
        writer.write(head)
        await writer.drain()
        answer = await reader.read()
    except ConnectionError:
        pass
    finally:
        writer.close()
    return answer


LARGE_HEADS = {
    "a header": b"GET /v1/models HTTP/1.1\r\nx: " + b"a" * 40_000,
    "headers": b"GET /v1/models HTTP/1.1\r\n" + b"\r\n".join([b"x: y"] * 10_000),
    "address": b"GET /v1/models?" + b"a" * 40_000 + b" HTTP/1.1",
    "escapes": b"GET /" + b"%41" * 13_000 + b" HTTP/1.1",
    "beyond what is read at once": b"GET / HTTP/1.1\r\nx: " + b"a" * MIB,
}


@pytest.mark.parametrize("name", LARGE_HEADS)
async def test_large_http_headers_are_refused(serve, name: str) -> None:
    server = (await serve(max_header_bytes=16_384)).server
    end = b"\r\nHost: x\r\nConnection: close\r\n\r\n"
    answer = await send(server.http_url, LARGE_HEADS[name] + end)
    # A server that does not read to the end closes, and its answer may be lost on the way.
    assert not answer or answer.split()[1] in (b"400", b"431")
    assert answer or name == "beyond what is read at once"
    async with httpx.AsyncClient(base_url=server.http_url) as http:
        fine = await http.get("/v1/models", headers={"x": "a" * 8000})
        assert fine.status_code == 200


async def test_an_endless_http_header_is_not_kept(serve) -> None:
    server = (await serve(max_header_bytes=16_384)).server
    # Ends because the server closes: there is no end of the header.
    answer = await send(server.http_url, b"GET / HTTP/1.1\r\nx: " + b"a" * MIB)
    assert not answer or answer.startswith(b"HTTP/1.1 431")


async def test_many_http_headers_are_refused(dummy_server) -> None:
    server = dummy_server
    async with httpx.AsyncClient(base_url=server.http_url) as http:
        answer = await http.get("/health/live", headers={f"x-{n}": "y" for n in range(100)})
        assert answer.status_code == 431
        assert answer.json()["type"] == "urn:edgegrasp:error:headers-too-large"
        assert answer.json()["fix"] == "Send at most 64."


async def test_large_and_many_metadata_are_refused(serve, cloud: np.ndarray) -> None:
    server = (await serve(max_header_bytes=16_384)).server
    async with aio.insecure_channel(server.grpc_address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        request = grasp_pb2.DetectGraspsRequest(points=cloud.tobytes())
        for metadata in (
            (("x-large", "a" * 40_000),),
            tuple((f"x-{n}", "y") for n in range(100)),
        ):
            call = stub.DetectGrasps(request, metadata=metadata)
            assert await call.code() == StatusCode.RESOURCE_EXHAUSTED
        trailers = dict(await call.trailing_metadata())
        detail = grasp_pb2.ErrorDetail.FromString(trailers["edgegrasp-error-bin"])
        assert (detail.kind, detail.field) == ("headers-too-large", "metadata")
        assert len((await stub.DetectGrasps(request)).grasps) == 10


@pytest.mark.parametrize("encoding", ["gzip", "deflate", "br", "gzip, gzip"])
async def test_compressed_bodies_are_refused(dummy_server, encoding: str) -> None:
    server = dummy_server
    async with httpx.AsyncClient(base_url=server.http_url) as http:
        headers = {"content-encoding": encoding, "content-type": "application/json"}
        answer = await http.post(
            "/v1/grasps", content=gzip.compress(bytes(10 * MIB)), headers=headers
        )
        assert answer.status_code == 415
        assert answer.json()["field"] == "Content-Encoding"


@pytest.mark.parametrize("compression", [grpc.Compression.Gzip, grpc.Compression.Deflate])
async def test_compressed_messages_are_refused(dummy_server, compression: grpc.Compression) -> None:
    server = dummy_server
    async with aio.insecure_channel(server.grpc_address) as channel:
        request = grasp_pb2.DetectGraspsRequest(points=bytes(12 * 100_000))
        call = grasp_pb2_grpc.GraspServiceStub(channel).DetectGrasps(
            request, compression=compression
        )
        assert await call.code() == StatusCode.UNIMPLEMENTED


FOLDERS = ("clients", "model", "proto", "service", "examples", "benchmarks", "docs", "scripts")
UNPICKLE = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}


def faults(tree: ast.AST) -> list[str]:
    """Every way to unpickle that a module has."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [name.name for name in node.names if name.name.split(".")[0] in UNPICKLE]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in UNPICKLE:
            # torch raises that error on what is more than arrays.
            found += [name.name for name in node.names if name.name != "UnpicklingError"]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            given = {keyword.arg: keyword.value for keyword in node.keywords}
            owner = node.func.value.id if isinstance(node.func.value, ast.Name) else ""
            if node.func.attr == "load" and owner in ("np", "numpy"):
                allowed = given.get("allow_pickle")
                if not (isinstance(allowed, ast.Constant) and allowed.value is False):
                    found.append(f"line {node.lineno}: np.load without allow_pickle=False")
            if node.func.attr == "load" and owner == "torch":
                only = given.get("weights_only")
                if not (isinstance(only, ast.Constant) and only.value is True):
                    found.append(f"line {node.lineno}: torch.load without weights_only=True")
            if node.func.attr in ("save", "savez", "read_array") and owner in ("np", "numpy"):
                allowed = given.get("allow_pickle")
                if isinstance(allowed, ast.Constant) and allowed.value is True:
                    found.append(f"line {node.lineno}: allow_pickle=True")
    return found


def test_nothing_is_unpickled() -> None:
    found = {
        str(path.relative_to(ROOT)): wrong
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
        if (wrong := faults(ast.parse(path.read_text())))
    }
    assert found == {}


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from pickle import loads",
        "np.load(file)",
        "np.load(file, allow_pickle=True)",
        "np.load(file, allow_pickle=given)",
        "torch.load(file)",
        "torch.load(file, weights_only=False)",
    ],
)
def test_that_search_finds_what_unpickles(line: str) -> None:
    assert faults(ast.parse(line))
