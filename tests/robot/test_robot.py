import numpy as np
import pytest

pytest.importorskip("roboplan", reason="the extra robot is not installed")

from edgegrasp_robot import load_robot, load_robots, robot_names
from edgegrasp_robot.robot import ROBOT_FOLDER, InvalidRobot


def test_the_hands_are_where_the_makers_have_them():
    upright = load_robot("fr3").forward_kinematics([0, 0, 0, -np.pi / 2, 0, np.pi / 2, np.pi / 4])
    # 0.333 + 0.316 up, 0.0825 ahead, then 0.0825 up, 0.384 ahead, 0.088 ahead, 0.107 down.
    np.testing.assert_allclose(upright[:3, 3], (0.5545, 0.0, 0.6245), atol=1e-4)
    np.testing.assert_allclose(upright[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-4)
    straight = load_robot("ur5").forward_kinematics(np.zeros(6))
    # DH parameters of UR: a2 + a3 ahead; d4 + d6 and the coupling aside; d1 - d5 up.
    expected = (0.425 + 0.39225, 0.10915 + 0.0823 + 0.0108, 0.089159 - 0.09465)
    np.testing.assert_allclose(straight[:3, 3], expected, atol=1e-4)


def test_robots_that_ship_load_and_tell_what_they_are():
    for name in robot_names():
        facts = load_robots((ROBOT_FOLDER / name,))[name].describe()
        assert facts["name"] == name
        assert len(facts["joint_names"]) == len(facts["home"]) == len(facts["max_acceleration"])
    with pytest.raises(InvalidRobot, match="fr3"):
        load_robot("r2d2")


def changed(folder, **lines):
    """The file of the FR3 with other lines."""
    text = (ROBOT_FOLDER / "fr3.toml").read_text()
    kept = [line for line in text.splitlines() if line.partition(" ")[0] not in lines]
    file = folder / "mine.toml"
    new = [f"{name} = {value}" for name, value in lines.items() if value]
    file.write_text("\n".join(new + kept))
    return file


BAD = {
    "no urdf": ({"urdf": ""}, "urdf"),
    "no such urdf": ({"urdf": '"nowhere.urdf"'}, "urdf: there is no 'nowhere.urdf'"),
    "no such srdf": ({"srdf": '"nowhere.srdf"'}, "srdf: there is no"),
    "unknown flange": ({"flange_frame": '"flansch"'}, "fr3_link8"),
    "base beside the chain": ({"base_frame": '"fr3_hand"'}, "base_frame"),
    "flange that nothing moves": ({"flange_frame": '"fr3_link0"'}, "flange_frame"),
    "unknown gripper": ({"gripper": '"claw"'}, "gripper"),
    "short home": ({"home": "[0.0]"}, "home: got 1 numbers"),
    "home beyond limits": ({"home": "[9.0, 0.0, 0.0, -2.0, 0.0, 2.0, 0.0]"}, "home"),
    "home in itself": ({"home": "[0.0, -1.7, 0.0, -3.0, 0.0, 0.6, 0.0]"}, "touch"),
    "no speed": ({"max_velocity": "[0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]"}, "max_velocity: got [0.0"),
    "backward": ({"max_acceleration": "[-1, 1, 1, 1, 1, 1, 1]"}, "max_acceleration: got"),
    "unknown field": ({"speed": "1.0"}, "speed"),
    "no toml": ({"home": "["}, "mine.toml"),
}


@pytest.mark.parametrize(("lines", "word"), BAD.values(), ids=BAD)
def test_a_file_that_is_wrong_says_how(tmp_path, lines, word):
    with pytest.raises(InvalidRobot, match=r"mine\.toml") as error:
        load_robot(changed(tmp_path, **lines))
    assert word in str(error.value)


URDF = """<robot name="r"><link name="base"/><link name="tip"><collision><geometry>
    <mesh filename="tip.obj"/></geometry></collision></link>
    <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/>
    <axis xyz="0 0 2"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
    <link name="flange"/><joint name="end" type="fixed"><parent link="tip"/>
    <child link="flange"/></joint></robot>"""
ARM = {
    "urdf": '"arm/r.urdf"', "srdf": '""', "base_frame": '"base"', "flange_frame": '"flange"',
    "home": "[0.0]", "max_velocity": "", "max_acceleration": "[1.0]",
}  # fmt: skip


def test_meshes_lie_beside_their_urdf_and_one_that_is_wrong_says_how(tmp_path, monkeypatch):
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "r.urdf").write_text(URDF)
    (tmp_path / "arm" / "tip.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    monkeypatch.chdir(changed(tmp_path, **ARM).parent)
    mine = load_robot("mine.toml")
    assert (mine.joint_names, mine.describe()["axes"]) == (["turn"], [0.0, 0.0, 1.0])
    for known, now, said in (
        ("tip.obj", "package://lost/a.stl", r"there is no 'package://lost/a\.stl'.*that contains"),
        ('<parent link="tip"/>', "", "joint end has no parent"),
        ('velocity="1"', 'velocity="0"', r"max_velocity: got \[0\.0\]"),
        ('lower="-1" upper="1"', "", "joint turn: got limits none and none"),
        ('lower="-1" upper="1"', 'lower="-180" upper="180"', "got limits -180 and 180.*radians"),
        ("<axis", '<mimic joint="other"/><axis', "joint turn follows another one"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "joint turn: got axis 0 0 0"),
        ('"revolute"', '"planar"', "joint turn is planar"),
        ('<mesh filename="tip.obj"/>', '<box size="-1 1 1"/>', "a <collision> of tip is wrong"),
        ("<link", "<<link", "urdf: r.urdf is not XML"),
        (URDF, "<robot/>", r"mine\.toml: urdf: has no <link>"),
        ("robot", "sdf", r"mine\.toml: urdf: .* Name one that check_urdf accepts"),
        ("<link", '<xacro:lost xmlns:xacro="http://www.ros.org/wiki/xacro"/><link', "Run xacro"),
    ):
        (tmp_path / "arm" / "r.urdf").write_text(URDF.replace(known, now))
        with pytest.raises(InvalidRobot, match=said):
            load_robot("mine.toml")
