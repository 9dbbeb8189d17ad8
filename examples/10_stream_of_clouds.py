"""A controller's loop: one stream, cloud after cloud, the best grasp of each.

usage: python examples/10_stream_of_clouds.py cloud.ply [another.ply ...] [--server ADDRESS]

ADDRESS is host:port for gRPC (127.0.0.1:50051 unless given) or a URL for REST. Needs only the base
install, `pip install edgegrasp`.
"""

import argparse
from collections.abc import Iterator

from edgegrasp_client import GraspClient, GraspClientError, StreamRequest


def clouds(paths: list[str]) -> Iterator[StreamRequest]:
    """The clouds to send; a controller would yield what its camera sees, for ever."""
    for path in paths:
        # A grasp that comes later than two seconds is of a scene that has changed.
        yield StreamRequest(path, request_id=path, timeout=2.0, top_k=1)


def main(paths: list[str], address: str) -> None:
    """Print the best grasp of each cloud, in their order."""
    with GraspClient(address) as client:
        for answer in client.detect_stream(clouds(paths)):
            if answer.error is not None:  # of this cloud only: the stream goes on
                print(f"{answer.request_id}: {answer.error}")
            elif answer.detection is not None and answer.detection.grasps:
                best = answer.detection.grasps[0]
                x, y, z = best.T_cloud_tcp[:3, 3]
                where = f"TCP at {x:.3f}, {y:.3f}, {z:.3f} m"
                print(f"{answer.request_id}: score {best.score:.3f}, {where}")
            else:
                print(f"{answer.request_id}: no grasp")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("clouds", nargs="+", metavar="cloud.ply")
    parser.add_argument("--server", default="127.0.0.1:50051", metavar="ADDRESS")
    given = parser.parse_args()
    try:
        main(given.clouds, given.server)
    except GraspClientError as error:
        parser.exit(1, f"error: {error}\n")
