"""Grasps for a gripper of your own, given in the request.

usage: python examples/your_gripper.py [ADDRESS]

Lengths are metres in the hand frame: z out of the palm, y the closing direction. docs/frames.md
describes the fields; `edgegrasp serve --grippers FILE.toml` gives them a name.
"""

import sys
from pathlib import Path

from edgegrasp_client import DepthImage, GraspClient, GripperGeometry

SAMPLE = Path(__file__).with_name("sample") / "depth.png"
IMAGE: DepthImage = {"depth": SAMPLE, "intrinsics": (540.0, 540.0, 320.0, 239.0)}
SMALL: GripperGeometry = {
    "name": "small",
    "max_opening": 0.05,
    "tip_z": 0.085,  # fingertips
    "contact_z": 0.080,  # position of the contacts
    "tcp_z": 0.080,
    "hand": {"boxes": [((-0.02, -0.04, 0.0), (0.02, 0.04, 0.045))]},
    "finger": {"boxes": [((-0.006, 0.0, 0.045), (0.006, 0.010, 0.085))]},  # inner face at y = 0
}

with GraspClient(*sys.argv[1:]) as client:
    for gripper in (SMALL, "panda"):  # `panda` is built in
        detection = client.detect(depth_images=[IMAGE], gripper=gripper, top_k=5)
        print("panda:" if gripper == "panda" else "small:")
        for grasp in detection.grasps:
            print(f"  score {grasp.score:.3f}, opening {1000 * grasp.width:.0f} mm")
