import numpy as np
import pytest

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.scene.cloud import CloudInput, check_cloud

GOOD = np.random.default_rng(0).uniform(0.0, 0.3, (12, 3)).astype(np.float32)


def test_a_bare_array_is_a_cloud_of_its_points() -> None:
    checked = check_cloud(GOOD)
    np.testing.assert_array_equal(checked.points, GOOD)
    assert checked.row.tolist() == list(range(12))
    assert checked.normals is checked.segment_ids is checked.view_ids is None


def test_holes_of_an_organised_cloud_are_dropped_with_all_that_belongs_to_them() -> None:
    organised = GOOD.reshape(3, 4, 3).copy()
    organised[0, 1], organised[2, 3, 2] = np.nan, np.inf
    ids = np.arange(12).reshape(3, 4)
    normals = np.where(np.isfinite(organised), 1.0, np.nan)
    checked = check_cloud(
        CloudInput(organised, normals, segment_ids=ids, view_ids=ids.reshape(-1), colors=normals)
    )
    kept = [row for row in range(12) if row not in (1, 11)]
    np.testing.assert_array_equal(checked.points, GOOD[kept])
    assert checked.row.tolist() == kept
    assert checked.rows_sent == 12
    assert checked.normals is not None
    assert checked.normals.shape == (10, 3)
    assert checked.segment_ids is not None
    assert checked.segment_ids.tolist() == kept
    assert checked.view_ids is not None
    assert checked.view_ids.tolist() == kept


@pytest.mark.parametrize(
    ("sent", "field", "value"),
    [
        (CloudInput(np.where(np.eye(12, 3) > 0, np.nan, GOOD)), "cloud", "NaN"),
        (CloudInput(np.full((2, 3, 3), np.nan)), "cloud", "holes only"),
        (CloudInput(GOOD.reshape(3, 4, 3).astype(int)), "cloud", "dtype"),
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
def test_what_does_not_suit_the_cloud_is_named(sent: CloudInput, field: str, value: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        check_cloud(sent)
    assert caught.value.field == field
    assert value in caught.value.value
    assert caught.value.fix
