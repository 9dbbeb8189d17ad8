import base64
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.checks import bounded_memory, refusal
from tests.cloud_files import npz, point_cloud2

from edgegrasp_camera.clouds import CloudInput, read_point_cloud2
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.request_cloud import (
    File,
    PointCloud2,
    decode_array,
    decode_cloud,
    decode_points,
    parse,
    read_depth_images,
)
from edgegrasp_model.scene.cloud import check_cloud
from edgegrasp_service.errors import PayloadTooLarge

MANY = 100_000
FX, FY, CX, CY = 60.0, 50.0, 15.5, 11.5


def pose(seed: int) -> np.ndarray:
    """A random camera pose, from the QR decomposition of random numbers."""
    random = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    T_cloud_camera = np.eye(4)
    T_cloud_camera[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    T_cloud_camera[:3, 3] = random.normal(size=3)
    return T_cloud_camera


def depth_of(shape: tuple[int, int] = (24, 32), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.3, 0.9, shape)


def image(depth: np.ndarray, T_cloud_camera: np.ndarray, encoding: str = "64FC1") -> dict:
    dtype = {"64FC1": "<f8", "32FC1": "<f4", "16UC1": "<u2"}[encoding]
    pixels = {"height": depth.shape[0], "width": depth.shape[1], "encoding": encoding}
    return {
        "depth": pixels | {"data": depth.astype(dtype).tobytes()},
        "intrinsics": {"fx": FX, "fy": FY, "cx": CX, "cy": CY},
        "T_cloud_camera": T_cloud_camera.tolist(),
    }


def test_points_project_back_onto_their_pixels() -> None:
    depth, T_cloud_camera = depth_of(), pose(1)
    cloud = read_depth_images([image(depth, T_cloud_camera)], MANY)
    assert cloud.points.shape == (24, 32, 3)
    homogeneous = np.concatenate([cloud.points, np.ones((24, 32, 1))], axis=-1)
    x, y, z = np.moveaxis((homogeneous @ np.linalg.inv(T_cloud_camera).T)[..., :3], -1, 0)
    np.testing.assert_allclose(z, depth, atol=1e-6)
    row, column = np.indices(depth.shape)
    np.testing.assert_allclose(FX * x / z + CX, column, atol=1e-4)
    np.testing.assert_allclose(FY * y / z + CY, row, atol=1e-4)
    np.testing.assert_array_equal(cloud.viewpoint, T_cloud_camera[:3, 3])
    sent = {"depth_images": [image(depth, T_cloud_camera)]}
    _, options = decode_cloud(sent, DetectOptions(), MANY)
    assert options.viewpoint == tuple(T_cloud_camera[:3, 3].tolist())
    archive = File("npz", npz(depth=depth, intrinsics=np.array([FX, FY, CX, CY])))
    _, options = decode_cloud({"cloud": archive}, DetectOptions(), MANY)
    assert options.viewpoint == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("encoding", ["32FC1", "64FC1", "16UC1"])
def test_encodings_give_the_same_depths(encoding: str) -> None:
    millimetres = np.round(depth_of() * 1000)
    expected = read_depth_images([image(millimetres / 1000, pose(2))], MANY)
    sent = image(millimetres if encoding == "16UC1" else millimetres / 1000, pose(2), encoding)
    packed = read_depth_images([sent], MANY)
    np.testing.assert_allclose(packed.points, expected.points, atol=1e-6)
    sent["depth"]["data"] = base64.b64encode(sent["depth"]["data"]).decode()
    in_json = read_depth_images([sent], MANY)
    np.testing.assert_array_equal(in_json.points, packed.points)
    rows = (millimetres / 1000).tolist()
    rows[1][2] = None
    listed = read_depth_images([sent | {"depth": rows}], MANY)
    assert np.isnan(listed.points[1, 2]).all()
    np.testing.assert_allclose(listed.points[2:], expected.points[2:], atol=1e-6)
    with refusal("depth_images", kind=PayloadTooLarge):
        read_depth_images([sent] * 3, 2 * 24 * 32)  # the pixels of all images


@pytest.mark.parametrize(
    ("intrinsics", "field", "value"),
    [
        ([FX, FY, 320, 240], ".cx", "320, outside of an image of 32 x 24 pixels"),
        ([FX, FY, CX, 24.0], ".cy", "24, outside"),
        ([1.0, FY, CX, CY], ".fx", "1 for an image of 32 x 24 pixels"),
        ([FX, 600.0, CX, CY], ".fy", "600 for"),
        ([FX, 20.0, CX, CY], "", "fx 60 and fy 20"),
        ([FX, FY, CX], "", "[60.0, 50.0, 15.5]"),
        ([[FX, 0, 0], [0, FY, 0], [CX, CY, 1]], "", "[[60.0, 0, 0]"),
    ],
)
def test_intrinsics_that_do_not_fit_the_image_are_refused(intrinsics, field, value) -> None:
    with refusal(f"depth_images.0.intrinsics{field}", value):
        read_depth_images([image(depth_of(), pose(0)) | {"intrinsics": intrinsics}], MANY)


def test_doubtful_intrinsics_get_a_warning() -> None:
    good, doubtful = image(depth_of(), pose(0)), image(depth_of(), pose(1))
    assert read_depth_images([good], MANY).warnings == ()
    doubtful["intrinsics"] |= {"cx": 8.0}
    for images in ([doubtful], [good, doubtful]):
        (warning,) = read_depth_images(images, MANY).warnings
        assert f"depth_images.{len(images) - 1}.intrinsics: cx 8 lies far from the" in warning


def test_views_are_fused() -> None:
    depths = [depth_of(seed=seed) for seed in range(3)]
    poses = [pose(seed) for seed in range(3)]
    depths[0][0, 0] = np.nan
    images = [image(depth, at) for depth, at in zip(depths, poses, strict=True)]
    sent = {"depth_images": images, "segment_ids": list(range(3 * 24 * 32))}
    cloud, options = decode_cloud(sent, DetectOptions(), MANY)
    np.testing.assert_allclose(options.viewpoint, [at[:3, 3] for at in poses])
    assert DetectOptions.model_validate(options.model_dump()) == options
    checked = check_cloud(cloud)
    np.testing.assert_array_equal(checked.segment_ids, np.arange(1, 3 * 24 * 32))
    for view, single in enumerate(images):
        alone = read_depth_images([single], MANY)
        seen = checked.points[checked.view_ids == view]
        np.testing.assert_array_equal(seen, check_cloud(alone).points)


# sensor_msgs/PointCloud2


def read(fields: dict[str, Any]) -> CloudInput:
    return read_point_cloud2(parse(PointCloud2, fields, "point_cloud2"), MANY)


def cloud_of(shape: tuple[int, int], kind: str = "f4", extra: tuple[Any, ...] = ()) -> np.ndarray:
    names = [("x", kind), ("intensity", "u2"), ("y", kind), ("z", kind), ("ring", "u1", 3), *extra]
    rows = np.zeros(shape, np.dtype(names, align=True))
    random = np.random.default_rng(0)
    for name in rows.dtype.names:
        if rows.dtype[name].kind == "f":
            rows[name] = random.normal(size=shape)
    return rows


def xyz(rows: np.ndarray, names: tuple[str, ...] = ("x", "y", "z")) -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=-1)


@settings(max_examples=30, derandomize=True, deadline=None)
@given(
    height=st.integers(1, 5),
    width=st.integers(1, 7),
    padding=st.integers(0, 9),
    big=st.booleans(),
    kind=st.sampled_from(["f4", "f8"]),
    text=st.booleans(),
)
def test_every_layout_gives_the_points(height, width, padding, big, kind, text) -> None:
    rows = cloud_of((height, width), kind)
    fields = point_cloud2(rows, padding, big)
    if text:
        fields["data"] = base64.b64encode(fields["data"]).decode()
    cloud = read(fields)
    expected = xyz(rows) if height > 1 else xyz(rows)[0]
    np.testing.assert_array_equal(cloud.points, expected)
    assert cloud.points.dtype == np.dtype(kind)
    assert cloud.normals is cloud.colors is None


@pytest.mark.parametrize("kind", ["f4", "u4"])
def test_normals_and_colours(kind: str) -> None:
    names = ("normal_x", "normal_y", "normal_z")
    rows = cloud_of((3, 4), extra=(*((name, "f4") for name in names), ("rgb", kind)))
    packed = np.arange(12, dtype=np.uint32).reshape(3, 4) + 0x112200
    rows["rgb"] = packed.view(kind)
    for big in (False, True):
        cloud = read(point_cloud2(rows, big=big))
        np.testing.assert_array_equal(cloud.normals, xyz(rows, names))
        np.testing.assert_array_equal(cloud.colors[0, 2], [0x11, 0x22, 0x02])


def test_messages_of_other_programs_are_read_without_a_schema() -> None:
    rows = cloud_of((1, 4))
    fields = point_cloud2(rows)
    layout = [SimpleNamespace(**({"count": 1} | field)) for field in fields.pop("fields")]
    message = SimpleNamespace(**fields | {"data": list(fields["data"])}, fields=layout)
    np.testing.assert_array_equal(read_point_cloud2(message).points, xyz(rows)[0])
    message.fields.append(SimpleNamespace(name="rgb", offset=0, datatype=9, count=1))
    with refusal("point_cloud2.fields", "rgb of type 9"):
        read_point_cloud2(message)


# NumPy adds the size to this offset in 32 bits: it read 2 GB behind the data.
FAR_FIELDS = [
    field | ({"offset": 2**31 - 4} if field["name"] == "z" else {})
    for field in point_cloud2(cloud_of((1, 4)))["fields"]
]


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"data": "no base64!"}, "point_cloud2.data"),
        ({"data": None}, "point_cloud2.data"),
        ({"dense": True}, "point_cloud2.dense"),
        ({"fields": []}, "point_cloud2.fields"),
        ({"width": 2**31}, "point_cloud2.width"),
        ({"row_step": 2**30, "height": 1000}, "point_cloud2.data"),
        ({"point_step": 0}, "point_cloud2.fields"),
        ({"row_step": 1}, "point_cloud2.row_step"),
        ({"fields": point_cloud2(cloud_of((1, 4)))["fields"] * 2}, "point_cloud2.fields"),
        ({"height": -1}, "point_cloud2.height"),
        ({"fields": FAR_FIELDS}, "point_cloud2.fields"),
    ],
)
def test_bad_layouts_are_refused_by_field(changes: dict[str, Any], field: str) -> None:
    with refusal(field):
        read(point_cloud2(cloud_of((1, 4))) | changes)


# Lists


@pytest.mark.parametrize("field", ["points", "normals"])
def test_a_long_text_in_a_list_takes_its_memory_once(field: str) -> None:
    rows = [["x" * 100_000, "", ""]] + [["", "", ""]] * 2000
    with bounded_memory(5_000_000), refusal(field, "['xxx"):
        decode_points(rows, MANY) if field == "points" else decode_array(field, rows, MANY)
