"""What a caller sends, and the small, clean cloud made of it."""

import base64

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.checks import refusal

from edgegrasp_model.options import Indices, Mask, Region, Segments
from edgegrasp_model.scene.cloud import (
    CheckedCloud,
    CloudInput,
    check_cloud,
    seen_from_origin,
    voxelise,
)
from edgegrasp_model.scene.regions import check_region, inside_region

from .scenes import SEED

GOOD = np.random.default_rng(0).uniform(0.0, 0.3, (12, 3)).astype(np.float32)


def test_holes_of_an_organised_cloud_are_dropped_with_all_that_belongs_to_them() -> None:
    organised = GOOD.reshape(3, 4, 3).copy()
    organised[0, 1], organised[2, 3, 2] = np.nan, np.inf
    ids = np.arange(12).reshape(3, 4)
    normals = np.where(np.isfinite(organised), ids[..., None], np.nan)
    checked = check_cloud(
        CloudInput(organised, normals, segment_ids=ids, view_ids=ids.reshape(-1), colors=normals)
    )
    kept = [row for row in range(12) if row not in (1, 11)]
    np.testing.assert_array_equal(checked.points, GOOD[kept])
    np.testing.assert_array_equal(checked.normals, np.repeat(kept, 3).reshape(-1, 3))
    for rows in (checked.row, checked.segment_ids, checked.view_ids):
        np.testing.assert_array_equal(rows, kept)
    assert checked.rows_sent == 12


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
        (np.full((2, 3, 3), np.nan), "cloud", "holes only"),
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


SIZE = 0.01  # edge of a voxel, metres


def rows(count: int = 40, seed: int = 0, **fields: object) -> CheckedCloud:
    points = np.random.default_rng(seed).uniform(0, 0.03, (count, 3)).astype(np.float32)
    return check_cloud(CloudInput(points, **fields))


def inside(region: Region, cloud: CheckedCloud) -> tuple[np.ndarray, np.ndarray]:
    """Which voxels a region holds, and the voxel of each point."""
    voxels = voxelise(cloud.points, SIZE)
    return inside_region(region, voxels.mean(cloud.points), voxels, cloud), voxels.voxel


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
    np.testing.assert_array_equal(checked.of_all_pixels(every.ravel()), kept.ravel())
    assert len(check_cloud(image).points) == row.size - 1


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
        check_region(Region(exclude=(shape,)), rows(), "contact_region")
