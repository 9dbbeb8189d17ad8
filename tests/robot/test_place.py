import numpy as np
import pytest

pytest.importorskip("roboplan", reason="the extra robot is not installed")

from tests.robot.arms import BOXES, HALF, TURNED, picks_of, surface
from tests.robot.test_picks import assert_motion, assert_pose, plans_of

from edgegrasp_model.errors import InvalidRequest

TRAY = {"min": [0.3, -0.5, 0.0], "max": [0.6, -0.3, 0.3]}


def placed(grasp, plan):
    """Points (N, 3) of a grasp's object where it is put down, base frame."""
    x, y, half = BOXES[grasp.object]
    T = plan.T_base_place @ np.linalg.inv(TURNED @ grasp.T_cloud_hand)
    return surface(x, y, half) @ T[:3, :3].T + T[:3, 3]


def test_objects_are_put_into_a_region_in_one_motion(robot):
    detection = picks_of(robot, place={"region": TRAY})
    assert detection.counts["with_trajectory"] == len(BOXES)
    for grasp, plan in plans_of(detection):
        motion = plan.trajectory
        assert_motion(robot, motion)
        there = motion.positions[motion.release_row]
        assert np.abs(motion.velocities[motion.release_row]).max() < 1e-6
        np.testing.assert_allclose(there, plan.place_joints, atol=1e-6)
        assert_pose(robot.hand_pose(there), plan.T_base_place)
        points = placed(grasp, plan)
        assert (points > np.array(TRAY["min"]) - 0.002).all()
        assert (points < np.array(TRAY["max"]) + 0.002).all()
        assert points[:, 2].min() < 0.01


def test_an_object_is_put_in_a_pose(fr3):
    pose = np.eye(4)
    pose[:3, 3] = 0.4, -0.35, 0.08
    place = {"T_base_object": pose.tolist()}
    ((grasp, plan),) = plans_of(picks_of(fr3, boxes=BOXES[:1], place=place, plan="reach"))
    middle = (placed(grasp, plan).min(axis=0) + placed(grasp, plan).max(axis=0)) / 2
    np.testing.assert_allclose(middle, pose[:3, 3], atol=0.002)
    assert plan.trajectory is None


def test_what_stands_in_the_region_is_not_met(fr3):
    there = surface(0.45, -0.4, 0.06)
    detection = picks_of(fr3, boxes=BOXES[:1], more=[there], place={"region": TRAY})
    ((grasp, plan),) = plans_of(detection)
    gap = np.abs(placed(grasp, plan)[:, None, :2] - there[None, :, :2]).max(axis=2)
    assert gap.min() > 0.0
    assert np.abs(plan.T_base_place[:2, 3] - (0.45, -0.4)).max() > HALF


@pytest.mark.parametrize(
    "region",
    [
        {"min": [0.3, -0.5, 0.0], "max": [0.33, -0.3, 0.3]},  # narrower than the object
        {"min": [1.5, -0.5, 0.0], "max": [1.8, -0.3, 0.3]},  # beyond the arm
    ],
)
def test_without_a_place_nothing_is_within_reach(fr3, region):
    detection = picks_of(fr3, place={"region": region})
    assert detection.counts["no_place"] == len(BOXES)
    assert detection.counts["reachable"] == 0
    assert "arm's reach" in detection.warnings[0]


@pytest.mark.parametrize(
    ("place", "field"),
    [
        ({}, "options.robot.place"),
        ({"region": TRAY, "T_base_object": np.eye(4).tolist()}, "options.robot.place"),
        ({"T_base_object": np.zeros((4, 4)).tolist()}, "options.robot.place.T_base_object"),
        ({"region": {"min": TRAY["max"], "max": TRAY["min"]}}, "options.robot.place.region"),
    ],
)
def test_a_place_that_is_none_is_refused(fr3, place, field):
    with pytest.raises(InvalidRequest) as error:
        picks_of(fr3, place=place)
    assert error.value.field.startswith(field)
