"""A worker with a robot: the arm's plans as either transport carries them."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("roboplan", reason="the extra robot is not installed")

from tests.robot.arms import BOXES, TURNED, scene_of

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client import GraspClient
from edgegrasp_client.over_grpc import message_of
from edgegrasp_client.requests import Request
from edgegrasp_client.results import read_as
from edgegrasp_model.results import UnitCosts
from edgegrasp_model.scene.cloud import pose_matrix
from edgegrasp_results import Detection
from edgegrasp_robot import load_robots
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import answer
from edgegrasp_service.worker.process import Job

SETTINGS = Settings(robots=(Path("fr3"),))


@pytest.fixture(scope="module")
def robot():
    return load_robots(SETTINGS.robots)["fr3"]


def ask(robot, transport, settings=SETTINGS, **changes):
    """The answer to a request about the robot, of a detector that finds a hand over each box."""
    scene, detection = scene_of(robot)
    detector = Mock()
    detector.prepare.return_value = SimpleNamespace(scene=scene, counts={})
    detector.finish.return_value = detection
    catalogue = Mock(unit_costs=UnitCosts(), get=Mock(return_value=detector))
    asked = {"name": "fr3", "T_base_cloud": TURNED, "joints": robot.home} | changes
    request = Request(scene.readings, {"robot": asked})
    if transport == "grpc":
        job = Job("DetectGrasps", "grpc", message_of(request).SerializeToString(), 60.0)
    else:
        text = {"points": scene.readings.tolist(), "options": dict(request.options)}
        job = Job("DetectGrasps", "http", json.dumps(text).encode(), 60.0, "application/json")
    return answer(job, catalogue, settings), detector


def read(transport, body):
    if transport == "grpc":
        return read_as(Detection, grasp_pb2.DetectGraspsResponse.FromString(body))
    return read_as(Detection, json.loads(body))


def test_the_client_reads_the_best_pick(robot, transport):
    given, detector = ask(robot, transport)
    assert given.error is None
    detection = read(transport, given.body)
    pick = detection.best_pick
    assert pick is detection.grasps[0]
    assert pick.arm.trajectory.joint_names == robot.joint_names
    np.testing.assert_allclose(pick.arm.trajectory.positions[0], robot.home)
    assert pick.arm.trajectory.velocities.shape == pick.arm.trajectory.positions.shape
    T_base_hand = TURNED @ pick.T_cloud_hand
    np.testing.assert_allclose(
        robot.forward_kinematics(pick.arm.grasp_joints), T_base_hand, atol=2e-3
    )
    assert list(detection.counts)[-2:] == ["with_trajectory", "returned"]
    options = detector.prepare.call_args.args[1]
    assert options.gripper.name == robot.gripper.name  # for which grasps are


def test_reach_alone_what_is_out_of_reach_and_a_start_that_collides(robot, transport):
    error = ask(robot, transport, joints=[0.0, 1.3, 0.0, -1.0, 0.0, 2.2, 0.8])[0].error
    assert (error.kind, error.field) == ("start-collision", "options.robot.joints")
    assert "the support" in error.value
    far = TURNED.copy()
    far[0, 3] += 3.0
    given, _ = ask(robot, transport, plan="reach", T_base_cloud=far)
    detection = read(transport, given.body)
    assert detection.best_pick is None
    assert [grasp.arm.pregrasp_joints for grasp in detection.grasps] == [None] * len(BOXES)
    near = read(transport, ask(robot, transport, plan="reach")[0].body).best_pick.arm
    assert near.reachable
    assert near.trajectory is None


def test_the_client_reads_where_an_object_is_put(robot, transport):
    place = {"T_base_object": pose_matrix(np.eye(3), (0.4, -0.35, 0.1))}
    given, _ = ask(robot, transport, place=place)
    plan = read(transport, given.body).best_pick.arm
    np.testing.assert_allclose(
        robot.forward_kinematics(plan.place_joints), plan.T_base_place, atol=1e-6
    )
    assert plan.trajectory.grasp_row < plan.trajectory.release_row < len(plan.trajectory.times)
    region = {"min": (0.3, -0.5, 0.0), "max": (0.6, -0.3, 0.3)}
    assert read(transport, ask(robot, transport, place={"region": region})[0].body).best_pick


@pytest.mark.parametrize(
    ("settings", "fix"), [(SETTINGS, "Use one of: fr3."), (Settings(), "Set the setting `robots`.")]
)
def test_a_robot_that_is_not_here_is_refused(robot, settings, fix, monkeypatch):
    if not settings.robots:  # such a server needs no extra
        monkeypatch.setitem(sys.modules, "edgegrasp_robot", None)
    error = ask(robot, "http", settings, name="r2d2")[0].error
    assert (error.field, error.fix, error.status) == ("options.robot.name", fix, 400)


def test_a_server_lists_its_robots(start_dummy, robot):
    joints = np.random.default_rng(0).uniform(robot.lower, robot.upper)
    with start_dummy("--robots", "fr3") as server:
        for transport in ("grpc", "rest"):
            with GraspClient(server.address(transport)) as client:
                (listed,) = client.robots()
            for field, value in robot.describe().items():
                np.testing.assert_array_equal(np.ravel(getattr(listed, field)), np.ravel(value))
            T_base_hand = listed.frames[0]
            for axis, turn, frame in zip(listed.axes, joints, listed.frames[1:], strict=True):
                about = Rotation.from_rotvec(turn * axis).as_matrix()
                T_base_hand = T_base_hand @ pose_matrix(about, np.zeros(3)) @ frame
            np.testing.assert_allclose(T_base_hand, robot.forward_kinematics(joints), atol=1e-6)
