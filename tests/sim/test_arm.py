from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("roboplan", reason="the extra robot is not installed")

from tests.robot.arms import picks_of

from edgegrasp_lab.benchmark import benchmark_arm
from edgegrasp_robot import load_robot
from edgegrasp_sim.engine import make_world
from edgegrasp_sim.fixed_parts import OPEN_TABLE, TABLE_HEIGHT
from edgegrasp_sim.hand import MIN_OPENING, ArmDriver, FailureCause, hand_model, panda, run_grasp
from edgegrasp_sim.objects import ObjectModel
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.scene import load_object

CUBE = ObjectModel("cube", Path(__file__).parent / "cube.urdf")  # 0.05 m
AHEAD = (0.5, 0.0, 0.02)  # x, y, half height of a cube of 4 cm, base frame


class Cell:
    """A cube on a table ahead of an arm, and a pick of it."""

    def __init__(self, world, name):
        robot = load_robot(name)
        arm, hand, options = benchmark_arm(name, load_protocol("edgegrasp").camera)
        OPEN_TABLE.add_to(world)
        self.T_world_base = np.linalg.inv(options["robot"]["T_base_cloud"])
        x, y, _ = self.T_world_base[:3, :3] @ AHEAD + self.T_world_base[:3, 3]
        self.cube = load_object(world, CUBE, (x, y, TABLE_HEIGHT + 0.02), (0, 0, 0, 1), 0.8)
        (grasp,) = picks_of(robot, np.eye(4), boxes=(AHEAD,)).grasps
        self.T_world_hand = self.T_world_base @ grasp.T_cloud_hand
        planned = grasp.arm.trajectory
        model = panda() if hand is None else hand_model(hand)
        self.gripper = ArmDriver(world, model, arm, MIN_OPENING)
        self.gripper.motion = planned
        half_way = robot.forward_kinematics(planned.positions[planned.pregrasp_row // 2])
        self.on_the_way = (self.T_world_base @ half_way)[:3, 3]

    def grasp(self):
        objects = {self.cube.body.uid: self.cube}
        return run_grasp(self.gripper, self.T_world_hand, objects, to_the_end=True)


@pytest.fixture(params=["fr3", "ur5"])
def cell(request):
    with make_world("mujoco") as world:
        yield Cell(world, request.param)


def test_an_arm_lifts_a_cube_and_touches_nothing_before(cell):
    before = cell.cube.body.position
    result = cell.grasp()
    assert result.held is cell.cube
    assert not result.touched_on_the_way
    assert cell.cube.body.position[2] > before[2] + 0.03


def test_the_hand_arrives_where_the_grasp_is(cell):
    for _ in cell.gripper.go(cell.T_world_hand, away=False):
        pass
    palm = cell.T_world_hand[:3, :3] @ cell.gripper.model.centre + cell.T_world_hand[:3, 3]
    np.testing.assert_allclose(cell.gripper.body.position, palm, atol=0.002)


def test_what_stands_in_the_way_is_touched(cell):
    cell.gripper.world.add_box((0.3, 0.02, 0.2), cell.on_the_way, friction=0.5)
    result = cell.grasp()
    np.testing.assert_allclose(result.touched_on_the_way[0], cell.on_the_way, atol=0.2)
    assert result.cause in (FailureCause.APPROACH_COLLISION, FailureCause.START_COLLISION)
