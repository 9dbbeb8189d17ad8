"""The gateway as others see it: Triton's client, and plain JSON."""

import importlib.util
import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from tests.programs import EDGEGRASP, free_ports, run, started

pytest.importorskip("uvicorn", reason="the extra `open-inference` is not installed")

import uvicorn

from edgegrasp.oip import open_inference_pb2 as messages
from edgegrasp_cli.open_inference import MAX_BODY_BYTES, Models, grpc_server, http_app, refusal
from edgegrasp_client import GraspClient, GraspClientError


@pytest.fixture(scope="module")
def gateway(dummy_server) -> Iterator[dict[str, str]]:
    """Addresses of a gateway in this process, by transport."""
    with GraspClient(dummy_server.grpc_address) as client:
        models = Models(client, "grasps", 60.0)
        config = uvicorn.Config(http_app(models), port=0, log_level="error")
        server = uvicorn.Server(config)
        bound = config.bind_socket()
        bound.listen()  # what connects before the thread runs waits, and is not refused
        thread = threading.Thread(target=server.run, args=([bound],))
        thread.start()
        with grpc_server(models, "127.0.0.1:0") as port:
            yield {"http": f"127.0.0.1:{bound.getsockname()[1]}", "grpc": f"127.0.0.1:{port}"}
        server.should_exit = True
        thread.join()
        bound.close()


def post(gateway: dict[str, str], body: Any, model: str = "grasps") -> httpx.Response:
    url = f"http://{gateway['http']}/v2/models/{model}/infer"
    content = body if isinstance(body, bytes) else json.dumps(body)
    return httpx.post(url, content=content, timeout=60)


def infer(channel: grpc.Channel) -> Any:
    name = "/inference.GRPCInferenceService/ModelInfer"
    kinds = messages.ModelInferRequest.SerializeToString, messages.ModelInferResponse.FromString
    return channel.unary_unary(name, *kinds)


def points_of(cloud: np.ndarray, **changes: Any) -> dict[str, Any]:
    tensor = {"name": "points", "datatype": "FP32", "shape": cloud.shape, "data": cloud.tolist()}
    return {"inputs": [tensor | changes]}


@pytest.mark.parametrize("transport", ["http", "grpc"])
@pytest.mark.parametrize("kind", ["points", "depth"])
def test_tritons_client_gets_grasps(gateway, transport, kind, cloud, tmp_path, dummy_server):
    for module in ("tritonclient", "geventhttpclient"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed")
    file = tmp_path / "inputs.npz"
    depth = np.random.default_rng(0).integers(500, 600, (24, 32)).astype(np.uint16)
    camera = np.array([60.0, 60.0, 15.5, 11.5], np.float32)
    tensors = {"points": cloud} if kind == "points" else {"depth": depth, "intrinsics": camera}
    np.savez(file, **tensors)
    script = Path(__file__).with_name("triton_client.py")
    command = [sys.executable, "-P", script, transport, gateway[transport], "grasps", file]
    told = json.loads(run(*command).stdout)
    assert told["health"] == [True, True, True]
    assert told["alone"] == [True, True]
    assert told.get("models", ["grasps", "dummy"]) == ["grasps", "dummy"]
    assert [t["name"] for t in told["inputs"]] == ["points", "depth", "intrinsics"]
    with GraspClient(dummy_server.grpc_address) as ours:
        images = [{"depth": depth, "intrinsics": camera}]
        sent = {"cloud": cloud} if kind == "points" else {"depth_images": images}
        expected = ours.detect(**sent, top_k=4, up=[0, 0, 1]).grasps
    assert len(told["score"]) == 4
    for name in ("T_cloud_hand", "score", "width"):
        np.testing.assert_allclose(told[name], [getattr(g, name) for g in expected], atol=1e-6)


def test_a_request_in_json(gateway, cloud) -> None:
    body = points_of(cloud) | {"id": "a", "parameters": {"top_k": 2, "seed": 3}}
    answer = post(gateway, body).json()
    assert (answer["id"], answer["model_name"]) == ("a", "grasps")
    shapes = {tensor["name"]: tensor["shape"] for tensor in answer["outputs"]}
    assert shapes == {"T_cloud_hand": [2, 4, 4], "score": [2], "width": [2], "object": [2]}
    assert answer["parameters"]["model"] == "dummy"
    assert post(gateway, body, "dummy").json()["outputs"] == answer["outputs"]
    base = f"http://{gateway['http']}/v2"
    assert httpx.get(base).json()["name"] == "edgegrasp"
    assert httpx.get(f"{base}/models/dummy").json()["platform"] == "edgegrasp"
    assert httpx.get(f"{base}/models/dummy/ready").json() == {"name": "dummy", "ready": True}
    assert httpx.get(f"{base}/models/dummy/versions/1").json()["name"] == "dummy"
    assert httpx.get(f"{base}/models/dummy/versions/2").status_code == 404
    assert httpx.get(f"{base}/models").json() == {"models": ["grasps", "dummy"]}
    unknown = post(gateway, body | {"outputs": [{"name": "pose"}]})
    assert unknown.status_code == 400
    assert "outputs: got pose" in unknown.json()["error"]


def test_a_tensor_that_is_there_twice_is_refused(gateway, cloud) -> None:
    body = points_of(cloud)
    body["inputs"] *= 2
    assert "there twice" in post(gateway, body).json()["error"]
    request = messages.ModelInferRequest(model_name="grasps")
    for _ in range(2):
        request.inputs.add(name="points", datatype="FP32", shape=[0, 3])
    channel = grpc.insecure_channel(gateway["grpc"])
    with channel, pytest.raises(grpc.RpcError, match="points twice"):
        infer(channel)(request)


@pytest.mark.parametrize(
    ("changes", "model", "status", "told"),
    [
        ({"name": "cloud"}, "grasps", 400, "inputs: got cloud. Send points, or depth"),
        ({"datatype": "BYTES"}, "grasps", 400, "inputs.points: got a datatype BYTES"),
        ({"shape": [7, 3]}, "grasps", 400, "inputs.points: got cannot reshape"),
        ({"data": [[1, 2], [3]]}, "grasps", 400, "inputs.points"),
        ({"data": None}, "grasps", 400, "body: got KeyError: 'parameters'"),
        ({}, "resnet", 404, "resnet"),
        ({"datatype": "INT32"}, "grasps", 400, "values that INT32 does not hold"),
        (b"{", "grasps", 400, "Give the JSON"),
        (b"\xff" * 9000, "grasps", 400, "Inference-Header-Content-Length"),
        (b'{"id": NaN, "inputs": []}', "grasps", 400, "not JSON compliant"),
        (b"[" * 100_000, "grasps", 400, "Give the JSON"),
        (b"[" + b"[]," * 60_000, "grasps", 400, "Give the JSON"),
        ({"name": 7}, "grasps", 400, "not text"),
        ({"parameters": [1]}, "grasps", 400, "Give the JSON"),
        ({"parameters": {"seed": "[" * 20_000}}, "grasps", 400, "options.seed"),
        ({"id": "\ud800"}, "grasps", 400, "Give the JSON"),
        ({"name": "\ud800"}, "grasps", 400, "inputs: got"),
        (b" " * (MAX_BODY_BYTES + 1), "grasps", 413, "33,554,432 bytes"),
        ({"parameters": {"seed": -1}}, "grasps", 400, "options.seed: got -1."),
    ],
)
def test_what_cannot_be_served(gateway, cloud, changes, model, status, told) -> None:
    body: Any = changes
    if isinstance(changes, dict):
        top = {name: changes.pop(name) for name in ("parameters", "id") if name in changes}
        body = points_of(cloud, **changes) | top
    answer = post(gateway, body, model)
    assert answer.status_code == status, answer.text
    assert told in answer.json()["error"]
    assert len(answer.content) < 1000


def test_two_gateways_do_not_share_a_port(gateway) -> None:
    with pytest.raises(OSError, match="cannot listen"), grpc_server(Any, gateway["grpc"]):
        pass


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_command_serves_both_transports(dummy_server, host: str) -> None:
    if ":" in host and not socket.has_dualstack_ipv6():
        pytest.skip("this machine has no IPv6")
    ports, url = [str(port) for port in free_ports(2)], f"[{host}]" if ":" in host else host
    flags = ["--server", dummy_server.grpc_address, "--host", host]
    flags += ["--http-port", ports[0], "--grpc-port", ports[1]]
    with started(*EDGEGRASP, "open-inference", *flags):
        with httpx.Client(transport=httpx.HTTPTransport(retries=10)) as http:
            ready = http.get(f"http://{url}:{ports[0]}/v2/health/ready", timeout=60)
        assert ready.json() == {"ready": True}
        socket.create_connection((host, int(ports[1]))).close()


def test_calls_are_answered_before_it_stops(start_dummy, cloud) -> None:
    ports = [str(port) for port in free_ports(2)]
    body = points_of(cloud)["inputs"][0]
    request = messages.ModelInferRequest(model_name="default")
    request.inputs.add(name="points", datatype="FP32", shape=body["shape"])
    request.raw_input_contents.append(cloud.astype("<f4").tobytes())
    with start_dummy(seconds=2.0) as server:
        flags = ["--server", server.grpc_address, "--http-port", ports[0], "--grpc-port", ports[1]]
        with started(*EDGEGRASP, "open-inference", *flags) as gateway:
            with grpc.insecure_channel(f"127.0.0.1:{ports[1]}") as channel:
                grpc.channel_ready_future(channel).result(60)
                with httpx.Client(transport=httpx.HTTPTransport(retries=10)) as http:
                    http.get(f"http://127.0.0.1:{ports[0]}/v2/health/live", timeout=60)
                asked = infer(channel).future(request)
                time.sleep(1.0)
                gateway.terminate()
                assert asked.result().raw_output_contents
            assert gateway.wait(30) == 0


def test_a_server_that_is_away() -> None:
    with GraspClient("127.0.0.1:1", timeout=0.2, retry=False) as client:
        models = Models(client, "grasps", 0.2)
        assert not models.ready()
        with pytest.raises(GraspClientError) as caught:
            models.require("grasps")
        assert refusal(caught.value)[:2] in (("UNAVAILABLE", 503), ("DEADLINE_EXCEEDED", 504))
