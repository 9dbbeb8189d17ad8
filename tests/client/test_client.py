"""One API, either transport, synchronous or not: the same values and the same exceptions."""

import dataclasses
import socket
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest

import edgegrasp_client
from edgegrasp_client import (
    AsyncGraspClient,
    DeadlineError,
    Detection,
    GraspClient,
    GraspClientError,
    InvalidRequestError,
    PayloadTooLargeError,
    ProtocolError,
    ServerFailedError,
    ServerUnavailableError,
    UnknownModelError,
)


def assert_same(found: Detection, expected: Detection) -> None:
    assert len(found.grasps) == len(expected.grasps) > 0
    for ours, theirs in zip(found.grasps, expected.grasps, strict=True):
        for field in dataclasses.fields(ours):
            left, right = getattr(ours, field.name), getattr(theirs, field.name)
            np.testing.assert_array_equal(left, right)
            assert type(left) is type(right)


def test_both_transports_give_the_same_values(dummy_server, make_client, cloud) -> None:
    by_grpc = make_client(dummy_server.grpc_address).detect(cloud, seed=3)
    by_rest = make_client(dummy_server.http_url).detect(cloud, seed=3)
    assert_same(by_grpc, by_rest)
    assert (by_grpc.counts, by_grpc.model) == (by_rest.counts, "dummy")
    assert by_grpc.warnings == by_rest.warnings == ["The dummy detector made these grasps up."]
    assert by_grpc.seconds.keys() == by_rest.seconds.keys() == {"network", "total"}


def test_typed_results(client, cloud) -> None:
    grasp = client.detect(cloud).grasps[0]
    for name, shape in (
        ("T_cloud_hand", (4, 4)),
        ("T_cloud_tcp", (4, 4)),
        ("approach_point", (3,)),
        ("contact_point", (3,)),
        ("approach_direction", (3,)),
    ):
        array = getattr(grasp, name)
        assert (array.shape, array.dtype) == (shape, np.float32)
    assert isinstance(grasp.score, float)
    assert isinstance(grasp.collision_free, bool)
    np.testing.assert_allclose(grasp.T_cloud_tcp[:3, 3], grasp.contact_point)


def test_files_and_arrays_give_the_same(client, cloud, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", cloud)
    np.savez(tmp_path / "a.npz", points=cloud)
    header = "ply\nformat ascii 1.0\nelement vertex 500\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    rows = "\n".join(" ".join(map(repr, row)) for row in cloud.tolist())
    (tmp_path / "a.PLY").write_text(header + rows)
    expected = client.detect(cloud)
    for given in (cloud.astype(np.float64), np.asfortranarray(cloud), cloud[::-1][::-1]):
        assert_same(client.detect(given), expected)
    for name in ("a.npy", "a.npz", "a.PLY"):
        assert_same(client.detect(tmp_path / name), expected)
        assert_same(client.detect(str(tmp_path / name)), expected)


ALL_OPTIONS: dict[str, Any] = {
    "model": "dummy",
    "gripper": {
        "name": "mine",
        "max_opening": np.float32(0.07),
        "tip_z": 0.1,
        "contact_z": 0.09,
        "tcp_z": 0.08,
        "hand": {"boxes": [[[-0.1, -0.1, -0.1], [0.1, 0.1, 0.05]]]},
        "finger": {"boxes": np.array([[[-0.01, 0.0, 0.05], [0.01, 0.01, 0.1]]])},
        "swing": None,
    },
    "num_approach_points": np.int64(12),
    "num_candidates": 100,
    "sampling": "uniform",
    "seed": 2**62 + 1,
    "viewpoint": np.array([0.1, 0.2, 0.7], np.float32),
    "up": (0, 0, 2),
    "support": {"normal": np.array([0.0, 0.0, 1.0]), "offset": np.float32(-0.05)},
    "workspace": {"min": [-1, -1, -1], "max": (1, 1, 1)},
    "approach_region": {
        "include": [
            {"kind": "mask", "mask": np.arange(500) % 2 == 0},
            {"kind": "indices", "indices": np.arange(10)},
            {"kind": "half_space", "normal": (0, 0, 1), "offset": 0},
        ]
    },
    "contact_region": {"exclude": ({"kind": "segments", "ids": np.array([3, -1])},)},
    "approach_direction": {"cones": [{"direction": (0, 0, -1), "max_angle": 1}], "preset": None},
    "collision": {
        "mode": "penalise",
        "obstacles": [{"kind": "box", "min": [0] * 3, "max": [1] * 3}],
    },
    "min_score": 0.25,
    "top_k": 3,
    "suppression": {"translation": 0.02},
    "order": "clearance",
    "debug": True,
}


def test_every_option_goes_through(client, cloud) -> None:
    assert ALL_OPTIONS.keys() == edgegrasp_client.DetectOptions.__annotations__.keys()
    detection = client.detect(cloud, **ALL_OPTIONS)
    assert len(detection.grasps) == 3
    assert detection.counts["scored"] == 12
    alone = {name: client.detect(cloud, **{name: value}) for name, value in ALL_OPTIONS.items()}
    assert len(alone["top_k"].grasps) == 3


def test_none_is_the_default_but_for_suppression(client, cloud) -> None:
    options = dict.fromkeys(ALL_OPTIONS)
    assert_same(client.detect(cloud, **options), client.detect(cloud))


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"sead": 1}, "options.sead"),
        ({"seed": -1}, "options.seed"),
        ({"seed": 2**70}, "options.seed"),
        ({"seed": "first"}, "options.seed"),
        ({"num_approach_points": 10**6}, "options.num_approach_points"),
        ({"sampling": "best"}, "options.sampling"),
        ({"viewpoint": [np.nan, 0.0, 0.0]}, "options.viewpoint"),
        ({"viewpoint": [0.0, 0.0]}, "options.viewpoint"),
        ({"viewpoint": 3.0}, "options.viewpoint"),
        ({"up": [0, 0, 0]}, "options"),
        ({"support": {"normal": [0, 0, 2], "offset": 0.0}}, "options.support"),
        ({"workspace": {"min": [0, 0, 0], "max": [1, 1, 1], "mid": 3}}, "options.workspace.mid"),
        ({"workspace": {"min": [1, 0, 0], "max": [0, 1, 1]}}, "options.workspace"),
        ({"workspace": [1, 2]}, "options.workspace"),
        ({"support": {"kind": "ransac", "distance": 0.0}}, "options.support.distance"),
        ({"support": {"kind": "cylinder"}}, "options.support"),
        ({"approach_region": {"include": [{"kind": "cube"}]}}, "options.approach_region.include.0"),
        ({"approach_region": [{"kind": "mask", "mask": [True]}]}, "options.approach_region"),
        (
            {"contact_region": {"include": [{"kind": "indices", "indices": [0, -1]}]}},
            "options.contact_region.include.0.indices.1",
        ),
        (
            {"contact_region": {"exclude": [{"kind": "sphere", "center": [0] * 3, "radius": -1}]}},
            "options.contact_region.exclude.0.radius",
        ),
        ({"approach_direction": {}}, "options.approach_direction"),
        ({"approach_direction": {"preset": "up"}}, "options.approach_direction.preset"),
        ({"collision": "dodge"}, "options.collision"),
        ({"collision": {"margin": 1.0}}, "options.collision.margin"),
        ({"gripper": {"max_opening": 0.1}}, "options.gripper.tip_z"),
        ({"gripper": [7]}, "options.gripper"),
        ({"viewpoint": [[0, 0, 1], [0, 0]]}, "options.viewpoint"),
        ({"order": "best"}, "options.order"),
        ({"suppression": {"rotation": -1.0}}, "options.suppression.rotation"),
        ({"min_score": 1.5}, "options.min_score"),
        ({"top_k": 0}, "options.top_k"),
    ],
)
def test_bad_options(options: dict[str, Any], field: str, client, cloud) -> None:
    with pytest.raises(InvalidRequestError) as caught:
        client.detect(cloud, **options)
    error = caught.value
    assert error.field.startswith(field)
    assert error.value
    assert error.fix
    assert str(error) == f"{error.field}: got {error.value}. {error.fix}"


@pytest.mark.parametrize(
    ("given", "value"),
    [
        (np.zeros((40, 2), np.float32), "shape (40, 2)"),
        (np.zeros((40, 3), np.int64), "dtype int64"),
        (np.full((40, 3), np.nan), "40 points with NaN"),
        (np.full((40, 3), 1e300), "40 points with NaN or infinity"),
        (np.zeros((0, 3)), "no points"),
        (np.zeros((3, 3)), "3 points for num_approach_points"),
        (np.zeros((40, 3), dtype=object), "dtype object"),
        ([[0.0, 0.0, 0.0]], "a list"),
        ("cloud.las", "'cloud.las'"),
        ("absent.npy", "absent.npy (No such file or directory)"),
    ],
)
def test_bad_clouds(given: Any, value: str, client) -> None:
    with pytest.raises(InvalidRequestError) as caught:
        client.detect(given)
    assert caught.value.field == "cloud"
    assert value in caught.value.value


def test_unknown_model(client, cloud) -> None:
    with pytest.raises(UnknownModelError) as caught:
        client.detect(cloud, model="resnet")
    assert (caught.value.field, caught.value.value) == ("options.model", "'resnet'")


@pytest.mark.parametrize("size", [4_200_000, 9_000_000])  # the latter is over what gRPC reads
def test_too_large(size: int, client) -> None:
    with pytest.raises(PayloadTooLargeError):
        client.detect(np.zeros((size, 3), np.float32))
    assert client.ready()


def test_models_and_readiness(client) -> None:
    (model,) = client.models()
    assert (model.name, model.default, model.gripper) == ("dummy", True, "panda")
    assert client.ready()
    client.wait_until_ready(5)


@pytest.fixture
def closed_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as closing:
        return int(closing.getsockname()[1])


@pytest.mark.parametrize("scheme", ["", "http://"])
def test_no_server(scheme: str, closed_port: int, make_client, cloud) -> None:
    client = make_client(f"{scheme}127.0.0.1:{closed_port}")
    for call in (client.models, lambda: client.detect(cloud)):
        with pytest.raises(ServerUnavailableError):
            call()
    assert not client.ready()
    with pytest.raises(DeadlineError, match=r"not ready within 0\.2 s"):
        client.wait_until_ready(0.2)


@pytest.fixture(scope="module")
def slow_server(start_server):
    with start_server("--backend", "dummy", "--dummy-seconds", "0.5") as server:
        yield server


@pytest.mark.parametrize("transport", ["grpc", "rest"])
def test_deadline(transport: str, slow_server, make_client, cloud) -> None:
    client = make_client(slow_server.address(transport), timeout=0.1)
    with pytest.raises(DeadlineError):
        client.detect(cloud)
    assert client.detect(cloud, timeout=20).grasps


def answering(status: int, **content: Any) -> httpx.MockTransport:
    return httpx.MockTransport(lambda request: httpx.Response(status, **content))


def problem(kind: str) -> dict[str, Any]:
    told = {"detail": "d", "field": "f", "value": "v", "fix": "x"}
    return {"type": f"urn:edgegrasp:error:{kind}", **told}


@pytest.mark.parametrize(
    ("transport", "expected"),
    [
        (answering(200, text="<html>"), ProtocolError),
        (answering(200, json=[]), ProtocolError),
        (answering(200, json={"grasps": [{}]}), ProtocolError),
        (answering(404, json={"detail": "Not Found"}), ProtocolError),
        (answering(418, json=problem("teapot")), ProtocolError),
        (answering(413, text="nginx"), PayloadTooLargeError),
        (answering(502, text="nginx"), ServerUnavailableError),
        (answering(503, json=problem("not-ready")), ServerUnavailableError),
        (answering(500, json=problem("detector-failed")), ServerFailedError),
        (answering(400, json=problem("invalid-request")), InvalidRequestError),
    ],
)
def test_answers_of_other_servers(
    transport: httpx.MockTransport, expected: type, make_client, cloud
) -> None:
    client = make_client("http://elsewhere", http_transport=transport)
    with pytest.raises(expected) as caught:
        client.detect(cloud)
    assert type(caught.value) is expected
    if expected is InvalidRequestError:
        assert vars(caught.value) == {"field": "f", "value": "v", "fix": "x"}


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (grpc.StatusCode.UNIMPLEMENTED, ProtocolError),
        (grpc.StatusCode.RESOURCE_EXHAUSTED, PayloadTooLargeError),
        (grpc.StatusCode.UNAVAILABLE, ServerUnavailableError),
        (grpc.StatusCode.DEADLINE_EXCEEDED, DeadlineError),
        (grpc.StatusCode.INTERNAL, ServerFailedError),
    ],
)
def test_statuses_without_a_description(code: grpc.StatusCode, expected: type) -> None:
    from edgegrasp_client.grpc_wire import error_from_call

    error = grpc.aio.AioRpcError(code, grpc.aio.Metadata(), grpc.aio.Metadata(), "why")
    assert type(error_from_call(error)) is expected
    assert str(error_from_call(error)) == f"{code.name}: why"
    garbled = grpc.aio.Metadata(("edgegrasp-error-bin", b"\xff\xff"))
    error = grpc.aio.AioRpcError(code, grpc.aio.Metadata(), garbled, "why")
    assert type(error_from_call(error)) is expected


def test_another_grpc_server(make_client, cloud) -> None:
    from concurrent.futures import ThreadPoolExecutor

    server = grpc.server(ThreadPoolExecutor(1))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    client = make_client(f"127.0.0.1:{port}")
    with pytest.raises(ProtocolError, match="UNIMPLEMENTED"):
        client.detect(cloud)
    assert not client.ready()
    server.stop(0).wait()


def test_injected_channel_stays_open(dummy_server, cloud) -> None:
    with grpc.insecure_channel(dummy_server.grpc_address) as channel:
        for _ in range(2):
            with GraspClient(channel=channel) as client:
                assert client.detect(cloud).grasps


async def test_async_context_manager(dummy_server, cloud) -> None:
    import asyncio

    for address in (dummy_server.grpc_address, dummy_server.http_url):
        async with AsyncGraspClient(address) as client:
            detections = await asyncio.gather(*(client.detect(cloud, seed=s) for s in range(8)))
        assert len({tuple(d.grasps[0].contact_point) for d in detections}) > 1
        with GraspClient(address) as sync:
            for seed, detection in enumerate(detections):
                assert_same(detection, sync.detect(cloud, seed=seed))


def test_every_exception_is_exported_and_documented() -> None:
    from edgegrasp_client import errors

    for name, kind in vars(errors).items():
        if isinstance(kind, type) and issubclass(kind, GraspClientError):
            assert getattr(edgegrasp_client, name) is kind
            assert name in (errors.__doc__ or "")


def test_both_clients_have_the_same_methods() -> None:
    import inspect

    for name, method in inspect.getmembers(GraspClient, inspect.isfunction):
        if not name.startswith("_") or name == "__init__":
            twin = getattr(AsyncGraspClient, name)
            ours, theirs = inspect.signature(method), inspect.signature(twin)
            assert list(ours.parameters) == list(theirs.parameters)
            assert method.__doc__ == twin.__doc__
