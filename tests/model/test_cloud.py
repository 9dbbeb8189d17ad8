import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.scene.cloud import (
    estimate_normals,
    orient_normals,
    statistical_outlier_removal,
    validate_cloud,
    voxelise,
)

GOOD = np.random.default_rng(0).uniform(0.0, 0.3, (100, 3)).astype(np.float32)


def voxel_means(points: np.ndarray, size: float) -> np.ndarray:
    return voxelise(points, size).mean(points)


def sphere(count: int = 2000, radius: float = 0.05) -> np.ndarray:
    points = np.random.default_rng(1).normal(size=(count, 3))
    return (radius * points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize(
    ("cloud", "value", "fix"),
    [
        ([[0.0, 0.0, 0.0]], "a list", "array of shape"),
        (GOOD.astype(np.int32), "dtype int32", "float32 or float64"),
        (GOOD[:, :2], "shape (100, 2)", "shape (N, 3)"),
        (GOOD[None], "shape (1, 100, 3)", "shape (N, 3)"),
        (GOOD[:0], "no points", "at least"),
        (np.vstack([GOOD, [[np.nan, 0, 0]]]), "first in row 100", "Remove"),
        (np.vstack([[[0, np.inf, 0]], GOOD]), "first in row 0", "Remove"),
        (GOOD * 1000, "millimetres", "divide by 1000"),
        (GOOD[:5], "5 points for num_approach_points = 32", "lower options.num_approach_points"),
    ],
)
def test_a_bad_cloud_is_refused_by_field_value_and_fix(cloud: object, value: str, fix: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        validate_cloud(cloud, num_approach_points=32)
    assert caught.value.field == "cloud"
    assert value in caught.value.value
    assert fix in caught.value.fix


def test_a_good_cloud_comes_back_as_float32() -> None:
    checked = validate_cloud(GOOD.astype(np.float64))
    assert checked.dtype == np.float32
    np.testing.assert_array_equal(checked, GOOD)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.002, 0.1))
def test_voxels_are_means_of_the_points_in_them_whatever_their_order(
    seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.2, 0.2, (300, 3)).astype(np.float32)
    voxels = voxel_means(points, size)
    np.testing.assert_allclose(voxels, voxel_means(rng.permutation(points), size), atol=1e-7)
    low = points.min(axis=0).astype(np.float64)
    by_cell: dict[tuple[int, ...], list[np.ndarray]] = {}
    for point in points:
        cell = tuple(int(c) for c in np.floor((point - low) / size))
        by_cell.setdefault(cell, []).append(point)
    means = np.array([np.mean(group, axis=0) for _, group in sorted(by_cell.items())])
    np.testing.assert_allclose(voxels, means, atol=1e-6)


def test_a_far_point_is_an_outlier_and_a_surface_is_not() -> None:
    surface = voxel_means(sphere(), 0.005)
    cloud = np.vstack([surface, [[0.3, 0.3, 0.3]]]).astype(np.float32)
    kept = cloud[statistical_outlier_removal(cloud)]
    assert not (kept == 0.3).any()
    assert len(kept) > 0.9 * len(surface)


def test_normals_of_a_sphere_are_radial_and_face_the_camera() -> None:
    points = voxel_means(sphere(), 0.004)
    viewpoint = np.array([0.0, 0.0, 1.0], dtype=np.float32)
    normals = orient_normals(points, estimate_normals(points), viewpoint)
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    cosine = (normals * radial).sum(axis=1)
    assert np.median(np.abs(cosine)) > 0.98
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    assert ((normals * (viewpoint - points)).sum(axis=1) >= 0).all()
    assert (cosine[points[:, 2] > 0.02] > 0.9).all()


def test_a_handful_of_points_still_gets_normals() -> None:
    points = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]], np.float32)
    np.testing.assert_allclose(np.abs(estimate_normals(points)[:, 2]), 1.0, atol=1e-6)
