"""A table with boxes on it as an arm meets it: a scene and hands over the boxes, no network."""

import numpy as np
from scipy.spatial.transform import Rotation
from tests.model import scenes
from tests.model.scenes import grid

from edgegrasp_model.options import SupportPlane, parse_options
from edgegrasp_model.scene.cloud import CanonicalFrame, pose_matrix
from edgegrasp_results import DetectedObject, Detection, Grasp, GripperOutline
from edgegrasp_robot import options_for_robot, plan_picks

BOXES = ((0.5, 0.0, 0.05), (0.55, 0.2, 0.03), (0.45, -0.2, 0.04))  # x, y, half height; base frame
HALF = 0.02  # metres
# T_base_cloud of a cloud whose frame is turned and moved.
TURNED = pose_matrix(Rotation.from_euler("xyz", (0.3, -0.2, 1.0)).as_matrix(), (0.2, -0.3, 0.5))


def surface(x, y, half_height):
    """Points (N, 3), 4 mm apart, on the sides and top of a box that stands on z = 0."""
    side = np.arange(-HALF, HALF + 1e-9, 0.004)
    up = np.arange(0.0, 2 * half_height + 1e-9, 0.004)
    walls = grid([-HALF, HALF], side, up), grid(side, [-HALF, HALF], up)
    return np.concatenate([grid(side, side, [2 * half_height]), *walls]) + np.array((x, y, 0.0))


def hand_over(gripper, x, y, half_height):
    """T_base_hand (4, 4) from above, the fingers closing on the box's sides."""
    return pose_matrix(np.diag([1.0, -1.0, -1.0]), (x, y, 2 * half_height + gripper.tip_z - 0.02))


def scene_of(robot, T_base_cloud=TURNED, boxes=BOXES, more=(), eyes=()):
    """A scene of boxes on a table, and a detection with a hand over each box."""
    table = grid(np.arange(0.3, 0.8, 0.01), np.arange(-0.4, 0.4, 0.01), [0.0])
    things = [surface(*box) for box in boxes]
    T_cloud_base = np.linalg.inv(T_base_cloud)

    def in_cloud(points):
        return (points @ T_cloud_base[:3, :3].T + T_cloud_base[:3, 3]).astype(np.float32)

    objects = in_cloud(np.concatenate(things))
    number = np.repeat(np.arange(len(things)), [len(one) for one in things])
    up = T_cloud_base[:3, 2]
    frame = CanonicalFrame.from_scene(objects, up, T_cloud_base[:3, :3] @ (1.0, 0.0, 0.7))
    foot = frame.points_from_cloud(in_cloud(np.zeros((1, 3))))[0]
    scene = scenes.scene_of(
        objects,
        frame=frame,
        object_of_point=number,
        support=SupportPlane(normal=(0.0, 0.0, 1.0), offset=float(foot[2])),
        viewpoints=frame.points_from_cloud(in_cloud(np.reshape(eyes, (-1, 3)))),
        readings=np.concatenate([objects, in_cloud(table), *map(in_cloud, more)]),
    )
    poses = [T_cloud_base @ hand_over(robot.gripper, *box) for box in boxes]
    grasps = [
        Grasp(0.9 - 0.1 * row, pose.astype(np.float32), pose.astype(np.float32), 0.08, pose[:3, 3],
              pose[:3, 3], pose[:3, 2].astype(np.float32), True, 0.01, row)
        for row, pose in enumerate(poses)
    ]  # fmt: skip
    gripper = GripperOutline(robot.gripper.name, robot.gripper.palm_z, robot.gripper.tip_z)
    counts = {"scored": len(grasps), "returned": len(grasps)}
    turn = Rotation.from_matrix(T_cloud_base[:3, :3]).as_quat()
    found = [
        DetectedObject(
            row, 99, in_cloud([box])[0], np.float32([HALF, HALF, box[2]]), turn, None, 0.9, None
        )
        for row, box in enumerate(boxes)
    ]
    detection = Detection(grasps, counts, {}, "", gripper, objects=found)
    return scene, detection


def picks_of(
    robot,
    T_base_cloud=TURNED,
    joints=None,
    plan="motion",
    options=None,
    place=None,
    avoid_unseen=False,
    changed=lambda scene, detection: (scene, detection),
    until=np.inf,
    raised=0.0,
    **given,
):
    """The detection with the arm's plans, the table raised by metres over the arm's base."""
    scene, detection = changed(*scene_of(robot, T_base_cloud, **given))
    T_base_cloud = T_base_cloud.copy()
    T_base_cloud[2, 3] += raised
    asked = {"name": robot.name, "T_base_cloud": T_base_cloud.tolist(), "plan": plan}
    asked |= {"place": place, "avoid_unseen": avoid_unseen}
    asked["joints"] = (robot.home if joints is None else np.asarray(joints)).tolist()
    parsed = parse_options({"robot": asked, **(options or {})})
    options_for_robot(parsed, robot)
    return plan_picks(detection, scene, parsed, robot, until)
