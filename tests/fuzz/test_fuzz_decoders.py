"""Whatever comes in, a decoder gives arrays or a 4xx, within memory that the bytes explain."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.scene.cloud import check_cloud
from edgegrasp_service.schemas import PER_POINT
from edgegrasp_service.worker.http_bodies import options_from_query, read_body
from edgegrasp_service.worker.messages import read_request
from edgegrasp_service.worker.request_cloud import File, decode_cloud

from .conftest import (
    DEPTH_IMAGE,
    DEPTH_ROWS,
    FILES,
    LISTS,
    POINT_CLOUD2,
    POINTS,
    VALUES,
    changed,
    decodes_or_refuses,
    files,
    mutated,
)

MAX_POINTS = 5000


@pytest.fixture(scope="module", autouse=True)
def open3d_is_loaded() -> None:
    """Its import is no memory of a request."""
    pytest.importorskip("open3d")


def decode(size: int, **fields: Any) -> None:
    def work() -> None:
        cloud, _ = decode_cloud(fields, DetectOptions(), MAX_POINTS)
        check_cloud(cloud, 32)

    decodes_or_refuses(work, size, MAX_POINTS)


@pytest.mark.parametrize("file_format", FILES)
@given(st.data())
def test_files(file_format: str, data: st.DataObject) -> None:
    content = data.draw(files(file_format))
    decode(len(content), cloud=File(file_format, content))


@pytest.mark.parametrize("file_format", FILES)
def test_the_files_that_are_mutated_are_good(file_format: str) -> None:
    for content in FILES[file_format]:
        fields = {"cloud": File(file_format, content)}
        cloud, _ = decode_cloud(fields, DetectOptions(), MAX_POINTS)
        assert cloud.points is not None


@given(st.binary(max_size=100), st.sampled_from(sorted(PER_POINT)), st.binary(max_size=600))
def test_packed(points: bytes, name: str, beside: bytes) -> None:
    decode(len(points), points=points)
    decode(len(beside), points=POINTS.tobytes(), **{name: beside})


@given(LISTS, st.sampled_from(sorted(PER_POINT)))
def test_lists(values: object, name: str) -> None:
    size = len(repr(values))
    decode(size, points=values)
    decode(size, points=POINTS.tobytes(), **{name: values})


@given(mutated(FILES["npy"]), st.sampled_from(sorted(PER_POINT)))
def test_npy_beside(content: bytes, name: str) -> None:
    decode(len(content), points=POINTS.tobytes(), **{name: File("npy", content)})


@given(changed(POINT_CLOUD2) | VALUES)
def test_point_cloud2(fields: object) -> None:
    decode(len(repr(fields)), point_cloud2=fields)


@given(st.lists(changed(DEPTH_IMAGE) | changed(DEPTH_ROWS), min_size=1, max_size=2) | VALUES)
def test_depth_images(images: object) -> None:
    decode(len(repr(images)), depth_images=images)


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


@given(mutated([message.SerializeToString() for message in MESSAGES]), st.booleans())
def test_messages(content: bytes, scores: bool) -> None:
    def work() -> None:
        fields = read_request("ScoreGrasps" if scores else "DetectGrasps", content)
        options = parse_options(fields["options"])
        cloud, options = decode_cloud(fields, options, MAX_POINTS)
        check_cloud(cloud, options.num_approach_points)

    decodes_or_refuses(work, len(content), MAX_POINTS)


FORM = b"".join(
    b'--b\r\nContent-Disposition: form-data; name="%s"%s\r\n\r\n%s\r\n' % part
    for part in [
        (b"cloud", b'; filename="c.npy"\r\nContent-Type: application/x-npy', FILES["npy"][0]),
        (b"options", b"\r\nContent-Type: application/json", b'{"seed": 3}'),
        (b"segment_ids", b"", b"[%s0]" % (b"0, " * 39)),
    ]
) + (b"--b--\r\n")


@given(mutated([FORM]), st.sampled_from(["b", '"b"', "b; x=y", "x", '"', "b'\ud800"]))
def test_forms(content: bytes, boundary: str) -> None:
    media_type = f"multipart/form-data; boundary={boundary}"

    def work() -> None:
        fields = read_body("DetectGrasps", media_type, "", content)
        decode_cloud(fields, parse_options(fields["options"]), MAX_POINTS)

    decodes_or_refuses(work, len(content), MAX_POINTS)


OPTIONS = {
    "seed": 1, "up": [0.0, 0.0, 1.0], "viewpoint": [[0, 0, 1], [1, 0, 1]], "gripper": "panda",
    "workspace": {"min": [-1, -1, -1], "max": [1, 1, 1]}, "collision": {"margin": 0.01},
    "approach_region": {"include": [{"kind": "box", "min": [0, 0, 0], "max": [1, 1, 1]}]},
    "contact_region": {"exclude": [{"kind": "segments", "ids": [1]}, {"kind": "mask", "mask": []}]},
    "approach_direction": {"cones": [{"direction": [0, 0, -1], "max_angle": 1.0}]},
    "support": {"kind": "ransac", "distance": 0.01}, "suppression": None, "sampling": "uniform",
}  # fmt: skip


@given(changed(OPTIONS) | st.dictionaries(st.text(max_size=5), VALUES, max_size=3))
def test_options(options: dict[str, object]) -> None:
    decodes_or_refuses(lambda: parse_options(options), len(repr(options)), MAX_POINTS)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([*DetectOptions.model_fields, "x"]),
            st.text(max_size=12)
            | st.sampled_from(["[" * 5000, "1,,2", "{", "1e999,0,0", "\ud800"]),
        ),
        max_size=3,
    )
)
def test_options_in_a_query(items: list[tuple[str, str]]) -> None:
    size = len(repr(items))
    decodes_or_refuses(lambda: parse_options(options_from_query(items)), size, MAX_POINTS)
