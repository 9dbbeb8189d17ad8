"""Whatever is sent to a running server, it answers with less than 500, and stays as large.

What the bodies say is fuzzed without one, in test_fuzz_decoders.py.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import grpc
import httpx
import pytest
from hypothesis import strategies as st

from edgegrasp.v1 import grasp_pb2

from .conftest import FILES, POINTS, given, mutated
from .test_fuzz_decoders import FORM, MESSAGES

MAX_GROWTH = 100  # MB; a request here is a few kB
PATIENCE = 20


@dataclass
class Target:
    http: httpx.Client
    channel: grpc.Channel
    pid: int

    def memory(self) -> float:
        """Resident, MB."""
        return int(Path(f"/proc/{self.pid}/statm").read_text().split()[1]) * 4096 / 1e6

    def post(self, content: bytes, media_type: str, path: str = "/v1/grasps") -> int:
        headers = {"content-type": media_type}
        response = self.http.post(path, content=content, headers=headers)
        status = response.status_code
        assert status < 500, response.text
        if status != 200:
            assert response.headers["content-type"] == "application/problem+json"
            assert response.json()["status"] == status
            assert len(response.content) < 10_000
        return status

    def call(self, method: str, content: bytes) -> grpc.StatusCode:
        call = self.channel.unary_unary(f"/edgegrasp.v1.GraspService/{method}")
        code = status_of(lambda: call(content, timeout=PATIENCE))
        assert code in {grpc.StatusCode.OK, *ANSWERS}
        return code


def status_of(work: Callable[[], object]) -> grpc.StatusCode:
    try:
        work()
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


ANSWERS = {
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
}


@pytest.fixture(scope="module")
def target(dummy_server) -> Iterator[Target]:
    http = httpx.Client(base_url=dummy_server.http_url, timeout=PATIENCE)
    with http, grpc.insecure_channel(dummy_server.grpc_address) as channel:
        found = Target(http, channel, dummy_server.process.pid)
        found.post(FILES["npy"][0], "application/x-npy")
        before = found.memory()
        yield found
        assert found.post(FILES["npy"][0], "application/x-npy") == 200
        assert found.memory() - before < MAX_GROWTH


BODIES = [
    ("application/json", json.dumps({"points": POINTS.tolist(), "options": {"seed": 3}}).encode()),
    ("application/x-npy", FILES["npy"][0]),
    ("multipart/form-data; boundary=b", FORM),
]


@given(
    st.sampled_from(BODIES).flatmap(
        lambda body: st.tuples(st.just(body[0]), mutated([body[1]]) | st.binary(max_size=300))
    ),
    st.sampled_from(["/v1/grasps", "/v1/grasps:score", "/v1/grasps?seed=%FF&up=[", "/v1/models"]),
)
def test_bodies(target: Target, body: tuple[str, bytes], path: str) -> None:
    target.post(body[1], body[0], path)


@given(
    mutated([message.SerializeToString() for message in MESSAGES]) | st.binary(max_size=100),
    st.sampled_from(["DetectGrasps", "ScoreGrasps", "ListModels"]),
)
def test_messages(target: Target, content: bytes, method: str) -> None:
    target.call(method, content)


@given(st.lists(mutated([message.SerializeToString() for message in MESSAGES[:4]]), max_size=3))
def test_messages_of_a_stream(target: Target, contents: list[bytes]) -> None:
    """Each is answered, or ends the stream where it is no message at all."""
    requests = [
        grasp_pb2.DetectGraspsStreamRequest(request_id="a").SerializeToString()
        + b"\x12"
        + length(content)
        + content
        for content in contents
    ]
    call = target.channel.stream_stream("/edgegrasp.v1.GraspService/DetectGraspsStream")
    answers: list[grasp_pb2.DetectGraspsStreamResponse] = []

    def read() -> None:
        for response in call(iter(requests), timeout=PATIENCE):
            answers.append(grasp_pb2.DetectGraspsStreamResponse.FromString(response))

    code = status_of(read)
    assert code in ANSWERS or (code is grpc.StatusCode.OK and len(answers) == len(contents))
    for answer in answers:
        if answer.WhichOneof("answer") == "error":
            assert answer.error.code in {code.value[0] for code in ANSWERS}


def length(content: bytes) -> bytes:
    """A varint."""
    value, found = len(content), b""
    while value > 127:
        found += bytes([value & 127 | 128])
        value >>= 7
    return found + bytes([value])


def test_long_words_come_back_short(target: Target) -> None:
    """Or they would not fit into gRPC's metadata, and nobody would hear what is wrong."""
    encoded = grasp_pb2.EncodedCloud(format="x" * 100_000, data=b"a")
    for message in (
        grasp_pb2.DetectGraspsRequest(encoded=encoded),
        grasp_pb2.DetectGraspsRequest(points=POINTS.tobytes(), options={"model": "x" * 100_000}),
        grasp_pb2.DetectGraspsRequest(points=POINTS.tobytes(), options={"sampling": "é" * 90_000}),
    ):
        code = target.call("DetectGrasps", message.SerializeToString())
        assert code in (grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND)
    assert target.post(b'{"\\ud800": 1}', "application/json") == 400
    assert target.post(b"[" * 990 + b"]" * 990, "application/json") == 400
    assert target.post(b'{"points": ' + b"[" * 980 + b"]" * 980 + b"}", "application/json") == 400
