"""Edge grasps: which contact points around an approach point make a candidate, and its pose."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.cloud import Cloud
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.options import SupportPlane

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

MIN_EDGE = 0.003  # metres between approach and contact point
EDGE_MARGIN = 0.002  # metres an edge stays below half the opening
MIN_DEPTH = 1e-4  # metres; a shallower edge has no approach direction
MIN_APPROACH_UP = -0.1  # the hand does not come from below: cosine of approach and up


@dataclass(frozen=True)
class Candidates:
    """Edge grasps of one cloud (paper section III)."""

    ball: Int64  # (E,) which approach point, 0..A-1
    approach_index: Int64  # (E,) p_a, rows of the cloud
    contact_index: Int64  # (E,) p_c, rows of the cloud
    approach: Float32  # (E, 3) unit, outward: from the object back to the hand
    depth: Float32  # (E,) d, metres the contact lies ahead of the approach point
    T_cloud_hand: Float32  # (E, 4, 4)

    def __len__(self) -> int:
        return len(self.ball)

    def take(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> "Candidates":
        """The candidates of the given rows, in their order."""
        return Candidates(
            self.ball[rows],
            self.approach_index[rows],
            self.contact_index[rows],
            self.approach[rows],
            self.depth[rows],
            self.T_cloud_hand[rows],
        )


def edge_grasps(
    cloud: Cloud,
    ball: Int64,
    approach_index: Int64,
    contact_index: Int64,
    gripper: Gripper,
) -> tuple[Candidates, NDArray[np.bool_]]:
    """Poses of (approach point, contact point) pairs, where the pair defines one.

    r = p_c - p_a; its part orthogonal to n_c points from the hand to the object (paper section
    III-A). The contact ends up at the gripper's contact_z, the approach point on its axis.

    Args:
        cloud: The cloud with its normals.
        ball: (E,) which approach point each pair belongs to.
        approach_index: (E,) rows of the cloud.
        contact_index: (E,) rows of the cloud.
        gripper: Gives the finger depth and the opening.

    Returns:
        The candidates that fit the gripper, and which of the E pairs they are (E,).
    """
    normal = cloud.normals[contact_index]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    edge = cloud.points[contact_index] - cloud.points[approach_index]  # (E, 3) r
    ahead = edge - np.einsum("ed,ed->e", edge, normal)[:, None] * normal  # (E, 3) r_perp
    length, depth = np.linalg.norm(edge, axis=1), np.linalg.norm(ahead, axis=1)
    fits = (
        (length > MIN_EDGE)
        & (length < gripper.max_opening / 2 - EDGE_MARGIN)
        & (depth > MIN_DEPTH)
        & (depth < gripper.max_opening / 2)
    )
    pose = edge_grasp_poses(
        cloud.points[approach_index[fits]], ahead[fits], normal[fits], depth[fits], gripper
    )
    return Candidates(
        ball[fits],
        approach_index[fits],
        contact_index[fits],
        -pose[:, :3, 2],
        depth[fits],
        pose,
    ), fits


def edge_grasp_poses(
    approach_point: Float32, ahead: Float32, normal: Float32, depth: Float32, gripper: Gripper
) -> Float32:
    """Hand poses of edge grasps.

    Args:
        approach_point: (E, 3) p_a.
        ahead: (E, 3) r_perp, the part of p_c - p_a orthogonal to n_c.
        normal: (E, 3) unit n_c.
        depth: (E,) |r_perp|.
        gripper: Gives contact_z.

    Returns:
        (E, 4, 4) T_cloud_hand: z = r_perp / d, y = n_c, x = y x z; the contact point lies at
        z = contact_z.
    """
    z = ahead / depth[:, None]
    y = normal - np.einsum("ed,ed->e", normal, z)[:, None] * z
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    pose = np.zeros((len(z), 4, 4), dtype=np.float32)
    pose[:, :3, 0] = np.cross(y, z)
    pose[:, :3, 1] = y
    pose[:, :3, 2] = z
    pose[:, :3, 3] = approach_point + (depth - gripper.contact_z)[:, None] * z
    pose[:, 3, 3] = 1.0
    return pose


def from_above(candidates: Candidates, up: Float32) -> NDArray[np.bool_]:
    """Which candidates do not come from below.  # (E,)."""
    return candidates.approach @ (up / np.linalg.norm(up)) > MIN_APPROACH_UP


def above_support(
    T_cloud_hand: Float32, support: SupportPlane, gripper: Gripper
) -> NDArray[np.bool_]:
    """Which hands, fingers open, have every corner above the support plane.  # (E,)."""
    low, high = np.moveaxis(gripper.boxes(gripper.max_opening), 1, 0)  # (B, 3) each
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
    corners = np.where(picks[None] == 0, low[:, None], high[:, None]).reshape(-1, 3)  # (8B, 3)
    normal = np.asarray(support.normal)
    normal_in_hand = np.einsum("d,edk->ek", normal, T_cloud_hand[:, :3, :3])  # (E, 3)
    origin_height = T_cloud_hand[:, :3, 3] @ normal - support.offset  # (E,)
    lowest = (normal_in_hand @ corners.T).min(axis=1)  # (E,)
    return origin_height + lowest >= 0.0
