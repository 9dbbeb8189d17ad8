"""Pick and place with an arm in simulation: from the camera's depth image to objects in a tray.

usage: edgegrasp serve --robots fr3; python examples/pick_and_place.py 127.0.0.1:50051
"""

import sys
from typing import Any

import numpy as np
import pybullet as p
import pybullet_data

from edgegrasp_client import GraspClient
from edgegrasp_sim.camera import look_at

OBJECTS = ("duck_vhacd.urdf", "lego/lego.urdf", "jenga/jenga.urdf", "objects/mug.urdf")
HOME, TRAY = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785), (0.05, -0.5, 0.0)
OVER_TRAY = (-1.47, -0.1, 0.0, -2.2, 0.0, 2.1, 0.785)  # joints, radians
AXES, FORCES = [*range(7), 9, 10], [240.0] * 7 + [70.0] * 2  # of the arm and its fingers
EYE, MIDDLE, NEAR, FAR = np.array([1.0, 0.1, 0.65]), np.array([0.5, 0.0, 0.02]), 0.1, 2.0
CAMERA: Any = {"intrinsics": (539, 539, 319.5, 239.5), "T_cloud_camera": look_at(EYE, MIDDLE)}
LIFT = {"retreat_length": 0.2, "retreat_direction": "up"}
TABLE = {"min": (0.3, -0.25, -0.05), "max": (0.75, 0.25, 0.4)}  # metres, base frame: the cloud's
ROBOT = {"name": "fr3", "T_base_cloud": np.eye(4), "joints": HOME}
OPTIONS: Any = {"robot": ROBOT, "collision": LIFT, "workspace": TABLE, "top_k": 5}


def depth_image() -> Any:
    """What the camera sees, with its pose."""
    view = p.computeViewMatrix(EYE, MIDDLE, (0, 0, 1))
    image = p.getCameraImage(640, 480, view, p.computeProjectionMatrixFOV(48, 4 / 3, NEAR, FAR))
    depth = np.reshape(image[3], (480, 640))
    return {"depth": FAR * NEAR / (FAR - (FAR - NEAR) * depth), **CAMERA}  # metres


def drive(way: Any, times: Any, opening: float) -> None:
    """Drive the arm along joints (T, 7) at times (T,), the fingers to an opening."""
    for now in np.arange(times[0], times[-1] + 0.3, 1 / 240):
        goal = [*(np.interp(now, times, joint) for joint in np.transpose(way)), *[opening / 2] * 2]
        p.setJointMotorControlArray(arm, AXES, p.POSITION_CONTROL, goal, forces=FORCES)
        p.stepSimulation()


p.connect(p.DIRECT)
p.setAdditionalSearchPath(pybullet_data.getDataPath())
p.setGravity(0.0, 0.0, -9.81)
_, arm = p.loadURDF("plane.urdf"), p.loadURDF("franka_panda/panda.urdf", useFixedBase=True)
p.loadURDF("tray/traybox.urdf", TRAY, globalScaling=0.6)
places = [(0.45 + k % 2 * 0.15, k // 2 * 0.2 - 0.1, 0.08) for k in range(4)]
objects = [p.loadURDF(*each) for each in zip(OBJECTS, places, strict=True)]
drive([HOME, HOME], [0.0, 3.0], 0.08)
client = GraspClient(sys.argv[1])
for _ in range(3):
    pick = client.detect(depth_images=[depth_image()], **OPTIONS).best_pick
    motion: Any = pick and pick.arm and pick.arm.trajectory
    assert motion, "the arm has no way to any grasp"
    row = motion.grasp_row
    drive(motion.positions[: row + 1], motion.times[: row + 1], 0.08)
    drive(motion.positions[[row, row]], [0.0, 1.0], 0.0)
    drive(motion.positions[row:], motion.times[row:], 0.0)
    drive([motion.positions[-1], HOME, OVER_TRAY], [0.0, 2.0, 5.0], 0.0)
    drive([OVER_TRAY, OVER_TRAY, HOME], [0.0, 1.0, 4.0], 0.08)
ends = np.array([p.getBasePositionAndOrientation(one)[0] for one in objects])
print(
    f"{(np.abs(ends - TRAY)[:, :2] < 0.2).all(axis=1).sum()} of {len(OBJECTS)} objects in the tray"
)
