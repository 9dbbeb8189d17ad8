"""A planner of your own in the benchmark: here, it grasps the highest point from above.

usage: PYTHONPATH=examples edgegrasp benchmark --planner your_planner:plan --scene packed \
           --rounds 5 --output results/mine

docs/benchmark.md describes what an observation contains and what else a planner may do.
"""

import numpy as np

from edgegrasp_sim.camera import Observation
from edgegrasp_sim.trial import PlannedGrasp

REACH = 0.09  # metres from the hand frame to the grasped point
AROUND = 0.02  # metres around the highest point; points in it give its object's narrow direction


def plan(observation: Observation, seed: int) -> PlannedGrasp | None:
    """A grasp from straight above, closing across the highest object; None for an empty view."""
    cloud = observation.cloud.astype(np.float64)
    if not len(cloud):
        return None
    top = cloud[cloud[:, 2].argmax()]
    near = cloud[np.linalg.norm(cloud - top, axis=1) < AROUND]
    centred = near[:, :2] - near[:, :2].mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)  # the narrow direction first
    closing = np.array([*axes[:, 0], 0.0])
    approach = np.array([0.0, 0.0, -1.0])
    T_world_hand = np.eye(4)
    T_world_hand[:3, 0] = np.cross(closing, approach)
    T_world_hand[:3, 1], T_world_hand[:3, 2] = closing, approach
    T_world_hand[:3, 3] = [*near[:, :2].mean(axis=0), top[2] + REACH]
    return PlannedGrasp(T_world_hand, score=0.5, width=0.08)
