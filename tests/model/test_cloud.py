"""What a caller sends, and the small, clean cloud made of it."""

import base64
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.checks import bounded_memory, refusal
from tests.cloud_files import depth_image, npz, point_cloud2, ros_message

from edgegrasp_camera.clouds import CloudInput, read_point_cloud2
from edgegrasp_model import request_cloud as wire
from edgegrasp_model.options import DetectOptions, Indices, Mask, Region, Segments
from edgegrasp_model.scene.cloud import (
    CheckedCloud,
    assumed_viewpoint,
    check_cloud,
    seen_from_origin,
    voxelise,
)
from edgegrasp_model.scene.scene import check_regions, inside_region, labels_of_all_pixels
from edgegrasp_service.errors import PayloadTooLarge

from .scenes import SEED, random_hands

GOOD = np.random.default_rng(0).uniform(0.0, 0.3, (12, 3)).astype(np.float32)


def test_holes_of_an_organised_cloud_are_dropped_with_all_that_belongs_to_them() -> None:
    organised = GOOD.reshape(3, 4, 3).copy()
    organised[0, 1], organised[1, 2], organised[2, 3, 2] = np.nan, 0.0, np.inf
    ids = np.arange(12).reshape(3, 4)
    normals = np.where(np.isfinite(organised), ids[..., None], np.nan)
    beside = {"segment_ids": ids, "view_ids": ids.reshape(-1), "colors": normals}
    checked = check_cloud(CloudInput(organised, normals, **beside))
    kept = [row for row in range(12) if row not in (1, 6, 11)]
    np.testing.assert_array_equal(checked.points, GOOD[kept])
    np.testing.assert_array_equal(checked.normals, np.repeat(kept, 3).reshape(-1, 3))
    for rows in (checked.row, checked.segment_ids, checked.view_ids):
        np.testing.assert_array_equal(rows, kept)
    assert checked.rows_sent == 12
    flat = check_cloud(np.insert(GOOD, 5, 0.0, axis=0))
    np.testing.assert_array_equal(flat.points, GOOD)
    np.testing.assert_array_equal(flat.row, np.delete(np.arange(13), 5))


def test_metres_taken_for_millimetres_get_a_warning() -> None:
    assert check_cloud(GOOD).warnings == ()
    (warning,) = check_cloud(GOOD / 1000).warnings
    assert "m wide: send metres, or another depth_scale" in warning


@pytest.mark.parametrize(
    ("sent", "field", "value"),
    [
        ([[0.0, 0.0, 0.0]], "cloud", "a list"),
        (GOOD.astype(np.int32), "cloud", "dtype int32"),
        (GOOD[:, :2], "cloud", "shape (12, 2)"),
        (GOOD[None, None], "cloud", "shape (1, 1, 12, 3)"),
        (GOOD[:0], "cloud", "no points"),
        (np.vstack([GOOD, [[np.nan, 0, 0]]]), "cloud", "row 12"),
        (np.vstack([[[0, np.inf, 0]], GOOD]), "cloud", "row 0"),
        (GOOD * 1000, "cloud", "millimetres"),
        (GOOD + 2000, "cloud", "2000 m from the origin"),
        (GOOD[:5], "cloud", "5 points"),
        (np.full((2, 3, 3), np.nan), "cloud", "no finite points"),
        (GOOD.reshape(3, 4, 3).astype(int), "cloud", "dtype"),
        (CloudInput(GOOD, normals=GOOD[:11]), "normals", "shape (11, 3)"),
        (CloudInput(GOOD, normals=GOOD.tolist()), "normals", "a list"),
        (CloudInput(GOOD, normals=np.full((12, 3), np.nan)), "normals", "row 0"),
        (CloudInput(GOOD, normals=GOOD.reshape(-1)), "normals", "shape (36,)"),
        (CloudInput(GOOD, colors=GOOD[:, :2]), "colors", "shape (12, 2)"),
        (CloudInput(GOOD, colors=GOOD.astype(str)), "colors", "dtype"),
        (CloudInput(GOOD, segment_ids=np.zeros(11, int)), "segment_ids", "shape (11,)"),
        (CloudInput(GOOD, segment_ids=np.zeros(12)), "segment_ids", "dtype float64"),
        (CloudInput(GOOD, segment_ids=np.full(12, 2**40)), "segment_ids", "1099511627776"),
        (CloudInput(GOOD, view_ids=np.full(12, -(2**40))), "view_ids", "-1099511627776"),
        (CloudInput(GOOD, view_ids=[0] * 12), "view_ids", "a list"),
    ],
)
def test_a_bad_cloud_is_refused_by_field_value_and_fix(sent, field, value) -> None:
    with refusal(field, value):
        check_cloud(sent, num_approach_points=6)


def test_stray_readings_far_away_are_left_out_and_millimetres_are_refused() -> None:
    near = np.random.default_rng(0).uniform(0, 0.5, (100, 3)).astype(np.float32)
    sent = np.concatenate([near[:50], [[0, 0, 79.0], [5000.0, 0, 0]], near[50:]])
    checked = check_cloud(CloudInput(sent, segment_ids=np.arange(102)))
    np.testing.assert_array_equal(checked.points, near)
    np.testing.assert_array_equal(checked.row, np.delete(np.arange(102), [50, 51]))
    np.testing.assert_array_equal(checked.segment_ids, checked.row)
    assert any("2 points are left out" in warning for warning in checked.warnings)
    with refusal("cloud", "suggests millimetres"):
        check_cloud(1000 * sent)


def test_a_camera_at_the_origin_sees_what_lies_wholly_in_front_of_it() -> None:
    rng = np.random.default_rng(0)
    seen = rng.uniform((-0.4, -0.3, 0.6), (0.4, 0.3, 1.0), (500, 3)).astype(np.float32)
    assert seen_from_origin(seen, None)
    assert seen_from_origin(seen, (0, -1.0, -0.5))
    assert not seen_from_origin(seen, (0, 0, 1.0))  # it would look straight up
    assert not seen_from_origin(seen - (0, 0, 0.8), None)
    assert not seen_from_origin(seen + np.array([1.5, 0, 0]), None)


def test_an_image_of_a_wide_angle_camera_is_seen_from_the_origin() -> None:
    y, x = np.mgrid[-1:1:0.04, -1.2:1.2:0.04]
    image = np.stack([x, y, np.full_like(x, 0.8)], axis=-1).astype(np.float32)
    assert assumed_viewpoint(check_cloud(image), DetectOptions(), []) == (0.0, 0.0, 0.0)
    mirrored = image * np.float32([1, -1, 1])  # a table above a robot's base, as a camera sees it
    for cloud in (mirrored, image.reshape(-1, 3)):
        assert assumed_viewpoint(check_cloud(cloud), DetectOptions(), []) != (0.0, 0.0, 0.0)


def rows(seed: int = 0, **fields: object) -> CheckedCloud:
    points = np.random.default_rng(seed).uniform(0, 0.03, (40, 3)).astype(np.float32)
    return check_cloud(CloudInput(points, **fields))


def inside(region: Region, cloud: CheckedCloud) -> tuple[np.ndarray, np.ndarray]:
    """Which voxels a region holds, and the voxel of each point."""
    voxels = voxelise(cloud.points, 0.01)  # metres
    return inside_region(region, voxels.mean(cloud.points), voxels, cloud), voxels.of_point


@given(seed=st.integers(0, SEED))
def test_rows_contain_a_voxel_if_they_have_half_of_its_points(seed: int) -> None:
    chosen = np.random.default_rng(seed).random(40) < 0.5
    cloud = rows(seed=seed, segment_ids=np.where(chosen, 7, -2))
    regions = [
        Region(include=(Mask(mask=chosen),)),
        Region(include=(Indices(indices=tuple(np.flatnonzero(chosen).tolist())),)),
        Region(include=(Segments(ids=(7,)),)),
    ]
    for region in regions:
        held, voxel = inside(region, cloud)
        for number, found in enumerate(held):
            assert found == (chosen[voxel == number].mean() >= 0.5)


def test_a_mask_may_be_an_array_lists_bytes_or_base64() -> None:
    chosen = np.random.default_rng(0).random((4, 6)) < 0.5
    packed = base64.b64encode(chosen * np.uint8(255)).decode()
    flat = tuple(chosen.ravel().tolist())
    masks = [Mask(mask=form) for form in (chosen, chosen.tolist(), flat, packed, chosen.tobytes())]
    assert all(mask == masks[0] for mask in masks)
    for wrong in ([0, 1], [[True], [True, False]], ["x" * 9], "no base64", None, chosen * 1.0):
        with pytest.raises(ValidationError):
            Mask(mask=wrong)


def test_rows_are_those_of_the_cloud_as_sent_when_points_were_dropped() -> None:
    organised = np.full((4, 5, 3), np.nan, dtype=np.float32)
    organised[1:3] = np.arange(30, dtype=np.float32).reshape(2, 5, 3) / 2
    cloud = check_cloud(organised)
    assert cloud.row.tolist() == list(range(5, 15))
    later = cloud.take(cloud.points[:, 0] > 5)
    region = Region(include=(Indices(indices=(9, 12)),))
    held, voxel = inside(region, later)
    assert later.row[held[voxel]].tolist() == [9, 12]


@pytest.mark.parametrize(("distance", "step"), [(0.5, 2), (3.0, 1)])
def test_a_large_image_of_something_near_keeps_every_second_row(distance: float, step: int) -> None:
    row, column = np.indices((725, 1281))
    image = distance * np.stack([column / 1000, row / 1000, np.ones(row.shape)], axis=-1)
    image[4, 6] = np.nan
    every = np.arange(row.size).reshape(row.shape)
    checked = check_cloud(CloudInput(image, segment_ids=every), thin=True)
    np.testing.assert_array_equal(checked.row, np.setdiff1d(every[::step, ::step], every[4, 6]))
    np.testing.assert_allclose(checked.points, image.reshape(-1, 3)[checked.segment_ids])
    kept = every[row // step * step, column // step * step]
    np.testing.assert_array_equal(labels_of_all_pixels(checked, every.ravel()), kept.ravel())
    assert len(check_cloud(image).points) == row.size - 1
    image[9:] = 0.0  # most pixels are holes, which lie no distance apart
    assert check_cloud(image, thin=True).step == step


@pytest.mark.parametrize(
    ("shape", "field"),
    [
        (Indices(indices=(3, 40)), "options.contact_region.exclude.0.indices"),
        (Mask(mask=(True,) * 39), "options.contact_region.exclude.0.mask"),
        (Segments(ids=(1,)), "segment_ids"),
    ],
)
def test_rows_that_the_cloud_does_not_have_are_refused(shape: object, field: str) -> None:
    with refusal(field, fix="Send"):
        check_regions(DetectOptions(contact_region=Region(exclude=(shape,))), rows())


MANY = 100_000
FX, FY, CX, CY = 60.0, 50.0, 15.5, 11.5


def pose(seed: int) -> np.ndarray:
    """A random camera pose."""
    return random_hands(1, seed, reach=1.0)[0].astype(np.float64)


def depth_of(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.3, 0.9, (24, 32))


def image(depth: np.ndarray, T_cloud_camera: np.ndarray) -> dict[str, Any]:
    return depth_image(depth, FX, FY, CX, CY, T_cloud_camera=T_cloud_camera.tolist())


def test_points_project_back_onto_their_pixels() -> None:
    depth, T_cloud_camera = depth_of(), pose(1)
    cloud = wire.read_depth_images([image(depth, T_cloud_camera)], MANY)
    assert cloud.points.shape == (24, 32, 3)
    homogeneous = np.concatenate([cloud.points, np.ones((24, 32, 1))], axis=-1)
    x, y, z = np.moveaxis((homogeneous @ np.linalg.inv(T_cloud_camera).T)[..., :3], -1, 0)
    np.testing.assert_allclose(z, depth, atol=1e-6)
    row, column = np.indices(depth.shape)
    np.testing.assert_allclose(FX * x / z + CX, column, atol=1e-4)
    np.testing.assert_allclose(FY * y / z + CY, row, atol=1e-4)
    np.testing.assert_array_equal(cloud.viewpoint, T_cloud_camera[:3, 3])
    archive = wire.File("npz", npz(depth=depth, intrinsics=np.array([FX, FY, CX, CY])))
    read = wire.decode_cloud({"cloud": archive}, DetectOptions(), MANY)
    assert read.viewpoint == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("kind", ["<f4", "<f8", "<u2"])
def test_encodings_give_the_same_depths(kind: str) -> None:
    millimetres = np.round(depth_of() * 1000)
    expected = wire.read_depth_images([image(millimetres / 1000, pose(2))], MANY)
    sent = image((millimetres if kind == "<u2" else millimetres / 1000).astype(kind), pose(2))
    packed = wire.read_depth_images([sent], MANY)
    np.testing.assert_allclose(packed.points, expected.points, atol=1e-6)
    sent["depth"]["data"] = base64.b64encode(sent["depth"]["data"]).decode()
    in_json = wire.read_depth_images([sent], MANY)
    np.testing.assert_array_equal(in_json.points, packed.points)
    rows = (millimetres / 1000).tolist()
    rows[1][2], rows[1][3] = None, -np.inf  # as ROS and ZED have what is too near
    listed = wire.read_depth_images([sent | {"depth": rows}], MANY)
    assert np.isnan(listed.points[1, 2:4]).all()
    np.testing.assert_allclose(listed.points[2:], expected.points[2:], atol=1e-6)
    with refusal("depth_images", kind=PayloadTooLarge):
        wire.read_depth_images([sent] * 3, 2 * 24 * 32)  # the pixels of all images


@pytest.mark.parametrize(
    ("intrinsics", "field", "value"),
    [
        ([FX, FY, 320, 240], ".cx", "320, outside of an image of 32 x 24 pixels"),
        ([FX, FY, CX, 24.0], ".cy", "24, outside"),
        ([1.0, FY, CX, CY], ".fx", "1 for an image of 32 x 24 pixels"),
        ([FX, 600.0, CX, CY], ".fy", "600 for"),
        ([FX, 20.0, CX, CY], "", "fx 60 and fy 20"),
        ([20.0, 60.0, CX, CY], "", "fx 20 and fy 60"),
        ([FX, FY, CX], "", "[60.0, 50.0, 15.5]"),
        ([[FX, 0, 0], [0, FY, 0], [CX, CY, 1]], "", "[[60.0, 0, 0]"),
    ],
)
def test_intrinsics_that_do_not_fit_the_image_are_refused(intrinsics, field, value) -> None:
    with refusal(f"depth_images.0.intrinsics{field}", value):
        wire.read_depth_images([image(depth_of(), pose(0)) | {"intrinsics": intrinsics}], MANY)


def test_a_single_row_does_not_look_along_z() -> None:
    image, x = np.full((2, 200, 3), np.nan, np.float32), np.linspace(-1.9, 1.9, 200)
    image[0] = np.stack([x, 0 * x, 1 + 0 * x], axis=1)
    assert not check_cloud(image).looks_along_z()


def test_views_are_fused_and_doubtful_intrinsics_get_a_warning() -> None:
    depths = [depth_of(seed=seed) for seed in range(3)]
    poses = [pose(seed) for seed in range(3)]
    depths[0][0, 0] = np.nan
    images = [image(depth, at) for depth, at in zip(depths, poses, strict=True)]
    sent = {"depth_images": images, "segment_ids": list(range(3 * 24 * 32))}
    cloud = wire.decode_cloud(sent, DetectOptions(), MANY)
    np.testing.assert_allclose(cloud.viewpoint, [at[:3, 3] for at in poses])
    checked = check_cloud(cloud)
    np.testing.assert_array_equal(checked.segment_ids, np.arange(1, 3 * 24 * 32))
    for view, single in enumerate(images):
        alone = wire.read_depth_images([single], MANY)
        seen = checked.points[checked.view_ids == view]
        np.testing.assert_array_equal(seen, check_cloud(alone).points)
        assert alone.warnings == ()
    images[1]["intrinsics"] |= {"cx": 8.0}
    for some in (images[1:2], images[:2]):
        (warning,) = wire.read_depth_images(some, MANY).warnings
        assert f"depth_images.{len(some) - 1}.intrinsics: cx 8 is far from the" in warning
    (warning,) = wire.read_depth_images(images[2:] * 2, MANY).warnings
    assert "two have the same camera position" in warning


def read(fields: dict[str, Any]) -> CloudInput:
    return read_point_cloud2(wire.parse(wire.PointCloud2, fields, "point_cloud2"), MANY)


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
    message = ros_message(rows, data=list(rows.tobytes()))
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


def test_a_long_text_in_a_list_takes_its_memory_once() -> None:
    rows = [["x" * 100_000, "", ""]] + [["", "", ""]] * 2000
    with bounded_memory(5_000_000), refusal("points", "['xxx"):
        wire.decode_points(rows, MANY)
    with bounded_memory(5_000_000), refusal("normals", "['xxx"):
        wire.decode_array("normals", rows, MANY)
