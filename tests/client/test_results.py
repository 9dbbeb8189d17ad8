"""What can be asked of a grasp."""

import numpy as np

from edgegrasp_client import GraspClient


def test_poses_before_and_after_a_grasp(dummy_server, cloud: np.ndarray) -> None:
    with GraspClient(dummy_server.grpc_address) as client:
        detection = client.detect(cloud, top_k=1, gripper="robotiq-2f-85")
    (grasp,) = detection.grasps
    hand = grasp.T_cloud_hand
    np.testing.assert_allclose(grasp.pregrasp(0.1), hand @ moved(-0.1), atol=1e-6)
    np.testing.assert_allclose(grasp.retreat(0.2), hand @ moved(-0.2), atol=1e-6)
    up = grasp.retreat(0.3, 2 * detection.up)
    np.testing.assert_array_equal(up[:3, :3], hand[:3, :3])
    np.testing.assert_allclose(up[:3, 3] - hand[:3, 3], 0.3 * detection.up, atol=1e-6)
    assert detection.gripper.name == "robotiq-2f-85"


def moved(z: float) -> np.ndarray:
    transform = np.eye(4)
    transform[2, 3] = z
    return transform
