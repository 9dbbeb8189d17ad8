"""Grasps on the handle of a mug, which a mask or a cloud of its own marks, and on a bowl's rim."""

import numpy as np
from tests.model.rendered import box, camera, depth_image, render, seen_box, table, to_world

from edgegrasp_client import GraspClient, object_in_scene, on_mask

ANGLES = np.arange(16) * np.pi / 8
STAVES = [
    box((0.033 * np.cos(a), 0.033 * np.sin(a), 0.04), (0.0025, 0.00725, 0.04), a) for a in ANGLES
]
HANDLE = [
    box((0.049, 0, 0.062), (0.015, 0.006, 0.004)),
    box((0.049, 0, 0.018), (0.015, 0.006, 0.004)),
    box((0.064, 0, 0.04), (0.004, 0.006, 0.026)),
]


def test_grasps_are_on_what_a_mask_or_the_cloud_of_an_object_marks(real_server) -> None:
    scene, pose = [*HANDLE, *STAVES, table()], camera(0.8, 0.5, 0.5)
    cloud, number = render(scene, pose), seen_box(scene, pose)
    height, width = cloud.shape[:2]
    handle = ((number >= 0) & (number < len(HANDLE))).reshape(height, width)
    assert handle.sum() > 100
    image = depth_image(cloud)
    marked, segment_ids = object_in_scene(cloud[handle], cloud[number.reshape(height, width) >= 0])
    with GraspClient(real_server.grpc_address) as client:
        by_mask = client.detect(depth_images=[image], **on_mask(handle, {"top_k": 5}))
        by_object = client.detect(marked, segment_ids=segment_ids, viewpoint=(0, 0, 0), top_k=5)
    for found in (by_mask, by_object):
        contacts = np.array([grasp.contact_point for grasp in found.grasps])
        assert len(contacts) == 5
        away = [bar.distance(to_world(pose, contacts)) for bar in HANDLE]
        assert (np.min(away, axis=0) < 0.008).all()


RADIUS, RIM = 0.06, 0.055  # metres; the hand opens by 0.08
TURNS = np.arange(24) * np.pi / 12
WALL = [
    box((RADIUS * np.cos(a), RADIUS * np.sin(a), RIM / 2), (0.0015, 0.0085, RIM / 2), a)
    for a in TURNS
]
FLOOR = box((0, 0, 0.002), (0.05, 0.05, 0.002))


def test_the_rim_of_a_bowl_is_grasped_with_one_finger_inside(real_server) -> None:
    scene, pose = [*WALL, FLOOR, table()], camera(0.8, 0.5, 0.5)
    image = depth_image(render(scene, pose))
    with GraspClient(real_server.grpc_address) as client:
        best = client.detect(depth_images=[image]).grasps[0]
    assert best.score > 0.5
    tips = best.T_cloud_tcp @ np.array([[0, side, 0, 1] for side in (0.04, -0.04)]).T
    inside, outside = sorted(np.linalg.norm(to_world(pose, tips[:3].T)[:, :2], axis=1))
    assert inside < RADIUS < outside
