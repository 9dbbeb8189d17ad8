"""Grasps of what a segmenter marked in a depth image, such as "the handle of the red mug".

usage: python examples/12_handle_of_the_red_mug.py depth.png handle.png fx,fy,cx,cy [address]

The mask is an image of the same size that is not 0 on the handle: any segmenter's will do (Grounded
SAM and its like take the words). What is not marked stays an obstacle. Needs Pillow.
"""

import sys

import numpy as np
from PIL import Image

from edgegrasp_client import GraspClient, on_mask


def main(depth: str, mask: str, camera: str, address: str = "127.0.0.1:50051") -> None:
    """Print the best grasps whose fingers close on the masked pixels."""
    intrinsics = [float(number) for number in camera.split(",")]
    options = on_mask(np.asarray(Image.open(mask)), {"top_k": 5})
    with GraspClient(address) as client:
        detection = client.detect(
            depth_images=[{"depth": depth, "intrinsics": intrinsics}], **options
        )
    for warning in detection.warnings:
        print("warning:", warning)
    for grasp in detection.grasps:
        x, y, z = grasp.contact_point
        print(f"score {grasp.score:.3f}, contact at {x:.4f}, {y:.4f}, {z:.4f} m of the camera")


if __name__ == "__main__":
    main(*sys.argv[1:])
