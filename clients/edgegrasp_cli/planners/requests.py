"""What planners with a network ask of it, and which of its grasps they take."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from edgegrasp_sim.camera import Observation
from edgegrasp_sim.protocol import PlanningRules

CHOICE = 64  # grasps to choose from where it is not the best one
NEARBY = 0.05  # metres around a grip that failed: the same object, most likely
SAME_GRIP = 0.02  # metres around it, closing the same way: the same grip again
SAME_CLOSING = np.cos(np.radians(30.0))
NEARBY_WORTH, SAME_GRIP_WORTH = 0.8, 0.6  # factors on the score
MAX_DEPTH_ERROR = 0.12  # of views that show the table; more than any protocol's noise


class Scored(Protocol):
    """A grasp with what it is chosen by."""

    @property
    def score(self) -> float: ...  # noqa: D102
    @property
    def T_cloud_hand(self) -> NDArray[np.float32]: ...  # noqa: D102, N802  # (4, 4)
    @property
    def T_cloud_tcp(self) -> NDArray[np.float32]: ...  # noqa: D102, N802  # (4, 4)


G = TypeVar("G", bound=Scored)


def request_options(
    observation: Observation, seed: int, rules: PlanningRules, extra: Mapping[str, Any]
) -> dict[str, Any]:
    """Options of a detection under a protocol; `extra` ones win.

    The simulator's world frame is the cloud's frame, so that T_cloud_hand is T_world_hand.
    """
    low, high = observation.workspace.tolist()
    positions = observation.camera_positions.tolist()
    options: dict[str, Any] = {
        "seed": seed,
        "num_approach_points": rules.num_approach_points,
        "num_candidates": rules.num_candidates,
        "viewpoint": positions[0] if len(positions) == 1 else positions,
        "support": _support(observation),
        "workspace": {"min": low, "max": high},
        "top_k": 1 if rules.selection == "best" else CHOICE,
    }
    return options | dict(extra)


def _support(observation: Observation) -> dict[str, Any]:
    if observation.table == "ransac":
        return {"kind": "ransac"}
    plane = {"normal": (0.0, 0.0, 1.0), "offset": observation.table_height}
    return plane | ({"max_depth_error": MAX_DEPTH_ERROR} if observation.table == "seen" else {})


def choose(grasps: Sequence[G], rules: PlanningRules, failed: NDArray[np.floating]) -> G | None:
    """The grasp a protocol takes of those given best first; None of none.

    `highest`: of those with `min_score` or more, if there are any, that whose TCP is highest.
    `elsewhere`: the best, where scores near grips that failed before are worth less.

    Args:
        grasps: Best first.
        rules: Of the protocol.
        failed: (F, 4, 4) T_world_hand of the grasps of this round that failed.
    """
    if not grasps:
        return None
    if rules.selection == "highest":
        good = [grasp for grasp in grasps if grasp.score >= rules.min_score]
        return max(good or grasps[:1], key=lambda grasp: float(grasp.T_cloud_tcp[2, 3]))
    if rules.selection == "elsewhere":
        T_hand_tcp = np.linalg.inv(grasps[0].T_cloud_hand) @ grasps[0].T_cloud_tcp
        T_cloud_failed = failed @ T_hand_tcp
        return max(grasps, key=lambda grasp: _worth(grasp, T_cloud_failed))
    return grasps[0]


def _worth(grasp: Scored, T_cloud_failed: NDArray[np.floating]) -> float:
    """A grasp's score, less near TCP poses (F, 4, 4) at which a grasp has failed."""
    T_cloud_tcp = grasp.T_cloud_tcp
    distance = np.linalg.norm(T_cloud_failed[:, :3, 3] - T_cloud_tcp[:3, 3], axis=1)
    closing = np.abs(T_cloud_failed[:, :3, 1] @ T_cloud_tcp[:3, 1])
    nearby = int((distance < NEARBY).sum())
    same = int(((distance < SAME_GRIP) & (closing > SAME_CLOSING)).sum())
    return float(grasp.score) * NEARBY_WORTH**nearby * SAME_GRIP_WORTH**same
