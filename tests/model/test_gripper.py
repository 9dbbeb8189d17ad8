from pathlib import Path

import numpy as np
import pytest

from edgegrasp_model.errors import InvalidGripper
from edgegrasp_model.gripper import GRIPPER_FOLDER, load_gripper


def test_the_panda_has_its_published_dimensions() -> None:
    panda = load_gripper("panda")
    assert panda.max_opening == 0.08
    assert panda.palm_z == 0.0658
    np.testing.assert_allclose(panda.finger_depth, 0.0392)
    np.testing.assert_allclose(panda.T_hand_tcp[:3, 3], [0, 0, 0.1034])


def test_fingers_mirror_each_other_and_stand_the_opening_apart() -> None:
    panda = load_gripper()
    hand, right, left = panda.boxes(0.05)
    np.testing.assert_allclose(right[0, 1] - left[1, 1], 0.05)
    np.testing.assert_allclose(left[:, [0, 2]], right[:, [0, 2]])
    np.testing.assert_allclose(left[:, 1], -right[::-1, 1])
    assert hand[1, 2] == panda.palm_z


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("max_opening = 0.08", ""), "max_opening"),
        (("max_opening = 0.08", "max_opening = 'wide'"), "wide"),
        (("[0.0316, 0.104, 0.0658]", "[0.0316, -0.2, 0.0658]"), "min corner, max corner"),
        (("[hand]", "[hand"), "mine.toml"),
    ],
)
def test_a_broken_file_is_refused(tmp_path: Path, edit: tuple[str, str], message: str) -> None:
    text = (GRIPPER_FOLDER / "panda.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(text)
    assert load_gripper(path) == load_gripper("panda")
    path.write_text(text.replace(*edit))
    with pytest.raises(InvalidGripper, match=message):
        load_gripper(path)


def test_an_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(InvalidGripper, match="panda"):
        load_gripper("claw")
