"""Grasps as files of other programs: MoveIt's messages and Isaac Sim's grasp files.

usage: python examples/09_export.py FOLDER [ADDRESS]

Needs the extra `yaml`. docs/frames.md has the conventions of further programs.
"""

import json
import sys
from importlib.resources import files
from pathlib import Path

from edgegrasp_client import DepthImage, GraspClient
from edgegrasp_client.conversions import isaac_grasps, moveit_grasp

SAMPLE = Path(str(files("edgegrasp_service"))) / "playground/samples/depth.png"
IMAGE: DepthImage = {"depth": SAMPLE, "intrinsics": (540.0, 540.0, 320.0, 239.0)}
FRAME = "camera_color_optical_frame"


def main(folder: str, address: str = "127.0.0.1:50051") -> None:
    """Write moveit.json, a list of moveit_msgs/Grasp, and isaac.yaml, an isaac_grasp file."""
    with GraspClient(address) as client:
        detection = client.detect(depth_images=[IMAGE], top_k=10)
    output = Path(folder)
    output.mkdir(parents=True, exist_ok=True)
    messages = [
        moveit_grasp(grasp, FRAME, name=f"grasp_{rank}")
        for rank, grasp in enumerate(detection.grasps)
    ]
    (output / "moveit.json").write_text(json.dumps(messages, indent=1))
    text = isaac_grasps(
        detection.grasps, object_frame=f"/World/{FRAME}", gripper_frame="/World/panda_hand"
    )
    (output / "isaac.yaml").write_text(text)
    print(f"{len(messages)} grasps in {output}/moveit.json and {output}/isaac.yaml")


if __name__ == "__main__":
    main(*sys.argv[1:])
