"""A depth camera's images, and the grasps in them.

usage: python examples/depth_camera.py FOLDER [--sensor stereo] [--seed 0]

Renders a table as a depth camera of some kind sees it, writes depth.png (16 bits, millimetres) and
color.png, and asks for grasps in them, as for images of a real camera.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from edgegrasp_client import DepthImage, GraspClient
from edgegrasp_client.connection import local_server
from edgegrasp_sim.camera import CAMERA, look_at
from edgegrasp_sim.sensor import SENSORS
from edgegrasp_sim.simulation import ClutterSimulation

INTRINSICS = (540.0, 540.0, 320.0, 239.0)  # fx, fy, cx, cy of the rendered images, pixels


def write_images(folder: Path, sensor: str, seed: int) -> None:
    """Write depth.png and color.png of a table with objects on it."""
    scene, noise = (np.random.default_rng([seed, stream]) for stream in range(2))
    T_world_camera = look_at(np.array([0.15, -0.30, 0.52]), np.array([0.15, 0.14, 0.06]))
    with ClutterSimulation() as simulation:
        simulation.reset("table", scene, num_objects=7)
        depth = simulation.world.render_depth(T_world_camera, CAMERA)
        colors = simulation.color_image(T_world_camera)
    seen = SENSORS[sensor].apply(depth, CAMERA, noise)
    millimetres = np.nan_to_num(1000 * seen).round().astype(np.uint16)  # 0: no reading
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(millimetres).save(folder / "depth.png", optimize=True)
    Image.fromarray(colors).save(folder / "color.png", optimize=True)


def main() -> None:
    """Write the images and print the best grasps."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sensor", choices=list(SENSORS), default="structured-light")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    write_images(arguments.folder, arguments.sensor, arguments.seed)
    with local_server() as addresses, GraspClient(addresses.http_url) as client:
        image: DepthImage = {"depth": arguments.folder / "depth.png", "intrinsics": INTRINSICS}
        detection = client.detect(depth_images=[image], top_k=5)
    for grasp in detection.grasps:
        print(f"score {grasp.score:.3f}  object {grasp.object}  TCP {grasp.T_cloud_tcp[:3, 3]}")


if __name__ == "__main__":
    main()
