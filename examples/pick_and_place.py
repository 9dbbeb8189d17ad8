"""Pick and place with an arm in simulation: from the camera's depth image to objects in a tray.

usage: edgegrasp serve --robots fr3 & python examples/pick_and_place.py 127.0.0.1:50051
It needs PyBullet, which has wheels up to Python 3.11: pip install pybullet
"""

import sys
from typing import Any

import numpy as np
import pybullet as p
import pybullet_data

from edgegrasp_client import GraspClient
from edgegrasp_sim.camera import look_at

OBJECTS = ("duck_vhacd.urdf", "lego/lego.urdf", "cube_small.urdf")
PLACES = (0.45, -0.1, 0.08), (0.6, -0.1, 0.08), (0.6, 0.1, 0.08)
HOME, TRAY = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785), (0.05, -0.5, 0.0)
IN_TRAY = {"min": (-0.11, -0.66, 0.015), "max": (0.21, -0.34, 0.3)}  # metres, base frame
AXES, FORCES = [*range(7), 9, 10], [240.0] * 7 + [70.0] * 2  # of the arm and its fingers
EYE, MIDDLE, NEAR, FAR = np.array([1.0, 0.1, 0.65]), np.array([0.5, 0.0, 0.02]), 0.1, 2.0
CAMERA: Any = {"intrinsics": (539, 539, 319.5, 239.5), "T_cloud_camera": look_at(EYE, MIDDLE)}
TABLE = {"min": (0.3, -0.25, -0.05), "max": (0.75, 0.25, 0.4)}  # the cloud is in the base frame
ROBOT = {"name": "fr3", "T_base_cloud": np.eye(4), "joints": HOME, "place": {"region": IN_TRAY}}
LIFT = {"retreat_length": 0.2, "retreat_direction": "up"}
OPTIONS: Any = {"robot": ROBOT, "collision": LIFT, "workspace": TABLE}


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
p.loadURDF("tray/traybox.urdf", TRAY, globalScaling=0.8)
objects = [p.loadURDF(*each) for each in zip(OBJECTS, PLACES, strict=True)]
drive([HOME, HOME], [0.0, 3.0], 0.08)
view = p.computeViewMatrix(EYE, MIDDLE, (0, 0, 1))
lens = p.computeProjectionMatrixFOV(48, 4 / 3, NEAR, FAR)
client = GraspClient(sys.argv[1])
for _ in objects:
    seen = np.reshape(p.getCameraImage(640, 480, view, lens)[3], (480, 640))
    image: Any = {"depth": FAR * NEAR / (FAR - (FAR - NEAR) * seen), **CAMERA}  # metres
    pick = client.detect(depth_images=[image], **OPTIONS).best_pick
    motion: Any = pick and pick.arm and pick.arm.trajectory
    assert motion, "the arm reaches no grasp"
    start, last = 0, len(motion.times) - 1
    for end, opening in (motion.grasp_row, 0.08), (motion.release_row, 0.0), (last, 0.08):
        drive(motion.positions[[start, start]], [0.0, 1.0], opening)
        drive(motion.positions[start : end + 1], motion.times[start : end + 1], opening)
        start = end
    drive([motion.positions[last], HOME], [0.0, 2.0], 0.08)
ends = np.array([p.getBasePositionAndOrientation(one)[0] for one in objects])
inside = (np.abs(ends - TRAY)[:, :2] < 0.24).all(axis=1).sum()
print(f"{inside} of {len(objects)} objects in the tray")
