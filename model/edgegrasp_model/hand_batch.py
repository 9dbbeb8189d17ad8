"""What the hand network needs to score the edge grasps of one cloud, or of several."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgegrasp_model.candidates import Candidates
from edgegrasp_model.cloud import Cloud
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import describe_hands
from edgegrasp_model.hand_points import points_around_fingers
from edgegrasp_model.hand_view import HandView, hand_views, reach_of
from edgegrasp_model.support import SupportPlane

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class HandBatch:
    """E edge grasps, each with what its own hand sees. Metres."""

    description: Tensor  # (E, F) float32
    points: Tensor  # (E, P, 6) float32, positions and normals around the fingers, hand frame
    point_count: Tensor  # (E,) int64, how many of the P there are; zeros follow
    num_balls: int  # approach points that the edge grasps are around

    @classmethod
    def from_cloud(
        cls,
        cloud: Cloud,
        candidates: Candidates,
        gripper: Gripper,
        up: Float32,
        support: SupportPlane | None,
        viewpoint: Float32 | None,
        at_side: NDArray[np.bool_] | None,
        num_points: int,
        view: HandView | None = None,
    ) -> Self:
        """Look at a cloud from the hands of some candidates.

        Args:
            cloud: N points with normals.
            candidates: E of them.
            gripper: The hand, open to its maximum.
            up: (3,) away from gravity.
            support: Plane that heights are measured from, where it is known.
            viewpoint: (3,) the camera, where there is one and it is known.
            at_side: (N,) points where a side of the workspace cuts things off.
            num_points: P.
            view: `hand_views` of the same candidates, where the caller has it already.
        """
        T_cloud_hand = candidates.T_cloud_hand
        view = view or hand_views(cloud, T_cloud_hand, reach_of(gripper))
        description = describe_hands(
            cloud, candidates, gripper, up, support, viewpoint, at_side, view
        )
        points, count = points_around_fingers(
            cloud.normals, T_cloud_hand, gripper, viewpoint, view, num_points
        )
        balls = len(np.unique(candidates.approach_index))
        return cls(
            torch.from_numpy(description), torch.from_numpy(points), torch.from_numpy(count), balls
        )

    @staticmethod
    def concatenate(batches: Sequence["HandBatch"]) -> "HandBatch":
        """Joins batches into one; scores come out in the same order.

        Raises:
            ValueError: No batch.
        """
        if not batches:
            raise ValueError("batches: got none. Give at least one HandBatch.")
        return HandBatch(
            torch.cat([batch.description for batch in batches]),
            torch.cat([batch.points for batch in batches]),
            torch.cat([batch.point_count for batch in batches]),
            sum(batch.num_balls for batch in batches),
        )

    @property
    def contact(self) -> Tensor:
        """(E,) int64, one for each edge grasp, as a ball batch has it."""
        return torch.arange(len(self.description))

    def to(self, device: torch.device | str) -> "HandBatch":
        """Moves every tensor to a device."""
        return HandBatch(
            self.description.to(device),
            self.points.to(device),
            self.point_count.to(device),
            self.num_balls,
        )
