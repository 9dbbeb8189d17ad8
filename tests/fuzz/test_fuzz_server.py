"""Whatever is sent to a running server, it answers with less than 500, and stays as large.

What the bodies say is fuzzed without one, in test_fuzz_decoders.py.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import psutil
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from tests.programs import run

from edgegrasp.v1 import grasp_pb2

from .conftest import FILES, POINTS, given, mutated
from .test_fuzz_decoders import MESSAGES

MAX_GROWTH = 100e6  # bytes; a request here is a few kB
PATIENCE = 20
ANSWERS = {
    grpc.StatusCode.OK,
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
}


@pytest.fixture(scope="module")
def channel(dummy_server) -> Iterator[grpc.Channel]:
    """A connection to a server that goes on and does not grow."""
    front, url = psutil.Process(dummy_server.process.pid), f"{dummy_server.http_url}/v1/grasps"
    good = {"content": FILES["npy"][0], "headers": {"content-type": "application/x-npy"}}
    assert httpx.post(url, **good, timeout=PATIENCE).status_code == 200
    before = front.memory_info().rss
    with grpc.insecure_channel(dummy_server.grpc_address) as channel:
        yield channel
    assert httpx.post(url, **good, timeout=PATIENCE).status_code == 200
    assert front.memory_info().rss - before < MAX_GROWTH


REQUESTS = [
    grasp_pb2.DetectGraspsStreamRequest(request_id="a", request=message).SerializeToString()
    for message in MESSAGES[:4]
]


@given(st.lists(mutated(REQUESTS), max_size=3))
def test_each_mutated_message_of_a_stream_is_answered(channel, contents) -> None:
    """Each is answered, or ends the stream where it is no message at all."""
    method = channel.stream_stream("/edgegrasp.v1.GraspService/DetectGraspsStream")
    call: Any = method(iter(contents), timeout=PATIENCE)
    answers = []
    try:
        for response in call:
            answers.append(grasp_pb2.DetectGraspsStreamResponse.FromString(response))
    except grpc.RpcError:
        assert call.code() in ANSWERS
    else:
        assert len(answers) == len(contents)
    for answer in answers:
        if answer.WhichOneof("answer") == "error":
            assert answer.error.code in {code.value[0] for code in ANSWERS}


def test_long_words_come_back_short(channel: grpc.Channel) -> None:
    """Or they would not fit into gRPC's metadata, and nobody would hear what is wrong."""
    points = POINTS.tobytes()
    for fields in (
        {"encoded": {"format": "x" * 100_000, "data": b"a"}},
        {"points": points, "options": {"model": "x" * 100_000}},
        {"points": points, "options": {"sampling": "\u00e9" * 90_000}},
    ):
        content = grasp_pb2.DetectGraspsRequest(**fields).SerializeToString()
        method = channel.unary_unary("/edgegrasp.v1.GraspService/DetectGrasps")
        code = method.future(content).code()
        assert code in (grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND)


SHORT = ("--phases", "fuzzing", "--max-examples", "5")
LONG = ("--phases", "coverage,fuzzing", "--max-examples", "100", "--max-time", "120")
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "unsupported_method",
)


def test_the_server_keeps_to_its_document(start_dummy, tmp_path: Path) -> None:
    program = Path(sys.executable).parent / "schemathesis"
    if not program.exists():
        pytest.skip("schemathesis is not installed")
    long = settings.get_current_profile_name() == "fuzz"
    token = "fuzz-0123456789abcdef0123456789abcdef"
    file = tmp_path / "tokens"
    file.write_text(token)
    flags = ("--log-level", "error", "--admin-token-file", str(file))
    with start_dummy(*flags) as server:
        command = [program, "run", f"{server.http_url}/openapi.json", "--no-color", "--seed", "1"]
        command += ["--header", f"Authorization: Bearer {token}"]
        # What the document allows may be shorter than any answer takes: a 504 is no fault.
        command += ["--header", "X-Request-Timeout: 60", "--request-timeout", "60"]
        checks = ("--checks", ",".join(CHECKS))
        done = run(*command, *checks, *(LONG if long else SHORT), cwd=tmp_path)
        counted = re.search(r"(\d+) generated, (\d+) passed", done.stdout)
        assert counted, done.stdout[-5000:]
        assert int(counted[1]) == int(counted[2]) > 10
        assert server.stop() == 0
