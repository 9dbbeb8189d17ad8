"""Training examples: the balls and labels of a view, as the network takes them."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from edgegrasp_model.ball_batch import BallBatch, crop_balls
from edgegrasp_model.candidates import Candidates, edge_grasps
from edgegrasp_model.cloud import Cloud
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import describe_hands, without_support
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.options import SupportPlane
from edgegrasp_training.views import LabelledView

UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)
SUPPORT = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.05)  # the table of the simulated scenes


@dataclass(frozen=True)
class TriedGrasps:
    """The labelled edge grasps of one view, ready to be packed ball by ball."""

    cloud: Cloud
    candidates: Candidates  # E of them
    description: NDArray[np.floating] | None  # (E, F), half precision to keep many views in memory
    label: NDArray[np.float32]  # (E,) 0 or 1

    def without_support(self) -> "TriedGrasps":
        """The same, described as for a request that does not name the support plane."""
        if self.description is None:
            return self
        return replace(self, description=without_support(self.description))

    def balls(self) -> NDArray[np.int64]:
        """Rows of the cloud that are approach points of labelled candidates, ascending."""
        return np.unique(self.candidates.approach_index)


def tried_grasps(view: LabelledView, config: NetworkConfig, gripper: Gripper) -> TriedGrasps:
    """Build the tried candidates of a view, and describe them if the network wants that.

    Args:
        view: The view.
        config: The network to prepare for.
        gripper: The hand that tried them.
    """
    rows = view.tried()
    cloud = Cloud(view.points, view.normals)
    candidates = _candidates(view, cloud, rows, gripper)
    label = view.success[rows[candidates.pair]].astype(np.float32)
    description = None
    if config.hand_description_size:
        description = describe_hands(cloud, candidates, gripper, UP, SUPPORT).astype(np.float16)
    return TriedGrasps(cloud, candidates, description, label)


def _candidates(
    view: LabelledView, cloud: Cloud, rows: NDArray[np.int64], gripper: Gripper
) -> Candidates:
    """The tried candidates; `pair` counts in `rows`."""
    approach_index, contact_index = view.approach_index[rows], view.contact_index[rows]
    if view.T_world_hand is None:
        return edge_grasps(cloud, approach_index, contact_index, gripper)
    pose = view.T_world_hand[rows]
    edge = view.points[contact_index] - view.points[approach_index]  # (E, 3)
    depth = np.maximum(np.einsum("ed,ed->e", edge, pose[:, :3, 2]), 0.0)
    pair = np.arange(len(rows), dtype=np.int64)
    return Candidates(pair, approach_index, contact_index, -pose[:, :3, 2], depth, pose)


def pack(
    grasps: TriedGrasps, balls: NDArray[np.int64], config: NetworkConfig
) -> tuple[BallBatch, Tensor]:
    """Crop some balls of a view and pack the candidates in them.

    Args:
        grasps: The labelled candidates of a view.
        balls: (A,) ascending rows of the cloud to crop around.
        config: Crop radius and k.

    Returns:
        The balls, and the labels (E,) of their candidates.
    """
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, balls))
    candidates = grasps.candidates.take(rows)
    crop = crop_balls(grasps.cloud.points, balls, config.crop_radius, config.k)
    ball = np.searchsorted(balls, candidates.approach_index)
    size = len(grasps.cloud.points)
    keys = crop.ball_of_point * size + crop.ball_rows  # ascending
    wanted = ball * size + candidates.contact_index
    contact = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    inside = keys[contact] == wanted
    description = None
    if grasps.description is not None:
        description = grasps.description[rows[inside]].astype(np.float32)
    batch = BallBatch.from_cloud(
        grasps.cloud.points,
        grasps.cloud.normals,
        balls,
        crop,
        contact[inside],
        candidates.approach[inside],
        candidates.depth[inside],
        description,
    )
    return batch, torch.from_numpy(grasps.label[rows[inside]])


def rotated(batch: BallBatch, rng: np.random.Generator) -> BallBatch:
    """Turn all balls of a batch by one uniformly random rotation (paper section IV-D)."""
    turn = torch.from_numpy(Rotation.random(rng=rng).as_matrix().T.astype(np.float32))
    return replace(
        batch,
        points=batch.points @ turn,
        normals=batch.normals @ turn,
        approach=batch.approach @ turn,
    )
