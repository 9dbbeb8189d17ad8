"""What planners with a network ask of it, and which of its grasps they take."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.simulation import Observation

CHOICE = 64  # grasps to choose the highest from
RANSAC = {"kind": "ransac"}


class Scored(Protocol):
    """A grasp with what it is chosen by."""

    @property
    def score(self) -> float: ...  # noqa: D102
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
        "support": RANSAC
        if observation.has_table
        else {"normal": (0.0, 0.0, 1.0), "offset": observation.table_height},
        "workspace": {"min": low, "max": high},
        "top_k": CHOICE if rules.selection == "highest" else 1,
    }
    return options | dict(extra)


def choose(grasps: Sequence[G], rules: PlanningRules) -> G | None:
    """The grasp a protocol takes of those given best first; None of none.

    `highest`: of those with `min_score` or more, if there are any, that whose TCP is highest.
    """
    if not grasps:
        return None
    if rules.selection == "highest":
        good = [grasp for grasp in grasps if grasp.score >= rules.min_score]
        return max(good or grasps[:1], key=lambda grasp: float(grasp.T_cloud_tcp[2, 3]))
    return grasps[0]
