"""Training examples: the balls or hands of a view with their labels, as the network takes them."""

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
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.hand_description import without_support
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.options import SupportPlane, Workspace
from edgegrasp_model.scene import at_workspace_side
from edgegrasp_training.views import LabelledView

UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)
WORKSPACE = Workspace(min=(0.02, 0.02, 0.055), max=(0.28, 0.28, 0.3))  # and what they are cut to
SPARE_POINTS = 2  # times the network's points of a hand are kept, to pick from in each step
SUPPORT = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.05)  # the table of the simulated scenes


@dataclass(frozen=True)
class SeenByHands:
    """What the hand network is told of E grasps; half precision to keep many views in memory."""

    description: NDArray[np.float16]  # (E, F)
    points: NDArray[np.float16]  # (E, P, 6)
    point_count: NDArray[np.int64]  # (E,)


@dataclass(frozen=True)
class TriedGrasps:
    """The labelled edge grasps of one view, ready to be packed ball by ball."""

    cloud: Cloud
    candidates: Candidates  # E of them
    seen: SeenByHands | None  # for the hand network
    label: NDArray[np.float32]  # (E,) 0 or 1

    def without_support(self) -> "TriedGrasps":
        """The same, described as for a request that does not name the support plane."""
        if self.seen is None:
            return self
        unknown = without_support(self.seen.description).astype(np.float16)
        return replace(self, seen=replace(self.seen, description=unknown))

    def balls(self) -> NDArray[np.int64]:
        """Rows of the cloud that are approach points of labelled candidates, ascending."""
        return np.unique(self.candidates.approach_index)


def tried_grasps(
    view: LabelledView, config: NetworkConfig, gripper: Gripper, *, viewpoint_known: bool = True
) -> TriedGrasps:
    """Build the tried candidates of a view, and what their hands see if the network wants that.

    Args:
        view: The view.
        config: The network to prepare for.
        gripper: The hand that tried them.
        viewpoint_known: Whether the request named the camera.
    """
    rows = view.tried()
    cloud = Cloud(view.points, view.normals)
    candidates = _candidates(view, cloud, rows, gripper)
    label = view.success[rows[candidates.pair]].astype(np.float32)
    seen = None
    if config.architecture == "hand":
        batch = HandBatch.from_cloud(
            cloud,
            candidates,
            gripper,
            UP,
            SUPPORT,
            view.camera_position if viewpoint_known else None,
            at_workspace_side(view.points, WORKSPACE, UP),
            SPARE_POINTS * config.hand_points,
        )
        description, points = batch.description.numpy(), batch.points.numpy()
        seen = SeenByHands(
            description.astype(np.float16), points.astype(np.float16), batch.point_count.numpy()
        )
    return TriedGrasps(cloud, candidates, seen, label)


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


def pack_balls(
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
    crop = crop_balls(grasps.cloud.points, balls, config.crop_radius)
    ball = np.searchsorted(balls, candidates.approach_index)
    size = len(grasps.cloud.points)
    keys = crop.ball_of_point * size + crop.ball_rows  # ascending
    wanted = ball * size + candidates.contact_index
    contact = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    inside = keys[contact] == wanted
    batch = BallBatch.from_cloud(
        grasps.cloud.points,
        grasps.cloud.normals,
        balls,
        crop,
        contact[inside],
        candidates.approach[inside],
        candidates.depth[inside],
        config.k,
    )
    return batch, torch.from_numpy(grasps.label[rows[inside]])


def pack_hands(
    grasps: TriedGrasps,
    balls: NDArray[np.int64],
    config: NetworkConfig,
    rng: np.random.Generator | None = None,
) -> tuple[HandBatch, Tensor]:
    """Pack what the hands of the candidates of some balls see.

    Args:
        grasps: The labelled candidates of a view, with what their hands see.
        balls: (A,) rows of the cloud.
        config: Points of each hand.
        rng: Picks points of each hand at random; evenly over the cloud's order without it.

    Returns:
        The hands, and their labels (E,).
    """
    seen = grasps.seen
    if seen is None:
        raise ValueError("grasps: got none that hands have seen. Build them for this network.")
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, balls))
    points, count = seen.points[rows], seen.point_count[rows]
    limit, slot = config.hand_points, np.arange(seen.points.shape[1])
    if rng is None:
        order = slot * np.maximum(count[:, None], limit) // limit  # (E, P)
    else:
        there = slot < count[:, None]
        order = np.argsort(np.where(there, rng.random(there.shape, dtype=np.float32), 2.0), axis=1)
    chosen = np.take_along_axis(points, order[:, :limit, None], axis=1)
    batch = HandBatch(
        torch.from_numpy(seen.description[rows].astype(np.float32)),
        torch.from_numpy(chosen.astype(np.float32)),
        torch.from_numpy(np.minimum(count, limit)),
        len(balls),
    )
    return batch, torch.from_numpy(grasps.label[rows])


def rotated(batch: BallBatch, rng: np.random.Generator) -> BallBatch:
    """Turn all balls of a batch by one uniformly random rotation (paper section IV-D)."""
    turn = torch.from_numpy(Rotation.random(rng=rng).as_matrix().T.astype(np.float32))
    return replace(
        batch,
        points=batch.points @ turn,
        normals=batch.normals @ turn,
        approach=batch.approach @ turn,
    )
