import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from edgegrasp_client import Grasp, conversions
from edgegrasp_client.conversions import CONTACT_GRASPNET, PANDA_LINK8, VGN, FingerJoints, HandFrame

# The hand above the point (0.5, -0.1, 0), looking down, its fingers closing along the cloud's x.
DOWN = np.array([[0, 1, 0, 0.5], [1, 0, 0, -0.1], [0, 0, -1, 0.3], [0, 0, 0, 1.0]])
UP = np.array([[1, 0, 0, 0.25], [0, 1, 0, -0.5], [0, 0, 1, 1.0], [0, 0, 0, 1]])  # no turn at all
GRASPNET = conversions.graspnet_frame(0.1122, 0.02)

finite = st.floats(-2.0, 2.0)
places = st.tuples(finite, finite, finite)
quaternions = st.tuples(finite, finite, finite, finite).filter(lambda q: np.linalg.norm(q) > 1e-3)
motions = st.builds(RigidTransform.from_components, places, quaternions.map(Rotation.from_quat))
poses = motions.map(RigidTransform.as_matrix)


def grasp(pose: np.ndarray, score: float = 0.9, width: float = 0.06) -> Grasp:
    """A grasp as the server answers it; fields that conversions do not read are left out."""
    pose = np.asarray(pose, dtype=np.float32)
    fields: dict[str, Any] = dict.fromkeys(Grasp.__dataclass_fields__)
    fields |= {"score": score, "width": width, "T_cloud_hand": pose}
    return Grasp(**fields | {"approach_direction": pose[:3, 2]})


@given(quaternion=quaternions)
def test_quaternions_and_matrices_are_those_of_scipy(quaternion: tuple[float, ...]) -> None:
    rotation = Rotation.from_quat(quaternion)
    found = conversions.quaternion_from_matrix(rotation.as_matrix())
    for one in (quaternion, found):
        matrix = conversions.matrix_from_quaternion(one)
        np.testing.assert_allclose(matrix, rotation.as_matrix(), atol=1e-12)
    assert found[3] >= 0
    assert np.linalg.norm(found) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (CONTACT_GRASPNET, [[1, 0, 0, 0.5], [0, -1, 0, -0.1], [0, 0, -1, 0.3]]),
        # Tips at height 0.3 - 0.1122; the origin 0.02 above them.
        (GRASPNET, [[0, 1, 0, 0.5], [0, 0, -1, -0.1], [-1, 0, 0, 0.2078]]),
        (VGN, [[0, 1, 0, 0.5], [1, 0, 0, -0.1], [0, 0, -1, 0.238]]),
    ],
)
def test_the_frames_of_others(frame: HandFrame, expected: list[list[float]]) -> None:
    np.testing.assert_allclose(conversions.to_frame(DOWN, frame)[:3], expected, atol=1e-12)


@pytest.mark.parametrize("axes", [("x", "-x"), ("up", "x"), ("x", "")])
def test_axes_that_make_no_frame_are_refused(axes: tuple[str, str]) -> None:
    with pytest.raises(ValueError, match=r"both along x|Use one of"):
        HandFrame(*axes)


def test_the_pandas_parent_link_is_turned_by_45_degrees_at_the_same_place() -> None:
    """franka_description mounts panda_hand on panda_link8 with rpy="0 0 -pi/4"."""
    T_link_hand = RigidTransform.from_rotation(Rotation.from_euler("z", -np.pi / 4)).as_matrix()
    np.testing.assert_allclose(PANDA_LINK8 @ T_link_hand, np.eye(4), atol=1e-12)


@given(
    cases=st.lists(st.tuples(poses, st.floats(0, 1), st.floats(0, 0.1)), max_size=3),
    T_object_cloud=poses,
    T_hand_gripper=poses,
)
def test_isaac_grasps_round_trip(cases, T_object_cloud, T_hand_gripper) -> None:
    grasps = [grasp(*case) for case in cases]
    text = conversions.isaac_grasps(
        grasps,
        object_frame="/World/mug #1",
        gripper_frame='/World/"hand"',
        T_object_cloud=T_object_cloud,
        T_hand_gripper=T_hand_gripper,
        joints=FingerJoints(("thumb",), lambda opening: (0.8 - 9.0 * opening,)),
    )
    read = conversions.read_isaac_grasps(text)
    assert [each.name for each in read] == [f"grasp_{i}" for i in range(len(cases))]
    for each, (pose, score, width) in zip(read, cases, strict=True):
        back = np.linalg.inv(T_object_cloud) @ each.T_object_gripper @ np.linalg.inv(T_hand_gripper)
        np.testing.assert_allclose(back, pose, atol=1e-5)
        assert each.confidence == score
        assert each.cspace_position == {"thumb": 0.8}
        assert each.pregrasp_cspace_position == {"thumb": 0.8 - 9.0 * width}


def file() -> str:
    frames = {"object_frame": "/World/mug #1", "gripper_frame": '"hand"'}
    return conversions.isaac_grasps([grasp(UP, 0.5)], **frames)


def test_an_isaac_file_says_what_the_format_asks_for() -> None:
    assert file() == (
        "format: isaac_grasp\n"
        "format_version: 1.0\n"
        "object_frame_link: '/World/mug #1'\n"
        "gripper_frame_link: '\"hand\"'\n"
        "grasps:\n"
        "  grasp_0:\n"
        "    confidence: 0.5\n"
        "    position: [0.25, -0.5, 1.0]\n"
        "    orientation:\n"
        "      w: 1.0\n"
        "      xyz: [0.0, 0.0, 0.0]\n"
        "    cspace_position: {panda_finger_joint1: 0.0, panda_finger_joint2: 0.0}\n"
        "    pregrasp_cspace_position: {panda_finger_joint1: 0.03, panda_finger_joint2: 0.03}\n"
    )


def test_an_isaac_file_of_the_grasp_editor_is_read_with_the_extra(monkeypatch) -> None:
    (read,) = conversions.read_isaac_grasps(
        """
format: isaac_grasp
format_version: 1.0
object_frame: /World/mug
gripper_frame: /World/panda_hand
grasps:
  by hand:
    confidence: 1
    position: [1, 2.5, -3.0e-1]
    orientation: {w: 0.0, xyz: [2.0, 0.0, 0.0]}
"""
    )
    assert (read.name, read.confidence, read.cspace_position) == ("by hand", 1.0, {})
    np.testing.assert_allclose(read.T_object_gripper[:3, :3], np.diag([1, -1, -1]), atol=1e-12)
    np.testing.assert_allclose(read.T_object_gripper[:3, 3], [1, 2.5, -0.3])
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'edgegrasp\[yaml\]'"):
        conversions.read_isaac_grasps("format: isaac_grasp")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("format: isaac_grasp", "format: other"), "Give isaac_grasp, 1.0"),
        (("format_version: 1.0", "format_version: 2.0"), "Give isaac_grasp, 1.0"),
        (("  grasp_0:", "- grasp_0:"), "grasps: got a list"),
        (("    confidence: 0.5", "    confidence 0.5"), "line 8"),
        (("    confidence: 0.5\n", ""), "grasps.grasp_0: KeyError"),
        (("    confidence: 0.5", "    confidence: high"), "grasps.grasp_0: ValueError"),
        (("xyz: [0.0, 0.0, 0.0]", "xyz: [0.0, 0.0]"), "grasps.grasp_0: ValueError"),
        (("w: 1.0", "w: 0.0"), "not all zero"),
        (("[0.25, -0.5, 1.0]", "[0.25, -0.5]"), "grasps.grasp_0: ValueError"),
    ],
)
def test_what_is_no_isaac_file_is_refused(edit: tuple[str, str], message: str) -> None:
    text = file()
    assert edit[0] in text
    with pytest.raises(ValueError, match=message):
        conversions.read_isaac_grasps(text.replace(*edit, 1))
