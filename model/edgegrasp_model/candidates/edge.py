"""Edge grasps: which contact points around an approach point make a candidate, and its pose."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

MIN_EDGE = 0.003  # metres between approach and contact point
EDGE_MARGIN = 0.002  # metres an edge stays below half the opening
MIN_DEPTH = 1e-4  # metres; a shallower edge has no approach direction
TIP_MARGIN = 0.002  # metres a contact stays inside the fingertips when the hand retracts


@dataclass(frozen=True)
class Candidates:
    """Edge grasps of one cloud (paper section III)."""

    pair: Int64  # (E,) which of the given pairs of points
    approach_index: Int64  # (E,) p_a, rows of the cloud
    contact_index: Int64  # (E,) p_c, rows of the cloud
    approach: Float32  # (E, 3) unit, outward: from the object back to the hand
    depth: Float32  # (E,) d, metres the contact lies ahead of the approach point
    T_cloud_hand: Float32  # (E, 4, 4)

    def __len__(self) -> int:
        return len(self.pair)

    @staticmethod
    def none() -> "Candidates":
        """No candidate."""
        rows, numbers = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.float32)
        vectors = np.empty((0, 3), dtype=np.float32)
        return Candidates(rows, rows, rows, vectors, numbers, np.empty((0, 4, 4), np.float32))

    @staticmethod
    def concatenate(parts: Sequence["Candidates"]) -> "Candidates":
        """All candidates of several sets, in order."""
        arrays = [
            np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(parts[0])
        ]
        return Candidates(*arrays)

    def take(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> "Candidates":
        """The candidates of the given rows, in their order."""
        return Candidates(
            self.pair[rows],
            self.approach_index[rows],
            self.contact_index[rows],
            self.approach[rows],
            self.depth[rows],
            self.T_cloud_hand[rows],
        )


def edge_grasps(
    cloud: Cloud, approach_index: Int64, contact_index: Int64, gripper: Gripper
) -> Candidates:
    """The candidates among pairs of approach and contact points.

    r = p_c - p_a; its part orthogonal to n_c points from the hand to the object (paper section
    III-A). The contact ends up at the gripper's contact_z, the approach point on the hand's axis.

    Args:
        cloud: The cloud with its normals.
        approach_index: (M,) rows of the cloud.
        contact_index: (M,) rows of the cloud.
        gripper: Gives the opening, the fingers' depth and where the contact lies in the hand.

    Returns:
        The pairs that define an edge grasp which fits the gripper.
    """
    edge = measure_edges(cloud, approach_index, contact_index)
    pair = np.flatnonzero(
        (edge.length > MIN_EDGE)
        & (edge.length < gripper.max_opening / 2 - EDGE_MARGIN)
        & (edge.depth > MIN_DEPTH)
        & (edge.depth < gripper.finger_depth)
    )
    ahead, normal, depth = edge.ahead[pair], edge.normal[pair], edge.depth[pair]
    contact_z = gripper.contact_z_at(2 * np.abs(edge.along[pair]))
    pose = edge_grasp_poses(cloud.points[approach_index[pair]], ahead, normal, depth, contact_z)
    return Candidates(pair, approach_index[pair], contact_index[pair], -pose[:, :3, 2], depth, pose)


class EdgeMeasures(NamedTuple):
    """Edges r = p_c - p_a, decomposed along the normal at the contact."""

    normal: Float32  # (M, 3) unit n_c
    along: Float32  # (M,) r . n_c, metres
    ahead: Float32  # (M, 3) r_perp, the part of r orthogonal to n_c
    length: Float32  # (M,) |r|, metres
    depth: Float32  # (M,) |r_perp|, metres


def measure_edges(cloud: Cloud, approach_index: Int64, contact_index: Int64) -> EdgeMeasures:
    """Measure the edges of pairs (M,), (M,) of points, rows of the cloud."""
    normal = cloud.normals[contact_index]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    edge = cloud.points[contact_index] - cloud.points[approach_index]  # (M, 3) r
    along = np.einsum("md,md->m", edge, normal)
    ahead = edge - along[:, None] * normal
    length, depth = np.linalg.norm(edge, axis=1), np.linalg.norm(ahead, axis=1)
    return EdgeMeasures(normal, along, ahead, length, depth)


def edge_grasp_poses(
    approach_point: Float32, ahead: Float32, normal: Float32, depth: Float32, contact_z: Float32
) -> Float32:
    """Hand poses of edge grasps.

    Args:
        approach_point: (E, 3) p_a.
        ahead: (E, 3) r_perp, the part of p_c - p_a orthogonal to n_c.
        normal: (E, 3) unit n_c.
        depth: (E,) |r_perp|.
        contact_z: (E,) where the contact lies along the hand's z.

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
    pose[:, :3, 3] = approach_point + (depth - contact_z)[:, None] * z
    pose[:, 3, 3] = 1.0
    return pose


def retract(
    candidates: Candidates, support: SupportPlane, gripper: Gripper, margin: float = 0.0
) -> tuple[Candidates, NDArray[np.bool_]]:
    """Retract hands that would cut into the support plane along their approach, where that helps.

    The contact may move from contact_z to TIP_MARGIN inside the fingertips and no further: flat
    objects on a table are held by the tips.

    Args:
        candidates: E of them.
        support: The plane.
        gripper: Its boxes.
        margin: Metres that the hand stays above the plane.

    Returns:
        The candidates, and which of their hands (E,) are above the plane now; the others are
        unchanged.
    """
    clearance = support_clearance(candidates.T_cloud_hand, support, gripper) - margin
    rise = candidates.approach @ np.asarray(support.normal, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        back = np.where(clearance >= 0, 0.0, -clearance / rise)
    clear = (back >= 0) & (back <= gripper.tip_z - gripper.contact_z - TIP_MARGIN)
    pose = candidates.T_cloud_hand.copy()
    pose[clear, :3, 3] += back[clear, None] * candidates.approach[clear]
    return replace(candidates, T_cloud_hand=pose), clear


def support_clearance(T_cloud_hand: Float32, support: SupportPlane, gripper: Gripper) -> Float32:
    """Height of the lowest corner of each hand, fingers open, over the support plane.

    Fingers on a linkage count at their most forward position on the way to closed.

    Args:
        T_cloud_hand: (E, 4, 4).
        support: The plane.
        gripper: Its boxes.

    Returns:
        (E,) metres; negative below the plane.
    """
    boxes = gripper.boxes(gripper.max_opening, gripper.max_tip_z - gripper.tip_z)
    middle, half = boxes.mean(axis=1), (boxes[:, 1] - boxes[:, 0]) / 2  # (B, 3) each
    normal = np.asarray(support.normal)
    normal_in_hand = np.einsum("d,edk->ek", normal, T_cloud_hand[:, :3, :3])  # (E, 3)
    origin_height = T_cloud_hand[:, :3, 3] @ normal - support.offset  # (E,)
    lowest = (normal_in_hand @ middle.T - np.abs(normal_in_hand) @ half.T).min(axis=1)
    clearance: Float32 = origin_height + lowest
    return clearance.astype(np.float32)
