"""Every bad input gets the right code on both transports, and the next good request an answer."""

import io

import httpx
import numpy as np
import pytest

from edgegrasp.v1 import grasp_pb2

INVALID = {"grpc": "INVALID_ARGUMENT", "rest": "400"}
NOT_FOUND = {"grpc": "NOT_FOUND", "rest": "404"}
TOO_LARGE = {"grpc": "RESOURCE_EXHAUSTED", "rest": "413"}
OK = {"grpc": "OK", "rest": "200"}
RNG = np.random.default_rng(0)
GOOD = RNG.uniform(-0.1, 0.1, (500, 3)).astype(np.float32)


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def with_nan() -> np.ndarray:
    cloud = GOOD.copy()
    cloud[17, 1] = np.nan
    return cloud


# Name: file format, bytes, options, codes, field, part of value, part of fix.
CASES = {
    "wrong shape": (
        "npy", npy(GOOD[:, :2]), {}, INVALID, "cloud", "shape (500, 2)", "(N, 3)"
    ),
    "four axes": (
        "npy", npy(GOOD.reshape(5, 10, 10, 3)), {}, INVALID, "cloud", "shape (5, 10, 10, 3)",
        "(N, 3)",
    ),
    "NaN": ("npy", npy(with_nan()), {}, INVALID, "cloud", "row 17", "finite"),
    "infinity": (
        "npy", npy(np.where(GOOD[0, 0] == GOOD, np.inf, GOOD)), {}, INVALID, "cloud", "row 0",
        "finite",
    ),
    "empty cloud": (
        "npy", npy(GOOD[:0]), {}, INVALID, "cloud", "no points", "num_approach_points"
    ),
    "empty body": ("npy", b"", {}, INVALID, "cloud", "0 bytes", "numpy.save"),
    "millimetres": (
        "npy", npy(GOOD * 1000), {}, INVALID, "cloud", "millimetres", "divide by 1000"
    ),
    "fewer points than approach points": (
        "npy", npy(GOOD[:5]), {"num_approach_points": 6}, INVALID, "cloud",
        "5 points for num_approach_points = 6", "lower options.num_approach_points",
    ),
    "unknown model": (
        "npy", npy(GOOD), {"model": "resnet"}, NOT_FOUND, "options.model", "'resnet'", "dummy"
    ),
    "truncated npy": (
        "npy", npy(GOOD)[:-7], {}, INVALID, "cloud", "5993 bytes", "whole file"
    ),
    "truncated ply": (
        "ply",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n" + bytes(100),
        {}, INVALID, "cloud", "100 bytes of data where the PLY header promises 108", "whole file",
    ),
    "foreign bytes": ("npz", b"GIF89a" * 9, {}, INVALID, "cloud", "54 bytes", "numpy.savez"),
    "wrong dtype": (
        "npy", npy((GOOD * 1000).astype(np.int32)), {}, INVALID, "cloud", "dtype int32", "float32"
    ),
    "complex dtype": (
        "npy", npy(GOOD.astype(complex)), {}, INVALID, "cloud", "dtype complex128", "float32"
    ),
    "option out of range": (
        "npy", npy(GOOD), {"num_approach_points": 0}, INVALID, "options.num_approach_points", "0",
        "greater than or equal to 1",
    ),
    "option of no such value": (
        "npy", npy(GOOD), {"sampling": "best"}, INVALID, "options.sampling", "'best'", "'uniform'"
    ),
    "body over the limit": (
        "npy", bytes(50_000_000), {}, TOO_LARGE, "body", "bytes", "at most 33554432 bytes"
    ),
    "too many points": (
        "npy", npy(np.zeros((2_000_001, 3), np.float32)), {}, TOO_LARGE, "cloud",
        "2000001 points", "2000000",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_bad_input(name: str, raw) -> None:
    file_format, data, options, codes, field, value, fix = CASES[name]
    answer = raw.file(file_format, data, **options)
    assert answer.code == codes[raw.name]
    assert answer.field == field
    assert value in answer.value
    assert fix in answer.fix
    for part in (answer.field, answer.value, answer.fix):
        assert part in answer.detail
    assert raw.file("npy", npy(GOOD)).code == OK[raw.name]


# What only one transport can get wrong: request, field, part of value, part of fix.
JSON_CASES = {
    "wrong shape": ({"points": [[0.0, 0.0]] * 40}, "cloud", "shape (40, 2)", "(N, 3)"),
    "no rows": ({"points": [0.0, 0.0, 0.0]}, "cloud", "shape (3,)", "(N, 3)"),
    "ragged": ({"points": [[0, 0, 0], [1]]}, "points", "different lengths", "[x, y, z]"),
    "empty": ({"points": []}, "cloud", "no points", "num_approach_points"),
    "text": ({"points": [["a", "b", "c"]]}, "points", "['a', 'b', 'c']", "numbers"),
    "millimetres": ({"points": (GOOD * 1000).tolist()}, "cloud", "millimetres", "1000"),
    "too few": ({"points": GOOD[:3].tolist()}, "cloud", "3 points", "lower"),
    "no points": ({"options": {}}, "points", "nothing", "[x, y, z]"),
    "unknown field": ({"points": [], "pints": []}, "pints", "unknown", "points,"),
    "unknown option": (
        {"points": [], "options": {"sead": 1}}, "options.sead", "unknown", "seed"
    ),
    "options no object": ({"points": [], "options": [1]}, "options", "[1]", "object"),
    "unknown field of a shape": (
        {"points": [], "options": {"contact_region": {"include": [{"kind": "sphere", "r": 1}]}}},
        "options.contact_region.include.0.center", "nothing", "required",
    ),
    "unknown kind of shape": (
        {"points": [], "options": {"contact_region": {"exclude": [{"kind": "cube"}]}}},
        "options.contact_region.exclude.0", "cube", "kind",
    ),
    "two clouds": (
        {"points": GOOD.tolist(), "point_cloud2": {}}, "point_cloud2", "beside points", "one cloud"
    ),
    "text for segments": (
        {"points": GOOD.tolist(), "segment_ids": "a"}, "segment_ids", "'a'", "list"
    ),
    "fractions for segments": (
        {"points": GOOD.tolist(), "segment_ids": [0.5] * 500}, "segment_ids", "float64", "integers"
    ),
    "no object": ([1, 2], "body", "[1, 2]", "object"),
}  # fmt: skip


@pytest.mark.parametrize("name", JSON_CASES)
def test_bad_json(name: str, raw_rest) -> None:
    document, field, value, fix = JSON_CASES[name]
    answer = raw_rest.post(json=document)
    assert (answer.code, answer.field) == ("400", field)
    assert value in answer.value
    assert fix in answer.fix
    assert raw_rest.post(json={"points": GOOD.tolist()}).code == "200"


@pytest.mark.parametrize("text", [b"", b"{", b'{"points": [[0, 0, ', b"\xff\xfe", b"[" * 10_000])
def test_truncated_json(text: bytes, raw_rest) -> None:
    answer = raw_rest.post(content=text, headers={"content-type": "application/json"})
    assert (answer.code, answer.field) == ("400", "body")
    assert "no valid JSON" in answer.value


def test_json_nan(raw_rest) -> None:
    content = b'{"points": [[NaN, 0, 0], [0, 0, Infinity]]}'
    answer = raw_rest.post(content=content, headers={"content-type": "application/json"})
    assert (answer.code, answer.field) == ("400", "cloud")
    assert "2 points with NaN" in answer.value


def test_json_over_the_limit(raw_rest) -> None:
    content = b'{"points": [' + b"[0,0,0]," * 6_250_000
    answer = raw_rest.post(content=content, headers={"content-type": "application/json"})
    assert (answer.code, answer.field) == ("413", "body")
    assert answer.value == f"{len(content)} bytes"


def test_limit_holds_without_a_content_length(raw_rest) -> None:
    chunks = (bytes(1_000_000) for _ in range(50))
    answer = raw_rest.post(content=chunks, headers={"content-type": "application/x-npy"})
    assert (answer.code, answer.value) == ("413", "50000000 bytes")


def test_multipart_over_the_limit(raw_rest) -> None:
    answer = raw_rest.post(files={"cloud": ("cloud.npy", bytes(50_000_000))})
    assert (answer.code, answer.field) == ("413", "body")


@pytest.mark.parametrize("media_type", ["", "text/plain", "application/x-las", "image/png"])
def test_unread_media_type(media_type: str, raw_rest) -> None:
    answer = raw_rest.post(content=b"0 0 0", headers={"content-type": media_type})
    assert (answer.code, answer.field, answer.value) == ("415", "Content-Type", repr(media_type))
    assert "application/x-ply" in answer.fix


def test_unread_format_in_a_message(raw_grpc) -> None:
    answer = raw_grpc.file("las", b"0 0 0")
    assert (answer.code, answer.field, answer.value) == ("INVALID_ARGUMENT", "format", "'las'")


def test_query_parameters(raw_rest) -> None:
    answer = raw_rest.file("npy", npy(GOOD), sead=1)
    assert (answer.code, answer.field) == ("400", "options.sead")
    answer = raw_rest.file("npy", npy(GOOD), viewpoint="1,2")
    assert (answer.code, answer.field.rpartition(".")[0]) == ("400", "options.viewpoint")
    answer = raw_rest.file("npy", npy(GOOD), seed=[1, 2])
    assert (answer.code, answer.field, answer.value) == ("400", "options.seed", "two values")
    answer = raw_rest.post(json={"points": GOOD.tolist()}, params={"seed": 1})
    assert (answer.code, answer.field) == ("400", "seed")


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        ({"files": {"cloud": ("cloud.las", npy(GOOD))}}, "format"),
        ({"files": {"cluod": ("cloud.npy", npy(GOOD))}}, "cluod"),
        ({"files": {"options": ("o.json", b"{}", "application/json")}}, "points"),
        ({"files": [("cloud", ("a.npy", npy(GOOD))), ("cloud", ("b.npy", npy(GOOD)))]}, "cloud"),
        ({"files": {"cloud": ("a.npy", npy(GOOD))}, "data": {"options": "{"}}, "options"),
        ({"files": {"cloud": ("a.npy", npy(GOOD))}, "data": {"options": "[]"}}, "options"),
        (
            {"files": {"cloud": ("a.npy", npy(GOOD))}, "data": {"options": '{"seed": -1}'}},
            "options.seed",
        ),
        ({"content": b"--x", "headers": {"content-type": "multipart/form-data"}}, "body"),
        (
            {
                "content": b"garbage",
                "headers": {"content-type": "multipart/form-data; boundary=x"},
            },
            "body",
        ),
    ],
)
def test_bad_forms(request_: dict, field: str, raw_rest) -> None:
    answer = raw_rest.post(**request_)
    assert (answer.code[0], answer.field) == ("4", field)


def test_packed_bytes_that_are_no_points(raw_grpc) -> None:
    answer = raw_grpc.request(points=GOOD.tobytes()[:-1])
    assert (answer.code, answer.field) == ("INVALID_ARGUMENT", "points")
    assert "5999 bytes" in answer.value


def test_packed_points_over_the_limit(raw_grpc) -> None:
    answer = raw_grpc.request(points=bytes(50_000_004))
    assert (answer.code, answer.field) == ("RESOURCE_EXHAUSTED", "body")
    assert raw_grpc.request(points=GOOD.tobytes()).code == "OK"


def test_message_without_a_cloud(raw_grpc) -> None:
    answer = raw_grpc.request()
    assert (answer.code, answer.field, answer.value) == ("INVALID_ARGUMENT", "cloud", "nothing")


UNKNOWN = {
    "request": lambda message: message,
    "request.options": lambda message: message.options,
    "request.options.collision": lambda message: message.options.collision,
    "request.options.viewpoint.0": lambda message: message.options.viewpoint.add(),
    "request.options.contact_region.exclude.0": (
        lambda message: message.options.contact_region.exclude.add()
    ),
}


@pytest.mark.parametrize("field", UNKNOWN)
def test_unknown_fields_in_a_message(field: str, raw_grpc) -> None:
    unknown = b"\xfa\x3f\x01a"  # number 1023, one byte
    message = grasp_pb2.DetectGraspsRequest(points=GOOD.tobytes())
    UNKNOWN[field](message).MergeFromString(unknown)
    answer = raw_grpc.send(message)
    assert (answer.code, answer.field) == ("INVALID_ARGUMENT", field)
    assert "1023" in answer.value


def test_unknown_path_and_method(dummy_server) -> None:
    for method, path, status in (("GET", "/v1/nothing", 404), ("GET", "/v1/grasps", 405)):
        response = httpx.request(method, dummy_server.http_url + path)
        assert response.status_code == status
        assert response.headers["content-type"] == "application/problem+json"
        assert path in response.json()["detail"]
