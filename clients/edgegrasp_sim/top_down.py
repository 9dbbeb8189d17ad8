"""A planner without a network: grasp the highest object from above, across its narrow side."""

import numpy as np

from edgegrasp_sim.camera import Observation
from edgegrasp_sim.hand import FINGERTIP, MAX_OPENING
from edgegrasp_sim.trial import PlannedGrasp

REACH = 0.04  # metres around the highest point that count as the object to grasp
DEPTH = 0.025  # metres that the fingertips go below its top
TABLE_CLEARANCE = 0.004  # metres
FEWEST = 10  # points that an object has


def plan_top_down(observation: Observation, seed: int) -> PlannedGrasp | None:
    """Plan one grasp; a `Planner` to compare others with, and to try the simulator with.

    None if hardly anything is there to grasp.
    """
    del seed
    cloud = observation.cloud.astype(np.float64)
    if len(cloud) < FEWEST:
        return None
    # Not the very highest point, which is the noisiest.
    top = cloud[np.argsort(cloud[:, 2])[-FEWEST]]
    near = cloud[
        (np.linalg.norm(cloud[:, :2] - top[:2], axis=1) < REACH) & (cloud[:, 2] > top[2] - DEPTH)
    ]
    if len(near) < FEWEST:
        return None
    _, axes = np.linalg.eigh(np.cov(near[:, :2].T))
    closing = np.array([*axes[:, 0], 0.0])
    across, along = near @ closing, near[:, :2] @ axes[:, 1]
    middle = 0.5 * (across.min() + across.max()) * closing[:2] + along.mean() * axes[:, 1]
    tip = max(top[2] - DEPTH, observation.table_height + TABLE_CLEARANCE)

    approach = np.array([0.0, 0.0, -1.0])
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = np.cross(closing, approach), closing, approach
    T[:3, 3] = (*middle, tip + FINGERTIP)
    width = float(np.clip(np.ptp(across), 0.0, MAX_OPENING))
    return PlannedGrasp(T, score=1.0 - width / MAX_OPENING, width=width)
