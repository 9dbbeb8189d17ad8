"""What a server answers, as typed values."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Grasp:
    """One grasp: move to `T_cloud_hand` along `approach_direction`, then close."""

    score: float  # probability that the grasp holds
    T_cloud_hand: Float32  # (4, 4) hand link frame: z out of the palm, y the closing direction
    T_cloud_tcp: Float32  # (4, 4) tool centre point, same axes
    width: float  # opening to command before closing, metres
    approach_point: Float32  # (3,) p_a, metres, cloud frame
    contact_point: Float32  # (3,) p_c, metres, cloud frame
    approach_direction: Float32  # (3,) unit, the direction the hand moves; +z of the hand
    collision_free: bool  # whether the open hand meets nothing at the grasp and on its ways
    clearance: float  # metres from the open hand at the grasp to the nearest thing; <= 0: within


@dataclass(frozen=True, eq=False)
class DebugInfo:
    """The processed cloud and every candidate, whatever became of it. V points, E candidates."""

    points: Float32  # (V, 3) metres, cloud frame
    normals: Float32  # (V, 3) unit
    approach_index: Int32  # (E,) p_a, rows of `points`
    contact_index: Int32  # (E,) p_c, rows of `points`
    T_cloud_hand: Float32  # (E, 4, 4)
    score: Float32  # (E,) NaN where it was not scored
    outcome: list[str]  # E of them: "returned", or what became of it
    support_plane: Float32 | None  # (4,) unit normal and offset, given or found, metres


@dataclass(frozen=True, eq=False)
class Detection:
    """Ranked grasps of one cloud, and how they came about."""

    grasps: list[Grasp]
    counts: dict[str, int]  # points, candidates and grasps that passed each stage
    seconds: dict[str, float]  # spent in each stage, and their `total`
    model: str  # name of the weights used
    warnings: list[str]
    debug: DebugInfo | None = None  # where `debug` is asked for


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What the network says of one edge or hand pose."""

    grasp: Grasp | None  # None where it defines none
    reason: str | None  # why it defines none, in a word such as "too-long"


@dataclass(frozen=True, eq=False)
class Scoring:
    """Evaluations, in the order of the edges or hand poses."""

    evaluations: list[Evaluation]
    counts: dict[str, int]
    seconds: dict[str, float]
    model: str
    warnings: list[str]


@dataclass(frozen=True)
class Model:
    """Weights a server has loaded."""

    name: str
    architecture: str
    digest: str
    parameters: int
    crop_radius: float  # metres
    voxel_size: float  # metres
    gripper: str
    default: bool  # whether a request that names no model gets these
    hand_description: bool  # whether the network also sees the hand-frame description
    device: str = ""  # where it computes: "cpu", or a GPU such as "cuda:0"
