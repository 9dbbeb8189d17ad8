"""One request of several views: what one camera does not see, another does.

usage: python examples/05_several_views.py [ADDRESS]

The images are rendered. A robot's camera would take them from several poses, known from its arm.
"""

import sys

import numpy as np

from edgegrasp_client import DepthImage, GraspClient
from edgegrasp_sim.camera import CAMERA, look_at
from edgegrasp_sim.simulation import ClutterSimulation

MIDDLE = np.array([0.15, 0.15, 0.08])  # metres, of the scene
EYES = [(0.15, -0.35, 0.5), (0.65, 0.15, 0.5), (0.15, 0.65, 0.5)]  # metres, cameras


def views() -> list[DepthImage]:
    """Depth images of a heap of objects; the cloud's frame is the world's."""
    images: list[DepthImage] = []
    with ClutterSimulation() as simulation:
        simulation.reset("pile", np.random.default_rng(0), num_objects=6)
        for eye in EYES:
            T_world_camera = look_at(np.array(eye), MIDDLE)
            depth = simulation.world.render_depth(T_world_camera, CAMERA)
            depth[depth > 0.99 * CAMERA.far] = np.nan
            intrinsics = (540.0, 540.0, 320.0, 239.0)
            images.append(
                {"depth": depth, "intrinsics": intrinsics, "T_cloud_camera": T_world_camera}
            )
    return images


def main(address: str = "127.0.0.1:50051") -> None:
    """Print what is found in the first view, and in all of them."""
    images = views()
    with GraspClient(address) as client:
        for seen in (images[:1], images):
            found = client.detect(depth_images=seen, up=(0.0, 0.0, 1.0))
            surface = found.counts["above_support"]
            best = f"best score {found.grasps[0].score:.3f}" if found.grasps else "no grasp"
            print(f"{len(seen)} views: {surface} points over the table, {best}")


if __name__ == "__main__":
    main(*sys.argv[1:])
