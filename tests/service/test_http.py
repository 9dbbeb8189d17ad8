"""HTTP as proxies, browsers and careless clients speak it."""

import asyncio
import re
import time
from contextlib import suppress
from functools import partial, reduce
from typing import Any

import httpx
import pytest
from benchmarks.soak import connect

from edgegrasp_service.errors import InvalidSettings


def test_pages_work_without_internet(http) -> None:
    http.follow_redirects = True
    for path in ("/", "/docs"):
        page = http.get(path)
        links = re.findall(r'(?:src|href)="([^"]+)"', page.text)
        assert any(link.endswith(".js") for link in links)
        for link in links:
            assert not link.startswith(("http", "//")), "it would be fetched from elsewhere"
            assert http.get(page.url.join(link)).status_code == 200


async def test_the_front_page_is_the_playground_or_that_of_the_api(serve, tmp_path) -> None:
    for playground, path, status in ((True, "/playground/", 200), (False, "/docs", 404)):
        http = (await serve(playground=playground)).http()
        front = await http.get("/", follow_redirects=True)
        assert front.url.path == path
        assert "default-src 'none'" in front.headers["content-security-policy"] or not playground
        assert (await http.get("/playground", follow_redirects=True)).status_code == status
        assert (await http.get("/playground/")).status_code == status
    with pytest.raises(InvalidSettings, match=r"samples: got '.*none', which is not a folder"):
        await serve(samples=tmp_path / "none")


def test_the_page_draws_grippers_by_fields_that_they_have(http) -> None:
    drawn = set(re.findall(r"this\.gripper\.([\w.]*\w)", http.get("/playground/view.js").text))
    assert len(drawn) >= 4
    for gripper in http.get("/playground/grippers.json").json().values():
        for path in (*drawn, "swing"):
            reduce(dict.__getitem__, path.split("."), gripper)


def test_head_is_get_without_the_body_and_answers_say_what_a_browser_may_do(http) -> None:
    for path in ("/health/live", "/health/ready", "/v1/models", "/docs", "/metrics"):
        answer = http.head(path)
        assert (answer.status_code, answer.content) == (200, b""), path
    assert http.head("/v1/grasps").status_code == 405
    for path in ("/docs", "/playground/", "/v1/models", "/none", "/openapi.json"):
        headers = http.get(path).headers
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"


def test_no_redirect_to_a_host_that_the_caller_names(dummy_server) -> None:
    for path in ("/v1/grasps/", "/v1/models/", "//v1/grasps"):
        answer = httpx.post(dummy_server.http_url + path, headers={"host": "evil"})
        assert answer.status_code == 404, path
        assert "location" not in answer.headers
        assert answer.headers["content-type"] == "application/problem+json"


def talk(url: str, data: bytes) -> bytes:
    """All that the server says before it closes."""
    with connect(url) as connection:
        connection.sendall(data)
        return b"".join(iter(partial(connection.recv, 65536), b""))


POST = b"POST /v1/grasps HTTP/1.1\r\nHost: x\r\n"


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"\x16\x03\x01 is no HTTP\r\n\r\n", 400),
        (b"BREW /v1/grasps HTTP/1.1\r\nHost: x\r\n\r\n", 400),
        (POST + b"Content-Length: none\r\n\r\n", 400),
        (POST + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 400),
        (POST + b"X: " + b"y" * 50_000 + b"\r\n\r\n", 431),
        (POST + b"Y: " + b"y" * 50_000, 431),
        (b"GET /" + b"%41" * 13_000 + b" HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n", 431),
        (POST + b"".join(b"Z%d: z\r\n" % number for number in range(80)) + b"\r\n", 431),
        (POST + b"Content-Length: 4\r\nContent-Encoding: gzip\r\n\r\n", 415),
    ],
)
def test_what_is_no_good_request_is_told_why(dummy_server, data: bytes, status: int) -> None:
    if status == 431 and data.endswith(b"\r\n\r\n"):
        data = data[:-2] + b"Content-Length: 9\r\n\r\n"  # so that it is closed
    head, _, body = talk(dummy_server.http_url, data).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 %d" % status), head
    assert b"content-type: application/problem+json" in head
    assert b"connection: close" in head
    assert b'"status":%d' % status in body


def test_trailers_of_a_body_are_bounded(dummy_server) -> None:
    with connect(dummy_server.http_url) as connection:
        connection.sendall(POST + b"Transfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n")
        with suppress(ConnectionError):  # it may be closed before all is sent
            for _ in range(100):
                connection.sendall(b"a: b\r\n" * 1_000)
                time.sleep(0.001)
        assert connection.recv(12) == b"HTTP/1.1 431"


def test_headers_in_pieces_may_follow_a_body(dummy_server) -> None:
    pair = b"Content-Length: 50000\r\n\r\n" + bytes(50_000) + b"GET /he"
    with connect(dummy_server.http_url) as connection:
        connection.sendall(POST + pair)
        time.sleep(0.3)
        connection.sendall(b"alth/live HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        assert connection.recv(12) == b"HTTP/1.1 415"


def test_an_upgrade_is_ignored(http) -> None:
    """Java's HttpClient and curl --http2 ask for one."""
    asked = {"connection": "Upgrade, HTTP2-Settings", "upgrade": "h2c", "http2-settings": "AAMA"}
    assert "body: got []" in http.post("/v1/grasps", json=[], headers=asked).text


async def test_a_refused_client_that_sends_on_leaves_no_traceback(running, caplog) -> None:
    refused = POST + b"Content-Length: 99999999\r\n\r\n"
    said = await asyncio.to_thread(talk, running.server.http_url, refused + 2 * POST + bytes(10**6))
    assert said.startswith(b"HTTP/1.1 413")
    assert said.count(b"HTTP/1.1") == 1
    await running.until(lambda: running.ended == ["payload-too-large"])
    assert not [record for record in caplog.records if record.exc_info]


async def test_headers_that_do_not_come_are_not_waited_for(serve) -> None:
    running = await serve(read_seconds=0.3)
    for data in (POST, b""):
        said = await asyncio.to_thread(talk, running.server.http_url, data)
        assert said.startswith(b"HTTP/1.1 408")


@pytest.mark.parametrize(
    ("host", "given", "status"),
    [
        ("evil.example", {}, 400),
        ("evil.example:8000", {}, 400),
        ("localhost:8000", {}, 200),
        ("127.0.0.1", {}, 200),
        ("[::1]:8000", {}, 200),
        ("edgegrasp", {}, 200),  # a name within one's own network
        ("robot.example", {"allowed_hosts": ["Robot.example"]}, 200),
        ("evil.example", {"allowed_hosts": ["robot.example"]}, 400),
        ("evil.example", {"allowed_hosts": ["*"]}, 200),
    ],
)
async def test_names_of_the_server(serve, host: str, given: dict[str, Any], status: int) -> None:
    """A web page can have its own name point to this server."""
    http = (await serve(**given)).http()
    for path in ("/v1/models", "/docs", "/metrics"):
        assert (await http.get(path, headers={"host": host})).status_code == status
    assert (await http.get("/health/live", headers={"host": host})).status_code == 200
