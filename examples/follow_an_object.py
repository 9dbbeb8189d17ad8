"""A grasp that follows an object on a belt, through a simulated stream of depth images.

usage: python examples/follow_an_object.py [ADDRESS]    needs pip install 'edgegrasp[sim]'
"""

import sys
import time
from collections.abc import Iterator

import numpy as np

from edgegrasp_client import GraspClient, GraspTracker
from edgegrasp_sim.camera import look_at
from edgegrasp_sim.simulation import ClutterSimulation

T_WORLD_CAMERA = look_at(np.array([0.15, -0.4, 0.6]), np.array([0.15, 0.15, 0.1]))


def camera() -> Iterator[dict[str, np.ndarray]]:
    """Thirty images a second of one object that moves at 5 cm/s."""
    with ClutterSimulation() as simulation:
        rng = np.random.default_rng(0)
        simulation.reset("packed", rng, num_objects=1)
        start = simulation.placements[0]
        for number in range(60):
            x, y, z = start.position
            simulation.move(0, (x + number / 600, y, z), start.quaternion_xyzw)
            yield {"cloud": simulation.observe_from([T_WORLD_CAMERA], rng, table="auto").image}
            time.sleep(1 / 30)


tracker = GraspTracker(viewpoint=T_WORLD_CAMERA[:3, 3])
with GraspClient(*sys.argv[1:]) as client:
    client.wait_until_ready()
    for _, found in tracker.follow(client, camera()):
        for best in found.grasps[:1]:
            print(best.id, f"score {best.score:.2f}", best.T_cloud_tcp[:3, 3].round(3))
