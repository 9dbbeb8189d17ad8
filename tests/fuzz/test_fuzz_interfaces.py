"""Whatever another protocol brings, its server answers or says what is wrong."""

import asyncio
import contextlib
import json
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st
from mcp.server.mcpserver.exceptions import ToolError, UnexpectedToolError

from edgegrasp.oip import open_inference_pb2 as messages
from edgegrasp_cli import mcp, open_inference
from edgegrasp_client import GraspClientError
from edgegrasp_client.requests import cloud_file, depth_image_fields

from .conftest import POINTS, VALUES, changed, mutated


class Client:
    """A client that checks what it is to send, as the real one does, and finds no grasp."""

    def detect(self, cloud: Any = None, depth_images: Any = (), **options: Any) -> Any:
        if cloud is not None:
            cloud_file(cloud)
        for number, image in enumerate(depth_images):
            depth_image_fields(image, number)
        nothing: dict[str, Any] = {name: [] for name in ("grasps", "objects", "warnings")}
        return SimpleNamespace(**nothing, model="none", counts={}, up=[0.0, 0.0, 1.0])


MODELS = open_inference.Models(Client(), "grasps", 1.0)
TENSOR = {"name": "points", "datatype": "FP32", "shape": [40, 3], "data": POINTS.tolist()}
INFER = {
    "id": "1", "inputs": [TENSOR], "outputs": [{"name": "score"}],
    "parameters": {"top_k": 3, "timeout": 1000000, "up": "[0, 0, 1]"},
}  # fmt: skip
BESIDE = {"data": None, "parameters": {"binary_data_size": 480}}  # the numbers follow the JSON
BINARY = json.dumps({"inputs": [TENSOR | BESIDE]}).encode()


def infer(body: bytes, header: str | None = None) -> None:
    with refused():
        json.dumps(open_inference._http_infer(MODELS, "grasps", bytearray(body), header)).encode()


@contextlib.contextmanager
def refused() -> Iterator[None]:
    """What is inside may be refused as the caller's fault."""
    try:
        yield
    except GraspClientError as error:
        _, status, why = open_inference.refusal(error)
        assert 400 <= status < 500
        assert why.encode()


@given(changed(INFER) | VALUES)
def test_changed_inference_requests_are_answered_or_refused(document: Any) -> None:
    infer(json.dumps(document, default=lambda data: data.decode("latin-1")).encode())


@given(
    mutated([BINARY + POINTS.tobytes()]), st.sampled_from([str(len(BINARY)), "-1", "x", "9" * 9])
)
def test_mutated_binary_tensors_are_answered_or_refused(content: bytes, header: str) -> None:
    infer(content, header)


MESSAGE = messages.ModelInferRequest(
    model_name="grasps",
    inputs=[{"name": "points", "datatype": "FP32", "shape": [40, 3]}],
    raw_input_contents=[POINTS.tobytes()],
    parameters={"top_k": {"int64_param": 3}},
).SerializeToString()


@given(mutated([MESSAGE]))
def test_mutated_inference_messages_are_answered_or_refused(content: bytes) -> None:
    with refused(), contextlib.suppress(DecodeError):
        request = messages.ModelInferRequest.FromString(content)
        open_inference._grpc_infer(MODELS, request, SimpleNamespace(time_remaining=lambda: 1.0))


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The tools of a folder with a cloud, a depth image, a mask and a file that is none."""
    folder = tmp_path_factory.mktemp("agent")
    np.save(folder / "cloud.npy", POINTS)
    np.save(folder / "depth.npy", np.full((4, 6), 500, np.uint16))
    np.save(folder / "mask.npy", np.eye(4, 6, dtype=np.uint8))
    (folder / "junk.npy").write_bytes(b"\x93NUMPY\x01\x00")
    return mcp.grasp_tools(Client(), folder)  # type: ignore[arg-type]


FILES = [f"{name}.npy" for name in ("cloud", "depth", "mask", "junk")]
NAMES = [*FILES, "../x", "/etc/passwd", ".", "\0", "x" * 300]
ARGUMENTS = {
    "generate_grasps_from_point_cloud": {
        "point_cloud_file": "cloud.npy", "num_grasps": 3, "viewpoint": [0, 0, 1],
        "options": {"seed": 1},
    },
    "generate_grasps_from_depth": {
        "depth_file": "depth.npy", "intrinsics": [6.0, 6.0, 2.5, 1.5], "mask_file": "mask.npy",
        "depth_scale": 0.001, "T_base_camera": np.eye(4).tolist(), "options": {"near": [0, 0, 1]},
    },
}  # fmt: skip


@given(st.data())
def test_changed_arguments_of_an_agent_are_answered_or_refused(tools, data) -> None:
    name = data.draw(st.sampled_from(sorted(ARGUMENTS)))
    arguments = data.draw(changed(ARGUMENTS[name]))
    for field in ("point_cloud_file", "depth_file", "mask_file"):
        if field in arguments and data.draw(st.booleans()):
            arguments[field] = data.draw(st.sampled_from(NAMES))
    refusal: ToolError | None = None
    try:
        asyncio.run(tools.call_tool(name, arguments))
    except ToolError as error:
        refusal = error
    assert not isinstance(refusal, UnexpectedToolError), refusal.__cause__
    assert "agent0" not in str(refusal)  # the folder's own path
