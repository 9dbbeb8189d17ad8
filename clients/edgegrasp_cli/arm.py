"""The arm of a benchmark: its place beside the scene, for the simulation and for planners."""

from typing import Any, NamedTuple

import numpy as np

from edgegrasp_robot import load_robot
from edgegrasp_sim.engine import ArmModel
from edgegrasp_sim.protocol import CameraRules
from edgegrasp_sim.surroundings import MIDDLE, TABLE_HEIGHT

FAR = 0.5  # metres from the arm's base to the middle of a scene
LIFT = {"retreat_length": 0.1, "retreat_direction": "up"}  # metres


class BenchmarkArm(NamedTuple):
    """An arm beside the scenes of a protocol."""

    model: ArmModel
    gripper: dict[str, Any] | None  # fields of its hand's file; None: the Panda's
    options: dict[str, Any]  # of each request


def benchmark_arm(name: str, camera: CameraRules) -> BenchmarkArm:
    """The robot's arm, on the camera's side of a scene as if the camera were on its wrist.

    Raises:
        InvalidRobot: the file cannot be used.
    """
    robot = load_robot(name)
    # The base stands on the table, on the camera's side; its x points to the middle of the scene.
    azimuth = np.deg2rad(sum(camera.azimuth_degrees) / 2)
    out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    T_world_base = np.eye(4)
    T_world_base[:3, 0], T_world_base[:3, 1] = -out, np.cross([0.0, 0.0, 1.0], -out)
    T_world_base[:3, 3] = np.array([MIDDLE, MIDDLE, TABLE_HEIGHT]) + FAR * out
    asked = {
        "name": robot.name,
        "T_base_cloud": np.linalg.inv(T_world_base).tolist(),
        "joints": robot.home.tolist(),
    }
    hand = None if robot.gripper.name == "panda" else robot.hand.model_dump()
    T_root_base = robot.scene.forwardKinematics(robot.home, robot.base_frame)
    return BenchmarkArm(
        ArmModel(
            robot.model.arm,
            T_world_base @ np.linalg.inv(T_root_base),
            robot.flange_frame,
            robot.T_flange_hand,
            robot.joint_names,
            robot.home,
        ),
        hand,
        {"robot": asked, "collision": LIFT},
    )
