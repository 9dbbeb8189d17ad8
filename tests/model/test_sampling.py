import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgegrasp_model.candidates.edge_grasps import sample_approach_points


@pytest.mark.parametrize("method", ["farthest", "uniform"])
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 60), size=st.integers(1, 40))
def test_approach_points_are_different_rows(method, seed: int, count: int, size: int) -> None:
    points = np.random.default_rng(seed).normal(size=(size, 3)).astype(np.float32)
    rows = sample_approach_points(points, count, method, np.random.default_rng(seed))
    assert len(set(rows.tolist())) == len(rows) == min(count, size)
    again = sample_approach_points(points, count, method, np.random.default_rng(seed))
    np.testing.assert_array_equal(rows, again)


def test_farthest_points_spread_out() -> None:
    line = np.zeros((101, 3), np.float32)
    line[:, 0] = np.linspace(0, 1, 101)
    rows = sample_approach_points(line, 5, "farthest", np.random.default_rng(0))
    gaps = np.diff(np.sort(line[rows, 0]))
    assert gaps.min() > 0.1
