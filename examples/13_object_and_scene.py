"""Grasps of one object, whose cloud comes apart from that of its scene.

usage: python examples/13_object_and_scene.py object.npy scene.npy [address]

Both are (N, 3) metres in the frame of the camera, which stands at its origin. The scene may hold
the object too. Needs only the base install, `pip install edgegrasp`.
"""

import sys

import numpy as np

from edgegrasp_client import GraspClient, object_in_scene


def main(object_file: str, scene_file: str, address: str = "127.0.0.1:50051") -> None:
    """Print the best grasps of the object; the scene is what the hand must not meet."""
    cloud, segment_ids = object_in_scene(np.load(object_file), np.load(scene_file))
    with GraspClient(address) as client:
        detection = client.detect(
            cloud, segment_ids=segment_ids, viewpoint=(0.0, 0.0, 0.0), top_k=5
        )
    for warning in detection.warnings:
        print("warning:", warning)
    for grasp in detection.grasps:
        x, y, z = grasp.contact_point
        print(f"score {grasp.score:.3f}, contact at {x:.4f}, {y:.4f}, {z:.4f} m of the camera")


if __name__ == "__main__":
    main(*sys.argv[1:])
