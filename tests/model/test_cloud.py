"""What a caller sends, and the small, clean cloud made of it."""

import numpy as np
import pytest

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.scene.cloud import CloudInput, check_cloud, seen_from_origin

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
        (CloudInput(GOOD, view_ids=[0] * 12), "view_ids", "a list"),
    ],
)
def test_a_bad_cloud_is_refused_by_field_value_and_fix(sent, field, value) -> None:
    with pytest.raises(InvalidRequest) as caught:
        check_cloud(sent, num_approach_points=6)
    assert caught.value.field == field
    assert value in caught.value.value
    assert caught.value.fix


def test_stray_readings_far_away_are_left_out_and_millimetres_are_refused() -> None:
    near = np.random.default_rng(0).uniform(0, 0.5, (100, 3)).astype(np.float32)
    sent = np.concatenate([near[:50], [[0, 0, 79.0], [5000.0, 0, 0]], near[50:]])
    checked = check_cloud(CloudInput(sent, segment_ids=np.arange(102)))
    np.testing.assert_array_equal(checked.points, near)
    np.testing.assert_array_equal(checked.row, np.delete(np.arange(102), [50, 51]))
    np.testing.assert_array_equal(checked.segment_ids, checked.row)
    assert any("2 points are left out" in warning for warning in checked.warnings)
    with pytest.raises(InvalidRequest, match="suggests millimetres"):
        check_cloud(1000 * sent)


def test_a_camera_at_the_origin_sees_what_lies_wholly_in_front_of_it() -> None:
    rng = np.random.default_rng(0)
    seen = rng.uniform((-0.4, -0.3, 0.6), (0.4, 0.3, 1.0), (500, 3)).astype(np.float32)
    assert seen_from_origin(seen, None)
    assert seen_from_origin(seen, (0, -1.0, -0.5))
    assert not seen_from_origin(seen, (0, 0, 1.0))  # it would look straight up
    assert not seen_from_origin(seen - (0, 0, 0.8), None)
    assert not seen_from_origin(seen + np.array([1.5, 0, 0]), None)
