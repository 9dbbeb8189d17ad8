"""Whatever comes in, a decoder gives arrays or a 4xx, within memory that the bytes explain."""

import json
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from tests.cloud_files import npy, png
from tests.service.worker.conftest import ask as ask_worker
from tests.service.worker.conftest import form, part

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.request_cloud import GIVEN, PER_POINT, File, decode_cloud
from edgegrasp_model.scene.cloud import check_cloud
from edgegrasp_service.settings import Settings

from .conftest import (
    DEPTH_IMAGE,
    DEPTH_ROWS,
    FILES,
    LISTS,
    POINT_CLOUD2,
    POINTS,
    VALUES,
    base64_of,
    changed,
    decodes_or_refuses,
    given,
    mutated,
)

MAX_POINTS = 5000


def decode(size: int, **fields: Any) -> None:
    def work() -> None:
        cloud, _ = decode_cloud(fields, DetectOptions(), MAX_POINTS)
        check_cloud(cloud, 32)

    decodes_or_refuses(work, size, MAX_POINTS)


@pytest.mark.parametrize("file_format", FILES)
@given(st.data())
def test_mutated_files_decode_or_are_refused(file_format: str, data: st.DataObject) -> None:
    content = data.draw(mutated(FILES[file_format]) | st.binary(max_size=200))
    decode(len(content), cloud=File(file_format, content))


def chunk_places(image: bytes) -> Iterator[tuple[int, int]]:
    """Start and size of each chunk."""
    start = 8
    while start < len(image):
        size = int.from_bytes(image[start : start + 4])
        yield start, size
        start += 12 + size


PNG = png(np.arange(400, 800, dtype=np.uint16).reshape(20, 20))
PNG_CHUNKS = [PNG[start : start + 12 + size] for start, size in chunk_places(PNG)]
PNG_CHUNKS += [
    b"\0\0\0\0" + kind + b"\0\0\0\0" for kind in (b"tRNS", b"iCCP", b"zTXt", b"acTL", b"gAMA")
]


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


OPTIONS = {
    "seed": 1, "up": [0.0, 0.0, 1.0], "viewpoint": [[0, 0, 1], [1, 0, 1]], "gripper": "panda",
    "workspace": {"min": [-1, -1, -1], "max": [1, 1, 1]}, "collision": {"margin": 0.01},
    "approach_region": {"include": [{"kind": "box", "min": [0, 0, 0], "max": [1, 1, 1]}]},
    "contact_region": {"exclude": [{"kind": "segments", "ids": [1]}, {"kind": "mask", "mask": []}]},
    "approach_direction": {"cones": [{"direction": [0, 0, -1], "max_angle": 1.0}]},
    "support": {"kind": "ransac", "distance": 0.01}, "suppression": None, "sampling": "uniform",
}  # fmt: skip


FORM = form(
    part("cloud", FILES["npy"][0], '; filename="c.npy"\r\nContent-Type: application/x-npy'),
    part("options", b'{"seed": 3}', "\r\nContent-Type: application/json"),
    part("segment_ids", b"[%s0]" % (b"0, " * 39)),
)


# Whole requests

SETTINGS = Settings(max_points=MAX_POINTS)
DOCUMENTS = {
    "points": POINTS.tolist(),
    "point_cloud2": POINT_CLOUD2 | {"data": base64_of(POINT_CLOUD2["data"])},
    "depth_images": [
        DEPTH_IMAGE
        | {"depth": DEPTH_IMAGE["depth"] | {"data": base64_of(DEPTH_IMAGE["depth"]["data"])}}
    ],
}
BESIDE = {"edges": [[0, 1], [2, 3]], "hand_poses": [np.eye(4).tolist()], "options": OPTIONS}


def ask(transport: str, body: bytes, scores: bool, media_type: str = "", query: str = "") -> None:
    """Ask, within memory; anything but an answer or an error of the caller's fails."""
    decodes_or_refuses(
        lambda: ask_worker(transport, body, media_type, query, scores, SETTINGS),
        len(body) + len(query),
        MAX_POINTS,
    )


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
    good += [
        ("application/json", json.dumps({name: DOCUMENTS[name]}).encode()) for name in DOCUMENTS
    ]
    for media_type, content in good:
        assert ask_worker("http", content, media_type, settings=SETTINGS).error is None
    for file_format in FILES:
        for content in FILES[file_format]:
            decode_cloud({"cloud": File(file_format, content)}, DetectOptions(), MAX_POINTS)
