"""One request of three views finds at least as many grasps as the best of the views.

usage: python examples/several_views.py [ADDRESS] [SCENES]

Packed and pile scenes in turn, rendered from three sides; a robot's camera would take the images
from several poses, known from its arm. Prints the number of grasps in each view and in all three
with default options, and whether the best grasp holds in simulation. An empty ADDRESS: detect in
this process, with the extra `service`.
"""

import sys

import numpy as np

from edgegrasp_cli.detect import DetectorFlags, open_client
from edgegrasp_client import DepthImage
from edgegrasp_sim.camera import CAMERA, EVALUATION_VIEWS
from edgegrasp_sim.simulation import ClutterSimulation

INTRINSICS = (540.0, 540.0, 320.0, 239.0)  # of the rendered images, pixels


def views(simulation: ClutterSimulation, rng: np.random.Generator) -> list[DepthImage]:
    """Depth images from three sides; the cloud's frame is the world's."""
    images: list[DepthImage] = []
    for T_world_camera in EVALUATION_VIEWS.sample(rng, views=3):
        depth = simulation.world.render_depth(T_world_camera, CAMERA)
        depth[depth > 0.99 * CAMERA.far] = np.nan
        images.append({"depth": depth, "intrinsics": INTRINSICS, "T_cloud_camera": T_world_camera})
    return images


address = sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:50051"
scenes = int(sys.argv[2]) if len(sys.argv) > 2 else 1
with ClutterSimulation() as simulation, open_client(DetectorFlags(server=address)) as client:
    for number in range(scenes):
        rng = np.random.default_rng([0, number])
        simulation.reset(("packed", "pile")[number % 2], rng, num_objects=5)
        images = views(simulation, rng)
        asked = [[image] for image in images] + [images]
        found = [client.detect(depth_images=some).grasps for some in asked]
        counts = [len(grasps) for grasps in found]
        holds = [bool(one and simulation.try_grasp(one[0].T_cloud_hand).success) for one in found]
        said = f"each view: {counts[:3]} grasps, best holds {holds[:3]}"
        print(f"{said}; all three: {counts[3]}, {holds[3]}", flush=True)
