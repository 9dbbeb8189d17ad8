"""What one detection returns."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Grasp:
    """One grasp to execute: reach `T_cloud_hand` along `approach_direction`, then close."""

    score: float  # probability that the grasp holds
    T_cloud_hand: Float32  # (4, 4) hand link frame: z out of the palm, y the closing direction
    T_cloud_tcp: Float32  # (4, 4) tool centre point, same axes
    width: float  # opening to command before closing, metres
    approach_point: Float32  # (3,) p_a, metres, cloud frame
    contact_point: Float32  # (3,) p_c, metres, cloud frame
    approach_direction: Float32  # (3,) unit, the direction the hand moves; +z of the hand
    collision_free: bool  # whether the open hand at the grasp meets no point of the cloud


@dataclass(frozen=True)
class Detection:
    """Ranked grasps of one cloud, and how they came about."""

    grasps: list[Grasp]
    counts: dict[str, int]  # points, candidates and grasps that passed each stage, in order
    seconds: dict[str, float]  # spent in each stage, and their `total`
    model: str  # name of the weights used
    warnings: list[str] = field(default_factory=list)
