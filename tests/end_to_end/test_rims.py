"""Grasps on the rim of a bowl that is wider than the hand opens."""

import numpy as np
from tests.model.rendered import box, camera, depth_image, render, table, to_world

from edgegrasp_client import GraspClient

RADIUS, RIM = 0.06, 0.055  # metres; the hand opens by 0.08
ANGLES = np.arange(24) * np.pi / 12
WALL = [
    box((RADIUS * np.cos(a), RADIUS * np.sin(a), RIM / 2), (0.0015, 0.0085, RIM / 2), a)
    for a in ANGLES
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
