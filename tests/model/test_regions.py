import base64

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import Indices, Mask, Region, Segments
from edgegrasp_model.scene.cloud import CheckedCloud, CloudInput, check_cloud, voxelise
from edgegrasp_model.scene.regions import check_region, inside_region

from .scenes import SEED

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


@pytest.mark.parametrize(
    ("shape", "field"),
    [
        (Indices(indices=(3, 40)), "options.contact_region.exclude.0.indices"),
        (Mask(mask=(True,) * 39), "options.contact_region.exclude.0.mask"),
        (Segments(ids=(1,)), "segment_ids"),
    ],
)
def test_rows_that_the_cloud_does_not_have_are_refused(shape: object, field: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        check_region(Region(exclude=(shape,)), rows(), "contact_region")
    assert caught.value.field == field
    assert "Send" in caught.value.fix
