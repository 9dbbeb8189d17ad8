"""Grasps of a mug by its handle: both points of every grasp lie in a region.

usage: python examples/region_on_a_handle.py [ADDRESS]

The image is the playground's sample; in the playground a region can be drawn with the mouse.
"""

import sys
from pathlib import Path

from edgegrasp_client import DepthImage, GraspClient, Region

SAMPLE = Path(__file__).with_name("sample") / "depth.png"
IMAGE: DepthImage = {"depth": SAMPLE, "intrinsics": (540.0, 540.0, 320.0, 239.0)}
HANDLE: Region = {
    "include": [{"kind": "sphere", "center": (0.122, 0.098, 0.497), "radius": 0.022}]
}  # metres, camera frame

with GraspClient(*sys.argv[1:]) as client:
    detection = client.detect(
        depth_images=[IMAGE], approach_region=HANDLE, contact_region=HANDLE, top_k=5
    )
for grasp in detection.grasps:
    x, y, z = grasp.contact_point
    print(f"score {grasp.score:.3f}, contact point at {x:.3f}, {y:.3f}, {z:.3f} m")
print("counts:", detection.counts)
