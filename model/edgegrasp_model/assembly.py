"""Write candidates and their scores as grasps in the caller's frame."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.candidates import Candidates
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.preparation import Round
from edgegrasp_model.results import DebugInfo, Grasp, Outcome
from edgegrasp_model.scene import Scene

Float32 = NDArray[np.float32]

OUTCOMES = list(Outcome)


class Drawn(Protocol):
    """What of a sample tells how its candidates came about."""

    @property
    def rounds(self) -> list[Round]:
        """Every candidate of each round of sampling."""

    @property
    def row(self) -> NDArray[np.int64]:
        """Which of the last round's were scored: (E,) rows."""


def grasps_in_cloud(
    scene: Scene,
    candidates: Candidates,
    gripper: Gripper,
    score: NDArray[np.floating],
    width: Float32,
    collision_free: NDArray[np.bool_],
    clearance: Float32,
) -> list[Grasp]:
    """Candidates E, all arrays (E,), as grasps in the frame of the cloud."""
    T_cloud_hand = scene.frame.poses_in_cloud(candidates.T_cloud_hand)
    T_cloud_tcp = T_cloud_hand @ gripper.T_hand_tcp
    return [
        Grasp(
            score=float(np.float32(score[row])),
            T_cloud_hand=T_cloud_hand[row],
            T_cloud_tcp=T_cloud_tcp[row],
            width=float(width[row]),
            approach_point=scene.points_in_cloud[candidates.approach_index[row]],
            contact_point=scene.points_in_cloud[candidates.contact_index[row]],
            approach_direction=T_cloud_hand[row, :3, 2],
            collision_free=bool(collision_free[row]),
            clearance=float(clearance[row]),
        )
        for row in range(len(candidates))
    ]


def debug_info(
    scene: Scene,
    sample: Drawn | None,
    score: NDArray[np.floating],
    outcome: NDArray[np.int8],
) -> DebugInfo:
    """The processed cloud and every candidate of a request.

    Args:
        scene: The scene.
        sample: All candidates and which of them (E) were scored; None: there are none.
        score: (E,) probabilities.
        outcome: (E,) codes of what became of them.
    """
    rounds = [] if sample is None else sample.rounds
    candidates = Candidates.concatenate([Candidates.none(), *(part.candidates for part in rounds)])
    codes = np.concatenate([outcome[:0], *(part.outcome for part in rounds)])
    scores = np.full(len(candidates), np.nan, dtype=np.float32)
    if sample is not None and len(outcome):
        place = len(candidates) - len(rounds[-1].candidates) + sample.row
        scores[place], codes[place] = score, outcome
    plane = None
    if scene.support is not None:
        normal = scene.frame.directions_in_cloud(scene.support.normal)
        foot = scene.frame.points_in_cloud(np.multiply(scene.support.normal, scene.support.offset))
        plane = np.append(normal, normal @ foot).astype(np.float32)
    return DebugInfo(
        points=scene.points_in_cloud,
        normals=scene.frame.directions_in_cloud(scene.cloud.normals),
        approach_index=candidates.approach_index,
        contact_index=candidates.contact_index,
        T_cloud_hand=scene.frame.poses_in_cloud(candidates.T_cloud_hand),
        score=scores,
        outcome=[OUTCOMES[code] for code in codes.tolist()],
        support_plane=plane,
    )
