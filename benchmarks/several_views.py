"""Whether one request of three views finds what the best single view finds, told nothing else.

usage: python benchmarks/several_views.py [ADDRESS] [SCENES]

Packed and pile scenes in turn. Of each view alone and of all three: how many grasps are found, and
whether the best one holds in simulation. ADDRESS is a server's, gRPC or HTTP; without one, or with
an empty one, this process detects, as `edgegrasp detect` does.
"""

import sys
from itertools import chain

import numpy as np

from edgegrasp_cli.detect import open_client
from edgegrasp_client import DepthImage
from edgegrasp_sim.camera import CAMERA, EVALUATION_VIEWS
from edgegrasp_sim.simulation import ClutterSimulation

FOCAL, CENTRE = CAMERA.focal_length, (CAMERA.width / 2, CAMERA.height / 2 - 1)  # pixels


def main(address: str = "", scenes: str = "20") -> None:
    """Print a line for each scene, and totals."""
    counts, holds = [], []
    with ClutterSimulation() as simulation, open_client(address, 60.0, {}) as client:
        for index in range(int(scenes)):
            rng = np.random.default_rng([0, index])
            simulation.reset(("packed", "pile")[index % 2], rng, num_objects=5)
            images: list[DepthImage] = []
            for T_world_camera in EVALUATION_VIEWS.sample(rng, views=3):
                depth = simulation.world.render_depth(T_world_camera, CAMERA).astype(np.float32)
                depth[depth > 0.99 * CAMERA.far] = np.nan
                camera = (FOCAL, FOCAL, *CENTRE)
                images.append(
                    {"depth": depth, "intrinsics": camera, "T_cloud_camera": T_world_camera}
                )
            found = [client.detect(depth_images=some).grasps for some in chain(zip(images), [images])]
            counts.append([len(grasps) for grasps in found])
            holds.append(
                [
                    bool(grasps) and simulation.try_grasp(grasps[0].T_cloud_hand).success
                    for grasps in found
                ]
            )
            print(index, "grasps", counts[-1], "best holds", *map(int, holds[-1]), flush=True)
    count, held = np.array(counts), np.mean(holds, axis=0)
    fewer = int((count[:, 3] < count[:, :3].max(axis=1)).sum())
    print(f"fewer grasps than the best single view: {fewer} of {len(count)} scenes")
    print(f"best grasp holds: single views {np.round(held[:3], 2)}, all three {held[3]:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
