"""What a planner is shown of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np

from edgegrasp_sim.scene import SIZE, TABLE_HEIGHT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edgegrasp_sim.poses import Matrix

TableView = Literal["known", "ransac", "seen"]

# Lowest and highest corner of where grasps are looked for; the table itself is cut off.
WORKSPACE = np.array([[0.02, 0.02, TABLE_HEIGHT + 0.005], [SIZE - 0.02, SIZE - 0.02, SIZE]])
_WITH_TABLE = np.array([[0.02, 0.02, TABLE_HEIGHT - 0.01], WORKSPACE[1]])
_AROUND = np.array([[-0.06], [0.06]])  # where depths are wrong, what is inside is seen outside
WORKSPACE_BOX = {"known": WORKSPACE, "ransac": _WITH_TABLE, "seen": WORKSPACE}
CLOUD_BOX = {"known": WORKSPACE, "ransac": _WITH_TABLE, "seen": _WITH_TABLE + _AROUND}


@dataclass(frozen=True, slots=True)
class Observation:
    """What one or several depth images show of the workspace.

    Attributes:
        cloud: (N, 3) float32, world frame, metres; order of the pixels, one image after another.
        T_world_camera: (4, 4) pose of the first camera (z along the line of sight, y down).
        camera_position: (3,) float32, that of the first camera, world frame, metres.
        workspace: (2, 3) float32, lowest and highest corner of where grasps are looked for.
        table_height: metres; not to be used where `table` is `ransac`.
        camera_positions: (V, 3) float32, every camera, world frame, metres.
        view_ids: (N,) int32, which camera saw each point.
        table: whether the cloud is cut off above the table (`known`) or holds it too: to be found
            (`ransac`), or to put depths right by (`seen`; then the cloud is not cut off at the
            sides of the workspace either).
        failed: (F, 4, 4) T_world_hand of the grasps that have failed in this round.
    """

    cloud: NDArray[np.float32]
    T_world_camera: Matrix
    camera_position: NDArray[np.float32]
    workspace: NDArray[np.float32]
    table_height: float
    camera_positions: NDArray[np.float32]
    view_ids: NDArray[np.int32]
    table: TableView = "known"
    failed: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4, 4)))


Float = TypeVar("Float", bound=np.floating)


def crop(points: NDArray[Float], box: NDArray[np.floating], margin: float = 0.0) -> NDArray[Float]:
    """The points (N, 3) in a box (2, 3), lowest and highest corner, grown by a margin."""
    inside = (points >= box[0] - margin) & (points <= box[1] + margin)
    kept: NDArray[Float] = points[inside.all(axis=1)]
    return kept
