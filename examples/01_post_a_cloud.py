"""Grasps of a cloud file, from a running server.

usage: python examples/01_post_a_cloud.py cloud.ply [address]

The address is host:port for gRPC (127.0.0.1:50051 unless given) or a URL for REST. Needs only the
base install, `pip install edgegrasp`.
"""

import sys

from edgegrasp_client import GraspClient


def main(path: str, address: str = "127.0.0.1:50051") -> None:
    """Print the five best grasps of the cloud in a file."""
    with GraspClient(address) as client:
        detection = client.detect(path, seed=0, top_k=5)
    for warning in detection.warnings:
        print("warning:", warning)
    for grasp in detection.grasps:
        x, y, z = grasp.T_cloud_tcp[:3, 3]
        print(f"score {grasp.score:.3f}, TCP at {x:.3f}, {y:.3f}, {z:.3f} m")
    print("counts:", detection.counts)


if __name__ == "__main__":
    main(*sys.argv[1:])
