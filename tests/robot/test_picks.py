import time
from dataclasses import replace
from itertools import count
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

pytest.importorskip("roboplan", reason="the extra robot is not installed")

from tests.checks import refusal
from tests.model.scenes import grid
from tests.robot import arms
from tests.robot.arms import BOXES, HALF, TURNED, hand_over, picks_of, scene_of, surface

from edgegrasp_model.gripper import HALF_TURN
from edgegrasp_model.options import parse_options
from edgegrasp_model.scene.cloud import CanonicalFrame, pose_matrix
from edgegrasp_results import Tracking
from edgegrasp_robot import load_robot, picks
from edgegrasp_robot.obstacles import _near_robot, arm_obstacles

CLOSE, CLOSE_ANGLE = 1e-3, np.deg2rad(0.2)  # metres, radians


@pytest.fixture(scope="module", params=["fr3", "ur5"])
def robot(request):
    return load_robot(request.param)


@pytest.fixture(scope="module")
def fr3():
    return load_robot("fr3")


def assert_pose(found, wanted):
    assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < CLOSE
    assert Rotation.from_matrix(found[:3, :3].T @ wanted[:3, :3]).magnitude() < CLOSE_ANGLE


def assert_motion(robot, motion):
    """It begins at home, rests where it should, and keeps to the limits all along."""
    np.testing.assert_allclose(motion.positions[0], robot.home, atol=1e-9)
    for row in (0, motion.pregrasp_row, motion.grasp_row, -1):
        assert np.abs(motion.velocities[row]).max() < 1e-6
    assert (motion.positions >= robot.lower).all()
    assert (motion.positions <= robot.upper).all()
    assert (np.abs(motion.velocities) <= robot.max_velocity).all()
    step = np.diff(motion.times)
    assert (step > 0).all()
    velocities = np.diff(motion.positions, axis=0) / step[:, None]
    assert (np.abs(velocities) <= robot.max_velocity).all()
    rate = np.abs(np.diff(motion.velocities, axis=0) / step[:, None])
    assert (rate <= 1.001 * robot.max_acceleration).all()


def plans_of(detection):
    return [(grasp, grasp.arm) for grasp in detection.grasps if grasp.arm and grasp.arm.reachable]


def touches(robot, joints, points):
    """Whether the robot, as the planner sees it, holds any of the points (N, 3), base frame."""
    return bool(_near_robot(robot, joints, points, 0.0).any())


def test_every_box_gets_a_motion_unless_reach_is_asked_for(robot):
    detection = picks_of(robot)
    assert detection.counts["reachable"] == detection.counts["with_trajectory"] == len(BOXES)
    assert detection.warnings == []
    detection = picks_of(robot, plan="reach")
    assert [plan.trajectory for _, plan in plans_of(detection)] == [None] * len(BOXES)
    assert "with_trajectory" not in detection.counts


@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(x=st.floats(0.4, 0.6), y=st.floats(-0.25, 0.25), tilt=st.floats(-3.1, 3.1))
def test_the_hand_comes_to_the_grasp_and_limits_are_kept(robot, x, y, tilt):
    T_base_cloud = pose_matrix(Rotation.from_euler("z", tilt).as_matrix(), TURNED[:3, 3])
    for grasp, plan in plans_of(picks_of(robot, T_base_cloud, boxes=((x, y, 0.04),))):
        T_base_hand = T_base_cloud @ grasp.T_cloud_hand
        assert_pose(robot.forward_kinematics(plan.grasp_joints), T_base_hand)
        before = T_base_hand @ pose_matrix(np.eye(3), (0.0, 0.0, -0.05))
        assert_pose(robot.forward_kinematics(plan.pregrasp_joints), before)
        motion = plan.trajectory
        assert motion is not None
        rows = motion.positions[[motion.pregrasp_row, motion.grasp_row]]
        np.testing.assert_allclose(rows, [plan.pregrasp_joints, plan.grasp_joints], atol=1e-6)
        assert_motion(robot, motion)
        for joints in motion.positions[motion.pregrasp_row : motion.grasp_row + 1]:
            off = robot.forward_kinematics(joints)[:3, 3] - T_base_hand[:3, 3]
            assert np.linalg.norm(np.cross(off, T_base_hand[:3, 2])) < 0.002


def test_the_same_request_gives_the_same_picks_however_the_base_is_turned(fr3):
    one, other, again = picks_of(fr3, np.eye(4)), picks_of(fr3), picks_of(fr3)
    assert [grasp.object for grasp in one.grasps] == [grasp.object for grasp in other.grasps]
    every = zip(plans_of(one), plans_of(other), plans_of(again), strict=True)
    for (_, first), (_, second), (_, third) in every:
        np.testing.assert_allclose(first.grasp_joints, second.grasp_joints, atol=2e-3)
        np.testing.assert_array_equal(second.trajectory.positions, third.trajectory.positions)


def test_the_motion_goes_around_what_is_seen(fr3):
    turned = fr3.home.copy()
    turned[0] = -1.4  # beside the table
    seen = grid(np.arange(0.25, 0.75, 0.008), [-0.33], np.arange(0.0, 0.5, 0.008))
    detection = picks_of(fr3, joints=turned, boxes=BOXES[:1], more=[seen])
    ((_, plan),) = plans_of(detection)
    assert not any(touches(fr3, joints, seen) for joints in plan.trajectory.positions)
    direct = np.linspace(turned, plan.pregrasp_joints, 60)
    assert any(touches(fr3, joints, seen) for joints in direct)  # it had to go around


def test_searches_without_a_path_end(fr3, monkeypatch):
    """As from a start that is shut in, where the planner would go on for ever."""
    searched = []

    def lost(scene, options):
        def plan(start, end):
            searched.append(options.max_planning_time)
            time.sleep(options.max_planning_time)
            raise RuntimeError

        return Mock(plan=plan)

    monkeypatch.setattr("edgegrasp_robot.picks.RRT", lost)
    monkeypatch.setattr("edgegrasp_robot.picks.PATH_SECONDS", 0.1)
    detection = picks_of(fr3)
    assert detection.counts["reachable"] == len(searched) == len(BOXES)
    assert detection.counts["with_trajectory"] == 0
    assert "no trajectory" in detection.warnings[0]
    assert sum(searched) < 0.11


def voxels_around(fr3, shift=0.0, raised=0.0, more=()):
    """Voxels that the arm avoids; metres by which the scene's origin and the table are moved."""
    scene, _ = scene_of(fr3, more=more)
    T, T_base_cloud = scene.frame.T_canonical_cloud.copy(), TURNED.copy()
    T[:2, 3] += shift
    T_base_cloud[2, 3] += raised
    asked = {"name": "fr3", "T_base_cloud": T_base_cloud.tolist(), "joints": fr3.home.tolist()}
    robot = parse_options({"robot": asked}).robot
    with arm_obstacles(fr3, replace(scene, frame=CanonicalFrame(T)), robot, []) as around:
        return around.voxels


def test_which_part_of_the_cloud_was_selected_changes_no_voxel(fr3):
    # The origin is the mean of what was selected.
    np.testing.assert_allclose(voxels_around(fr3), voxels_around(fr3, shift=0.004), atol=1e-9)


@pytest.mark.parametrize(("raised", "seen"), [(0.0, False), (0.3, True)])
def test_what_is_below_the_table_is_in_the_way_of_an_arm_that_stands_lower(fr3, raised, seen):
    leg, wall = grid([0.605], [0.005], [-0.2]), grid([2.5], [0.0], [0.5])  # out of reach
    voxels = voxels_around(fr3, raised=raised, more=[leg, wall])
    assert (voxels[:, 2] < raised - 0.1).any() == seen
    assert voxels[:, 0].max() < 1.0


def test_what_is_out_of_reach_is_counted_and_comes_last(fr3):
    detection = picks_of(fr3, boxes=((1.4, 0.0, 0.05), BOXES[0]))
    assert detection.counts["out_of_reach"] == 1
    assert [grasp.arm.reachable for grasp in detection.grasps] == [True, False]
    assert detection.grasps[0].object == 1  # of a lower score
    assert [one.best_score for one in detection.objects] == pytest.approx([0.9, 0.8])


def test_a_lid_over_an_object_and_a_hand_that_touches_something_are_collisions(fr3):
    lid = {"kind": "box", "min": (0.4, -1.0, 0.2), "max": (0.6, 0.1, 0.22)}
    under = {"collision": {"obstacles": [lid]}}
    detection = picks_of(fr3, np.eye(4), boxes=BOXES[:1], options=under)
    assert detection.counts["arm_collision"] == 1
    assert "arm's reach" in detection.warnings[0]

    def colliding(scene, detection):
        grasps = [replace(grasp, collision_free=False) for grasp in detection.grasps]
        return scene, replace(detection, grasps=grasps)

    found = picks_of(fr3, changed=colliding)
    assert not any(grasp.arm.reachable for grasp in found.grasps)
    assert found.counts["hand_collision"] == len(BOXES)


def test_the_arm_meets_every_reading_of_the_scene(fr3):
    sheet = grid(np.arange(0.4, 0.6, 0.008), np.arange(-0.1, 0.1, 0.008), [0.2])
    assert picks_of(fr3, boxes=BOXES[:1], more=[sheet]).counts["reachable"] == 0
    assert picks_of(fr3, boxes=BOXES[:1]).counts["reachable"] == 1


@pytest.mark.parametrize(("x", "objects", "first"), [(0.55, [2, 0], "kept"), (1.5, [0, 2], "lost")])
def test_a_kept_grasp_stays_first_where_the_arm_reaches_it(fr3, x, objects, first):
    def followed(scene, detection):
        best, other, third = (replace(g, id=g.object) for g in detection.grasps)
        tracking = Tracking("kept", 3)
        return scene, replace(detection, grasps=[third, best, other], tracking=tracking)

    boxes = (*BOXES[:2], (x, -0.2, 0.04))
    found = picks_of(fr3, np.eye(4), boxes=boxes, changed=followed)
    assert [grasp.object for grasp in found.grasps if grasp.object != 1] == objects
    assert found.tracking == Tracking(first, 3)


BELOW_SIGN, ABOVE = (0.5, -0.8, 0.1), (0.5, 0.0, 1.2)


@pytest.mark.parametrize(("eyes", "reachable"), [([BELOW_SIGN], 0), ([BELOW_SIGN, ABOVE], 1)])
def test_what_no_camera_saw_is_avoided_where_asked(fr3, eyes, reachable):
    """A low camera sees a box below a sign, and not whether anything hangs over the box."""
    sign = grid(np.arange(0.3, 0.7, 0.008), [-0.4], np.arange(0.13, 0.6, 0.008))
    for avoid, expected in ((False, 1), (True, reachable)):
        detection = picks_of(fr3, boxes=BOXES[:1], more=[sign], eyes=eyes, avoid_unseen=avoid)
        assert detection.counts["reachable"] == expected
        assert detection.counts["arm_collision"] == 1 - expected


def test_what_several_cameras_side_by_side_did_not_see_is_avoided(fr3):
    sign = grid(np.arange(0.3, 0.7, 0.008), [-0.6], np.arange(0.16, 0.4, 0.008))
    eyes = [(0.5 + 0.02 * row, -0.75, 0.12) for row in range(3)]
    found = picks_of(fr3, boxes=BOXES[:1], more=[sign], eyes=eyes, avoid_unseen=True)
    assert found.counts["reachable"] == 0


def test_a_wall_behind_a_sign_shows_nothing_of_what_the_sign_hides(fr3):
    signs = [
        grid(np.arange(0.45, 0.55, 0.008), [-0.4], np.arange(0.25, 0.5, 0.008)),
        grid([0.9], np.arange(-0.12, 0.12, 0.008), np.arange(0.25, 0.6, 0.008)),
    ]
    wall = grid([-0.5], np.arange(-0.9, 0.9, 0.008), np.arange(0.0, 1.6, 0.008))
    eyes = [(0.5, -0.8, 0.1), (1.3, 0.0, 0.1)]
    asked = {"boxes": BOXES[:1], "eyes": eyes, "avoid_unseen": True}
    assert picks_of(fr3, more=[*signs, wall], **asked).counts["reachable"] == 0


def test_an_object_is_carried_out_of_its_own_shadow(fr3, monkeypatch):
    def front(x, y, half):  # a camera over the base sees the top, and the side toward it
        points = surface(x, y, half)
        return points[(points[:, 2] > 2 * half - 1e-6) | (points[:, 0] < x - HALF + 0.001)]

    monkeypatch.setattr(arms, "surface", front)
    asked = {"eyes": [(-0.1, 0.0, 0.7)], "avoid_unseen": True, "place": {"region": TRAY}}
    assert picks_of(fr3, boxes=BOXES[:1], **asked).counts["with_trajectory"] == 1


TOUCHING = [{"kind": "box", "min": (x, 0.5, -0.1), "max": (x + 0.2, 0.9, 0.3)} for x in (0.4, 0.5)]


@pytest.mark.parametrize(
    "collision", [{"approach_length": 0.0}, {"approach_length": 0.01}, {"obstacles": TOUCHING}]
)
def test_a_motion_may_have_no_straight_approach_and_obstacles_may_touch(fr3, collision):
    detection = picks_of(fr3, np.eye(4), options={"collision": collision})
    assert detection.counts["with_trajectory"] == len(BOXES)


def test_the_arm_itself_is_no_object(fr3):
    """The camera sees the hand, and takes it for an object."""
    hand = fr3.forward_kinematics(fr3.home)[:3, 3] + np.random.default_rng(0).uniform(
        -0.02, 0.02, (50, 3)
    )
    seen = (hand - TURNED[:3, 3]) @ TURNED[:3, :3]

    def with_hand(scene, detection):
        grasps = [replace(detection.grasps[0], object=7), *detection.grasps]
        return with_points(scene, seen, 7), replace(detection, grasps=grasps)

    found = picks_of(fr3, changed=with_hand)
    assert [grasp.object for grasp in found.grasps] == [0, 1, 2]
    assert found.counts["on_arm"] == 1


def with_points(scene, points, number):
    """A scene with more points (N, 3) of an object, which its cloud lacks."""
    return replace(
        scene,
        points_in_cloud=np.concatenate([scene.points_in_cloud, points.astype(np.float32)]),
        object_of_point=np.append(scene.object_of_point, np.full(len(points), number)),
    )


def test_no_time_gives_no_motion_and_says_so(fr3, monkeypatch):
    found = picks_of(fr3, until=0.0)
    assert [grasp.arm for grasp in found.grasps] == [None] * len(BOXES)
    assert "time ran out" in found.warnings[-1]
    clock = count()
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    # It is asked at first, before each grasp, and before a motion.
    found = picks_of(fr3, boxes=BOXES[:1], until=3.5)
    assert found.grasps[0].arm.reachable
    assert found.grasps[0].arm.trajectory is None
    assert "1 grasps within reach have no trajectory" in found.warnings[0]


def test_a_hand_that_is_the_same_turned_comes_the_nearer_way(robot):
    def turned(scene, detection):
        poses = ((one, one.T_cloud_hand * HALF_TURN) for one in detection.grasps)
        grasps = [replace(one, T_cloud_hand=pose, T_cloud_tcp=pose) for one, pose in poses]
        return scene, replace(detection, grasps=grasps)

    (grasp, plan), *_ = plans_of(picks_of(robot))
    (other, same), *_ = plans_of(picks_of(robot, changed=turned))
    for name in ("T_cloud_hand", "T_cloud_tcp"):
        np.testing.assert_allclose(getattr(other, name), getattr(grasp, name), atol=1e-6)
    np.testing.assert_array_equal(same.grasp_joints, plan.grasp_joints)


@pytest.mark.parametrize(("share", "motions"), [(0.03, 1), (0.3, 0)])
def test_strays_over_an_object_do_not_hold_it_down(fr3, share, motions):
    """Some of its points are seen once more, 12 cm higher."""
    up = np.linalg.inv(TURNED)[:3, 2]

    def with_strays(scene, detection):
        strays = scene.points_in_cloud[:: round(1 / share)] + 0.12 * up
        return with_points(scene, strays, -1), detection

    lift = {"collision": {"retreat_length": 0.15, "retreat_direction": "up"}}
    found = picks_of(fr3, boxes=BOXES[:1], options=lift, changed=with_strays)
    assert found.counts["with_trajectory"] == motions


TRAY = {"min": [0.3, -0.5, 0.0], "max": [0.6, -0.3, 0.3]}
START_IN_THE_TABLE = [0.0, 1.3, 0.0, -1.0, 0.0, 2.2, 0.8]
START_IN_ITSELF = [0.0, -1.7, 0.0, -3.0, 0.0, 0.6, 0.0]
REFUSED = [  # what changes, and what is said: a field, of its value, of the fix
    ({"joints": [0.0] * 3}, "robot.joints", "", "Send 7"),
    ({"joints": [3, 0, 0, -2, 0, 2, 0]}, "robot.joints.0", "", "fr3_joint1"),
    ({"joints": START_IN_THE_TABLE}, "robot.joints", " and the support touch", ""),
    ({"joints": START_IN_ITSELF}, "robot.joints", "touch", ""),
    ({"boxes": ((0.08, 0.0, 0.1),)}, "robot.T_base_cloud", "object", ""),
    ({"options": {"collision": "ignore"}}, "collision.mode", "", ""),
    ({"options": {"gripper": "barrett"}}, "gripper", "", ""),
    ({"place": {}}, "robot.place", "", ""),
    ({"place": {"region": TRAY, "T_base_object": np.eye(4).tolist()}}, "robot.place", "", ""),
    ({"place": {"T_base_object": [[0.0] * 4] * 4}}, "robot.place.T_base_object", "", ""),
    ({"place": {"region": {"min": TRAY["max"], "max": TRAY["min"]}}}, "robot.place.region", "", ""),
]


def test_a_robot_or_a_place_that_cannot_be_is_refused(fr3):
    for changed, field, value, fix in REFUSED:
        with refusal(f"options.{field}", value, fix):
            picks_of(fr3, **changed)
    for pose in (np.full(16, np.nan), np.zeros(16), 2 * np.eye(4)):
        robot = {"name": "fr3", "T_base_cloud": pose.ravel().tolist(), "joints": [0.0] * 7}
        with refusal("options.robot.T_base_cloud."):
            parse_options({"robot": robot})
    assert len(plans_of(picks_of(fr3))) == len(BOXES)  # nothing of it is left


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
        assert_pose(robot.forward_kinematics(there), plan.T_base_place)
        points = placed(grasp, plan)
        assert (points > np.array(TRAY["min"]) - 0.002).all()
        assert (points < np.array(TRAY["max"]) + 0.002).all()
        assert points[:, 2].min() < 0.01


def test_obstacles_of_the_request_are_not_put_into_either(fr3):
    block = {"kind": "oriented_box", "center": [0.45, -0.4, 0.06], "half_extents": [HALF] * 3}
    T_cloud_base = np.linalg.inv(TURNED)
    turn = Rotation.from_matrix(T_cloud_base[:3, :3]).as_quat().tolist()
    there = (T_cloud_base @ [*block["center"], 1.0])[:3].tolist()
    options = {"collision": {"obstacles": [block | {"center": there, "quaternion": turn}]}}
    found = picks_of(fr3, boxes=BOXES[:1], options=options, place={"region": TRAY}, plan="reach")
    ((_, plan),) = plans_of(found)
    assert np.abs(plan.T_base_place[:2, 3] - block["center"][:2]).max() > HALF


def test_joints_may_be_a_hair_beyond_a_limit(fr3):
    joints = np.where(np.arange(7) == 3, fr3.upper + 1e-4, fr3.home)
    joints[0] = fr3.lower[0] - 1e-4
    (_, plan), *_ = plans_of(picks_of(fr3, joints=joints))
    np.testing.assert_allclose(plan.trajectory.positions[0], joints, atol=1e-3)


def put_at(z):
    """A place that an upright object's middle is put at, in the tray."""
    return {"T_base_object": pose_matrix(np.eye(3), (0.4, -0.35, z)).tolist()}


def test_an_object_is_put_in_a_pose(fr3):
    place = put_at(0.08)
    ((grasp, plan),) = plans_of(picks_of(fr3, boxes=BOXES[:1], place=place, plan="reach"))
    middle = (placed(grasp, plan).min(axis=0) + placed(grasp, plan).max(axis=0)) / 2
    np.testing.assert_allclose(middle, (0.4, -0.35, 0.08), atol=0.002)
    assert plan.trajectory is None


@pytest.mark.parametrize(("below", "lowest"), [(0.0095, 0.0), (0.1, None)])
def test_an_object_is_not_pressed_into_the_support(fr3, below, lowest):
    region = TRAY | {"min": [*TRAY["min"][:2], -below]}
    found = picks_of(fr3, boxes=BOXES[:1], place={"region": region}, plan="reach")
    points = [placed(grasp, plan)[:, 2].min() for grasp, plan in plans_of(found)]
    assert points == ([] if lowest is None else [pytest.approx(lowest, abs=0.002)])
    there = put_at(BOXES[0][2] - below)  # given to the millimetre: it stays there
    assert picks_of(fr3, boxes=BOXES[:1], place=there, plan="reach").counts["no_place"] == 1


def test_a_foot_that_no_camera_saw_is_not_pressed_into_the_support(fr3):
    def from_above(scene, detection):
        (one,), up = detection.objects, TURNED[2, :3]
        high = scene.points_in_cloud @ up + TURNED[2, 3] > 0.02
        half = one.half_extents - np.float32([0.0, 0.0, 0.01])
        seen = replace(one, center=one.center + 0.01 * up, half_extents=half)
        parts = {"points_in_cloud": scene.points_in_cloud[high]}
        parts["object_of_point"] = scene.object_of_point[high]
        return replace(scene, **parts), replace(detection, objects=[seen])

    asked = {"place": {"region": TRAY}, "plan": "reach", "changed": from_above}
    ((grasp, plan),) = plans_of(picks_of(fr3, boxes=BOXES[:1], **asked))
    assert placed(grasp, plan)[:, 2].min() > -0.002
    asked["place"] = put_at(0.04)  # where what was seen of it would stand
    assert picks_of(fr3, boxes=BOXES[:1], **asked).counts["no_place"] == 1


def test_an_arm_may_stand_lower_than_the_table(fr3):
    found = picks_of(fr3, raised=0.3)
    assert found.counts["with_trajectory"] > 0
    for _, plan in plans_of(found):
        places = np.array([fr3.forward_kinematics(row)[:3, 3] for row in plan.trajectory.positions])
        assert places[places[:, 0] > 0.3, 2].min() > 0.3  # where the table is


def test_what_stands_in_the_region_is_not_met(fr3):
    there = surface(0.45, -0.4, 0.06)
    detection = picks_of(fr3, boxes=BOXES[:1], more=[there], place={"region": TRAY})
    ((grasp, plan),) = plans_of(detection)
    assert np.abs(placed(grasp, plan)[:, None, :2] - there[None, :, :2]).max(axis=2).min() > 0.0
    assert np.abs(plan.T_base_place[:2, 3] - (0.45, -0.4)).max() > HALF


def test_a_grasp_that_holds_more_than_its_object_does_not_rule_out_others_of_it(fr3):
    def stacked(scene, detection):
        raised = np.float32([0.0, 0.0, 0.06])
        points = scene.points_in_cloud + raised * (scene.object_of_point == 0)[:, None]
        readings = np.concatenate([points, scene.readings[len(points) :]])
        box, block = detection.objects
        poses = [hand_over(fr3.gripper, 0.5, 0.0, 0.04 - deep / 2) for deep in (0.025, -0.005)]
        grasps = [replace(detection.grasps[0], T_cloud_hand=np.float32(pose)) for pose in poses]
        objects = [replace(box, center=box.center + raised), block]
        found = replace(detection, grasps=grasps, objects=objects)
        return replace(scene, points_in_cloud=points, readings=readings), found

    boxes = ((0.5, 0.0, 0.01), (0.5, 0.0, 0.03))
    place = {"region": {"min": (0.3, -0.5, 0.0), "max": (0.6, -0.3, 0.3)}}
    found = picks_of(fr3, np.eye(4), boxes=boxes, changed=stacked, place=place)
    assert found.counts["reachable"] == 1


def test_picks_whose_motions_are_found_late_are_sorted_too(fr3, monkeypatch):
    def several(scene, detection):
        one, other = detection.grasps
        grasps = [replace(one, score=0.9)] * 6 + [replace(other, score=0.895)]
        return scene, replace(detection, grasps=grasps)

    motion, tried = picks._Arm.motion, count()
    late = lambda self, pick: motion(self, pick) if next(tried) >= 5 else pick  # noqa: E731
    monkeypatch.setattr(picks._Arm, "motion", late)
    boxes = ((0.0, -0.5, 0.04), (0.5, 0.0, 0.05))
    found = picks_of(fr3, np.eye(4), boxes=boxes, options={"top_k": 2}, changed=several)
    away = [np.abs(grasp.arm.pregrasp_joints - fr3.home).max() for grasp in found.grasps]
    keys = 0.02 * np.array(away) - [grasp.score for grasp in found.grasps]
    assert (np.diff(keys) >= 0.0).all()


def test_without_a_place_nothing_is_within_reach(fr3):
    for region in (
        {"min": [0.3, -0.5, 0.0], "max": [0.33, -0.3, 0.3]},  # narrower than the object
        {"min": [1.5, -0.5, 0.0], "max": [1.8, -0.3, 0.3]},  # beyond the arm
    ):
        detection = picks_of(fr3, place={"region": region})
        assert detection.counts["no_place"] == len(BOXES)
        assert detection.counts["reachable"] == 0
        assert "arm's reach" in detection.warnings[0]
