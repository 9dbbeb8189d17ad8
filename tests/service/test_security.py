"""Who may ask, over both transports: TLS, client certificates, tokens, and what stays open."""

import asyncio
import socket
import ssl
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from grpc import StatusCode
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client import AsyncGraspClient, GraspClient, StreamRequest, Tls
from edgegrasp_client.errors import (
    AccessDeniedError,
    InvalidRequestError,
    ServerUnavailableError,
)
from edgegrasp_service.errors import InvalidSettings, ReloadFailed
from edgegrasp_service.probe import is_ready, read_settings
from edgegrasp_service.security import ServerTls, Tokens
from edgegrasp_service.server import warn
from edgegrasp_service.settings import Settings

from .conftest import ADMIN, USER, WRONG


@pytest.fixture
def server_tls(pem: dict[str, Path]) -> dict[str, Path]:
    return {"tls_certificate": pem["server"], "tls_key": pem["server_key"]}


async def refused(address: str, **security: Any) -> Exception:
    async with AsyncGraspClient(address, timeout=5, **security) as client:
        with pytest.raises(Exception) as caught:  # noqa: PT011  # the caller looks at it
            await client.models()
    return caught.value


async def test_tls(serve, server_tls, pem, transport: str, cloud: np.ndarray) -> None:
    running = await serve(**server_tls)
    address = running.address(transport)
    client = running.ours(transport, tls=Tls(ca=pem["ca"]))
    assert await client.ready()
    assert len((await client.detect(cloud)).grasps) == 10
    by_other = await refused(address, tls=Tls(ca=pem["other_ca"]))
    plain = await refused(address.replace("https", "http"))
    assert {type(by_other), type(plain)} == {ServerUnavailableError}


def test_clients_that_connect_at_once_over_tls_do_no_harm(start_dummy, pem) -> None:
    context = ssl.create_default_context(cafile=pem["ca"])
    context.set_alpn_protocols(["h2"])
    flags = "--tls-certificate", pem["server"], "--tls-key", pem["server_key"]
    with start_dummy(*flags) as server:
        host, port = server.grpc_address.rsplit(":", 1)

        def shake_hands(_: int) -> None:
            with socket.create_connection((host, int(port))) as connection:
                context.wrap_socket(connection, server_hostname=host).close()

        with ThreadPoolExecutor(16) as clients:
            list(clients.map(shake_hands, range(4000)))
        with GraspClient(server.grpc_address, tls=Tls(ca=pem["ca"])) as client:
            assert client.models()


async def test_certificates_are_read_anew(serve, pem, transport, cloud, tmp_path) -> None:
    """Server's and clients' alike; connections that are open stay, and bad files change nothing."""
    files = {name: tmp_path / f"{name}.pem" for name in ("server", "server_key", "ca")}

    def put(prefix: str) -> None:
        for name, path in files.items():
            path.write_bytes(pem[prefix + name].read_bytes())

    def tls(prefix: str, client: str) -> Tls:
        return Tls(pem[f"{prefix}ca"], pem[f"{client}client"], pem[f"{client}client_key"])

    put("")
    given = {"tls_certificate": files["server"], "tls_key": files["server_key"]}
    running = await serve(**given, tls_client_ca=files["ca"])
    address = running.address(transport)
    before = running.ours(transport, tls=tls("", ""))
    assert await before.models()
    put("other_")
    await running.server.service.reload()
    for client in (running.ours(transport, tls=tls("other_", "other_")), before):
        assert len((await client.detect(cloud)).grasps) == 10
    for stranger in (tls("", ""), tls("other_", ""), Tls(ca=pem["other_ca"])):
        error = await refused(address, tls=stranger)
        assert isinstance(error, ServerUnavailableError)
        assert "a client certificate" in str(error)
    files["server_key"].write_text("half a k")
    with pytest.raises(ReloadFailed, match="cannot be read as a certificate with its key"):
        await running.server.service.reload()
    assert await running.ours(transport, tls=tls("other_", "other_")).models()


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"tls_certificate": "none.pem"}, "No such file or directory: 'none.pem'"),
        ({"tls_key": "other_server_key"}, "cannot be read as a certificate with its key"),
        ({"tls_certificate": "text"}, "cannot be read as a certificate with its key"),
        ({"tls_client_ca": "text"}, "and tls_client_ca"),
    ],
)
def test_bad_certificates_are_named(pem, server_tls, tmp_path, changed, sentence) -> None:
    (tmp_path / "text").write_text("no certificate")
    files = {**pem, "text": tmp_path / "text"}
    given = server_tls | {name: files.get(value, value) for name, value in changed.items()}
    with pytest.raises(InvalidSettings, match=sentence):
        ServerTls(Settings(**given))


def test_unusable_files_of_a_client_are_named(transport: str, pem) -> None:
    address = "127.0.0.1:1" if transport == "grpc" else "https://127.0.0.1:1"
    for wrong in (Tls(pem["server_key"]), Tls(pem["ca"], pem["client"], pem["other_client_key"])):
        with pytest.raises(InvalidRequestError, match="Give PEM files"):
            GraspClient(address, tls=wrong)


async def test_tokens(serve, transport: str, cloud: np.ndarray) -> None:
    running = await serve(tokens=[USER], admin_tokens=[ADMIN])
    address = running.address(transport)
    for token in (USER, ADMIN):
        assert len((await running.ours(transport, token=token).detect(cloud)).grasps) == 10
    for token in (None, WRONG, USER[:-1]):
        error = await refused(address, token=token)
        assert isinstance(error, AccessDeniedError)
        assert token is None or token not in str(error)
        stream = running.ours(transport, token=token).detect_stream([StreamRequest(cloud)] * 3)
        with pytest.raises(AccessDeniedError):
            [answer.result() async for answer in stream]


async def test_only_probes_are_open(serve) -> None:
    running = await serve(tokens=[USER], admin_tokens=[ADMIN], max_body_bytes=1024)
    http, channel = running.http(), running.channel()
    for path in ("/health/live", "/health/ready", "/docs", "/openapi.json"):
        assert (await http.get(path)).status_code == 200
    for path in (
        *("/v1/models", "/v1/grasps", "/v1/grasps:score", "/v1/models:reload"),
        *("/metrics", "/none", "//health/live", "/health/live/", "/docs/", "//docs", "/docs/none"),
    ):
        answer = await http.get(running.server.http_url + path)
        assert answer.status_code == 401, path
        assert answer.headers["www-authenticate"] == 'Bearer realm="edgegrasp"'
        assert answer.json()["type"] == "urn:edgegrasp:error:unauthenticated"
    evil = {"origin": "http://evil.example", "access-control-request-method": "POST"}
    for method, path in (("OPTIONS", "/v1/grasps"), ("GET", "/v1/models")):
        answer = await http.request(method, path, headers=evil)
        assert not [name for name in answer.headers if name.startswith("access-control")]
    for status, header in (
        *((401, bad) for bad in ("", "Bearer", f"Basic {USER}", USER, b"Bearer \xc3\xbf\xff")),
        *((200, good) for good in (f"bearer  {USER}", f"Bearer {ADMIN}")),
    ):
        answer = await http.get("/v1/models", headers={"authorization": header})
        assert answer.status_code == status, header
    health = await health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest())
    assert health.status == health_pb2.HealthCheckResponse.SERVING
    request = reflection_pb2.ServerReflectionRequest(list_services="")
    too_large = grasp_pb2.DetectGraspsRequest(points=bytes(12_000))  # which is not read
    for call in (
        reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo(iter([request])),
        channel.unary_unary("/edgegrasp.v1.GraspService/None", bytes, bytes)(b""),
        running.stub().DetectGrasps(too_large),
    ):
        assert await call.code() == StatusCode.UNAUTHENTICATED


async def test_no_tls_older_than_1_2_and_a_health_check(serve, server_tls, pem) -> None:
    given = server_tls | {"tls_client_ca": pem["ca"]}
    server = (await serve(**given, tokens=[USER])).server
    port = int(server.http_url.rpartition(":")[2])
    assert await asyncio.to_thread(is_ready, "127.0.0.1", port, pem["server"], pem["ca"])
    assert ServerTls(Settings(**given)).http.current.minimum_version == ssl.TLSVersion.TLSv1_2


async def test_health_checks_read_what_the_server_reads(serve, server_tls, tmp_path, monkeypatch):
    port = int((await serve(**server_tls)).server.http_url.rpartition(":")[2])
    config = tmp_path / "server.toml"
    config.write_text(f"http_port = {port}\nworkers = 1\ntls_key = 'key.pem'\n")
    monkeypatch.setenv("EDGEGRASP_CONFIG", str(config))
    assert not await asyncio.to_thread(is_ready, **read_settings())  # speaks TLS
    monkeypatch.setenv("EDGEGRASP_TLS_CERTIFICATE", str(server_tls["tls_certificate"]))
    assert await asyncio.to_thread(is_ready, **read_settings())


@pytest.mark.parametrize(
    ("given", "warned"),
    [
        ({}, []),
        ({"host": "::1"}, []),
        ({"host": "localhost"}, []),
        ({"host": "unix:/run/edgegrasp"}, []),
        ({"host": "0.0.0.0"}, ["nothing is encrypted", "without a token"]),
        ({"host": "robot.example", "token_file": "tokens"}, ["nothing is encrypted"]),
        ({"weights": ["without any"]}, ["without any"]),
    ],
)
def test_what_an_operator_may_not_want_is_warned_of(given, warned, caplog, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("without any").mkdir()
    Path("tokens").write_text(USER)
    warn(Settings(**given))
    assert len(caplog.messages) == len(warned)
    assert all(said in message for said, message in zip(warned, caplog.messages, strict=True))


def test_bad_files_are_named_and_a_comment_may_follow_a_token(tmp_path: Path) -> None:
    settings = Settings(token_file=tmp_path / "tokens")
    for text, sentence in (
        (None, "cannot be read"),
        (b"short\n", "got 5 letters as token 1"),
        (f"{USER}\ntwo words of enough letters\n".encode(), "token 2"),
        (b"# none\n", "It has no token"),
        (b"\xff\xfe", "cannot be read"),
    ):
        if text is not None:
            settings.token_file.write_bytes(text)
        with pytest.raises(InvalidSettings) as caught:
            Tokens(settings)
        assert sentence in str(caught.value)
        assert "short" not in str(caught.value)
    settings.token_file.write_text(f"# all robots\n\nleft:{USER}  # of cell 1\n")
    assert Tokens(settings).check(f"Bearer {USER}").name == "left"
