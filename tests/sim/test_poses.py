from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_sim.poses import quaternion_xyzw, require_pose, translation


@given(seed=st.integers(0, 2**32 - 1))
def test_quaternion_is_that_of_the_rotation(seed: int) -> None:
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    quaternion = quaternion_xyzw(T)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    assert abs(np.dot(quaternion, rotation.as_quat())) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_quaternion_of_half_turns(axis: str) -> None:
    rotation = Rotation.from_euler(axis, np.pi)
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    assert abs(np.dot(quaternion_xyzw(T), rotation.as_quat())) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(3), r"pose has shape \(3, 3\)"),
        (np.full((4, 4), np.nan), "pose holds values that are not finite"),
        (2.0 * np.eye(4), "pose is no rigid transform"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "pose is no rigid transform"),
    ],
)
def test_what_is_no_pose_is_refused(T: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        require_pose(T, "pose")


def test_a_pose_passes_unchanged() -> None:
    T = translation(0.1, 0.2, 0.3)
    assert np.array_equal(require_pose(T.tolist(), "pose"), T)
