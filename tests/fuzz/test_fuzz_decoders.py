"""Whatever comes in, a decoder gives arrays or a 4xx, within memory that the bytes explain."""

import base64
import json
import re
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.checks import bounded_memory
from tests.cloud_files import depth_image, npy, npz, pcd, ply, png, point_cloud2, xyz
from tests.many_options import MANY
from tests.programs import run
from tests.service.worker.conftest import ask as ask_worker
from tests.service.worker.conftest import check_problem, form, part

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.request_cloud import GIVEN, PER_POINT, File, decode_cloud
from edgegrasp_model.scene.cloud import check_cloud
from edgegrasp_service.errors import to_problem
from edgegrasp_service.settings import Settings

from .conftest import NUMBERS, POINTS, VALUES, changed, mutated

MAX_POINTS = 5000
FILES: dict[str, list[bytes]] = {
    "npy": [
        npy(POINTS), npy(POINTS.astype(">f8")), npy(np.asfortranarray(POINTS)),
        npy(POINTS.reshape(5, 8, 3)), npy(np.zeros((0, 3))), npy(np.zeros(3, "i4,f8")),
    ],
    "npz": [
        npz(False, points=POINTS), npz(points=POINTS, normals=POINTS),
        npz(points=POINTS, segment_ids=np.arange(40), colors=POINTS),
    ],
    "ply": [ply(POINTS, kind) for kind in ("ascii", "binary_little_endian", "binary_big_endian")],
    "pcd": [
        *(pcd(POINTS, kind) for kind in ("ascii", "binary", "binary_compressed")),
        pcd(POINTS, height=4),
    ],
    "xyz": [xyz(POINTS), b"# c\n0 0 0\n"],
}  # fmt: skip


@contextmanager
def decoding(size: int) -> Iterator[None]:
    """Of `size` bytes; anything but an answer or an error of the table fails."""
    # Text costs most: a list and an object for each word; files unpack to five arrays at most.
    allowed = 200 * size + 5 * (48 * MAX_POINTS + 65536) + 2**20
    with bounded_memory(allowed), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except EdgeGraspError as error:
            check_problem(to_problem(error))


def decode(size: int, **fields: Any) -> None:
    with decoding(size):
        check_cloud(decode_cloud(fields, DetectOptions(), MAX_POINTS), 32)


@pytest.mark.parametrize("file_format", FILES)
@given(st.data())
def test_mutated_files_decode_or_are_refused(file_format: str, data: st.DataObject) -> None:
    content = data.draw(mutated(FILES[file_format]) | st.binary(max_size=200))
    decode(len(content), cloud=File(file_format, content))


PNG = png(np.arange(400, 800, dtype=np.uint16).reshape(20, 20))
PNG_CHUNKS = [PNG[8:33], PNG[33:-12], PNG[-12:]]  # IHDR, IDAT, IEND
PNG_CHUNKS += [bytes(4) + kind + bytes(4) for kind in (b"tRNS", b"iCCP", b"zTXt", b"acTL", b"gAMA")]


@given(mutated([PNG]))
def test_mutated_images_decode_or_are_refused(content: bytes) -> None:
    depth = File("png", content)
    decode(len(content), depth_images=[{"depth": depth, "intrinsics": [30.0, 30.0, 9.5, 9.5]}])
    decode(len(content), points=POINTS.tobytes(), colors=depth)


@given(st.lists(st.tuples(st.sampled_from(PNG_CHUNKS), st.none() | st.binary(max_size=40))))
def test_images_of_arbitrary_chunks_decode_or_are_refused(chunks) -> None:
    """Chunks whose sums are right, and which say what they like."""
    content = PNG[:8]
    for original, data in chunks:
        body = original[4:8] + (original[8:-4] if data is None else data)
        content += struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    decode(len(content), points=POINTS.tobytes(), colors=File("png", content))


DEPTH = np.linspace(0.4, 0.5, 40, dtype="<f4").reshape(5, 8)
DEPTH_IMAGE = depth_image(DEPTH, 20.0, 20.0, 3.5, 2.0)
DEPTH_ROWS = DEPTH_IMAGE | {"depth": DEPTH.tolist()}
POINT_CLOUD2 = point_cloud2(POINTS)
MESSAGES = [
    grasp_pb2.DetectGraspsRequest(points=POINTS.tobytes(), options={"seed": 3, "top_k": 2}),
    grasp_pb2.DetectGraspsRequest(encoded={"format": "ply", "data": FILES["ply"][0]}),
    grasp_pb2.DetectGraspsRequest(point_cloud2=POINT_CLOUD2, segment_ids=bytes(160)),
    grasp_pb2.DetectGraspsRequest(
        depth_images=[DEPTH_IMAGE | {"T_cloud_camera": np.eye(4).ravel().tolist()}],
        options={
            "up": {"z": 1.0},
            "collision": {"mode": "avoid", "obstacles": [{"box": {"min": {}, "max": {"x": 1}}}]},
            "contact_region": {"exclude": [{"sphere": {"center": {}, "radius": 1.0}}]},
            "gripper": {"geometry": {"max_opening": 0.08, "hand": {"boxes": [{}]}}},
        },
    ),
    grasp_pb2.ScoreGraspsRequest(
        points=POINTS.tobytes(), edges=[{"approach_index": 1}], hand_poses=[{}]
    ),
]
MASK = {"kind": "mask", "mask": []}
OPTIONS = MANY | {"suppression": None, "contact_region": {"exclude": [MASK]}}
FORM = form(
    part("cloud", FILES["npy"][0], '; filename="c.npy"\r\nContent-Type: application/x-npy'),
    part("options", b'{"seed": 3}', "\r\nContent-Type: application/json"),
    part("segment_ids", b"[%s0]" % (b"0, " * 39)),
)

THREE = st.lists(NUMBERS | st.none(), min_size=3, max_size=3)
LISTS = st.one_of(
    VALUES,
    st.lists(THREE, min_size=1, max_size=40),
    st.lists(st.lists(THREE, min_size=2, max_size=2), min_size=1, max_size=4),
)


def in_base64(fields: dict[str, Any]) -> dict[str, Any]:
    """As JSON has the data of an image or a cloud."""
    return fields | {"data": base64.b64encode(fields["data"]).decode()}


SETTINGS = Settings(max_points=MAX_POINTS)
DOCUMENTS = {
    "points": POINTS.tolist(),
    "point_cloud2": in_base64(POINT_CLOUD2),
    "depth_images": [DEPTH_IMAGE | {"depth": in_base64(DEPTH_IMAGE["depth"])}],
}
BESIDE = {"edges": [[0, 1], [2, 3]], "hand_poses": [np.eye(4).tolist()], "options": OPTIONS}


def ask(transport: str, body: bytes, scores: bool, media_type: str = "", query: str = "") -> None:
    """Ask, within memory; anything but an answer or an error of the caller's fails."""
    with decoding(len(body) + len(query)):
        ask_worker(transport, body, media_type, query, scores, SETTINGS)


@given(mutated([message.SerializeToString() for message in MESSAGES]), st.booleans())
def test_mutated_messages_decode_or_are_refused(content: bytes, scores: bool) -> None:
    ask("grpc", content, scores)


@given(
    st.sampled_from(sorted(DOCUMENTS)).flatmap(
        lambda name: changed({name: DOCUMENTS[name]} | BESIDE)
    )
    | st.fixed_dictionaries({"depth_images": st.lists(changed(DEPTH_ROWS), max_size=2)})
    | st.fixed_dictionaries(
        {"points": st.just(POINTS.tolist()) | LISTS},
        optional=dict.fromkeys((*PER_POINT, "edges"), LISTS) | {"options": VALUES},
    )
    | VALUES,
    st.booleans(),
)
def test_changed_json_decode_or_are_refused(document: Any, scores: bool) -> None:
    if isinstance(document, dict) and not scores:
        document = {name: document[name] for name in document if name not in GIVEN}
    content = json.dumps(document, default=lambda data: data.decode("latin-1"))
    ask("http", content.encode(), scores, "application/json")


@given(
    mutated([FORM]), st.sampled_from(["b", '"b"', "b; x=y", "x", '"', "b'\ud800"]), st.booleans()
)
def test_mutated_forms_decode_or_are_refused(content: bytes, boundary: str, scores: bool) -> None:
    ask("http", content, scores, f"multipart/form-data; boundary={boundary}")


@pytest.mark.parametrize("file_format", FILES)
@given(data=st.data())
def test_mutated_arrays_to_score_decode_or_are_refused(file_format, data) -> None:
    cloud = part("cloud", FILES[file_format][0], f'; filename="a.{file_format}"')
    arrays = [*FILES["npy"], npy(np.array(3)), npy(np.array([[0, 1]])), npy(np.eye(4)[None])]
    name = data.draw(st.sampled_from(["edges", "hand_poses"]))
    array = data.draw(mutated(arrays) | st.sampled_from(arrays))
    body = form(cloud, part(name, array, '; filename="a.npy"'))
    ask("http", body, True, "multipart/form-data; boundary=b")


WORDS = st.text(max_size=12) | st.sampled_from(["[" * 5000, "1,,2", "{", "1e999,0,0", "%F0"])


@given(
    st.lists(st.tuples(st.sampled_from([*DetectOptions.model_fields, "x"]), WORDS), max_size=3),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=40),
)
def test_arbitrary_queries_and_media_types_decode_or_are_refused(items, media_type) -> None:
    query = "&".join(f"{name}={text}" for name, text in items)
    for kind in ("application/x-npy", media_type):
        ask("http", FILES["npy"][0], False, kind, query)


def test_what_is_mutated_is_good() -> None:
    good = [("multipart/form-data; boundary=b", FORM)]
    good += [("application/json", json.dumps({k: v}).encode()) for k, v in DOCUMENTS.items()]
    for media_type, content in good:
        assert ask_worker("http", content, media_type, settings=SETTINGS).error is None
    for file_format in FILES:
        for content in FILES[file_format]:
            decode_cloud({"cloud": File(file_format, content)}, DetectOptions(), MAX_POINTS)


MAX_GROWTH = 100e6  # bytes; a request here is a few kB
PATIENCE = 20
REFUSED = {grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND}
ANSWERS = REFUSED | {grpc.StatusCode.OK, grpc.StatusCode.RESOURCE_EXHAUSTED}


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
        assert method.future(content).code() in REFUSED


SHORT = ("--phases", "fuzzing", "--max-examples", "5")
LONG = ("--phases", "coverage,fuzzing", "--max-examples", "100", "--max-time", "120")
CHECKS = "not_a_server_error,unsupported_method,status_code_conformance,content_type_conformance"
CHECKS += ",response_headers_conformance,response_schema_conformance"


def test_the_server_keeps_to_its_document(start_dummy, tmp_path: Path) -> None:
    program = Path(sys.executable).parent / "schemathesis"
    if not program.exists():
        pytest.skip("schemathesis is not installed")
    long = settings.get_current_profile_name() == "fuzz"
    token = "fuzz-0123456789abcdef0123456789abcdef"
    file = tmp_path / "tokens"
    file.write_text(token)
    with start_dummy("--log-level", "error", "--admin-token-file", str(file)) as server:
        command = [program, "run", f"{server.http_url}/openapi.json", "--no-color", "--seed", "1"]
        command += ["--header", f"Authorization: Bearer {token}"]
        # What the document allows may be shorter than any answer takes: a 504 is no fault.
        command += ["--header", "X-Request-Timeout: 60", "--request-timeout", "60"]
        command += ["--suppress-health-check", "too_slow"]  # of a busy machine
        done = run(*command, "--checks", CHECKS, *(LONG if long else SHORT), cwd=tmp_path)
        counted = re.search(r"(\d+) generated, (\d+) passed", done.stdout)
        assert counted, done.stdout[-5000:]
        assert int(counted[1]) == int(counted[2]) > 10
        assert server.stop() == 0
