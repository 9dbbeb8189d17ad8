"""Top-down candidates for low objects, whose sides are hardly seen."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edgegrasp_model.candidates.edge import EDGE_MARGIN, MIN_EDGE, Candidates, Float32, Int64
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud

LOW = 0.03  # metres over the support plane up to which contacts get a top-down grasp too
MIN_LEVEL = 0.3  # horizontal part of a normal from which its heading can be trusted
OUTLINE_RADIUS = 0.012  # metres of surface that say where the outline of a flat top runs
MIN_OUTWARD = 0.003  # metres from a neighbourhood's mean to a point on the outline
MAX_SIDEWAYS = 0.006  # metres between approach and contact point across a top-down grasp
MIN_DROP = -0.002  # metres a contact may lie above the approach point of a top-down grasp


class Headings(NamedTuple):
    """The horizontal heading of the surface at each of a cloud's N points."""

    direction: Float32  # (N, 3) unit, along the support plane
    certain: NDArray[np.bool_]  # (N,) which can be trusted


def top_down_grasps(
    cloud: Cloud,
    approach_index: Int64,
    contact_index: Int64,
    support: SupportPlane,
    gripper: Gripper,
    headings: Headings | None = None,
) -> Candidates:
    """Candidates that come straight down onto low contacts and close horizontally.

    Near a flat object's top edge the estimated normals tilt upward, and a hand that closes along
    them would cut into the table: here only their horizontal heading counts. Of a very flat
    object only the top is seen; there the heading is that of the outline seen from above.

    Args:
        cloud: The cloud with its normals.
        approach_index: (M,) rows of the cloud.
        contact_index: (M,) rows of the cloud.
        support: The plane that contacts are low over.
        gripper: Gives the opening and contact_z.
        headings: `closing_headings` of the same cloud, where the caller has them already.

    Returns:
        The pairs that allow such a grasp.
    """
    up = np.asarray(support.normal, dtype=np.float32)
    contact = cloud.points[contact_index]
    edge = contact - cloud.points[approach_index]  # (M, 3)
    heading, certain = headings or closing_headings(cloud, support)
    y = heading[contact_index]
    along, sideways = np.einsum("md,md->m", edge, y), np.einsum("md,md->m", edge, np.cross(y, -up))
    pair = np.flatnonzero(
        certain[contact_index]
        & (along > MIN_EDGE)
        & (along < gripper.max_opening / 2 - EDGE_MARGIN)
        & (np.abs(sideways) < MAX_SIDEWAYS)
        & (-edge @ up > MIN_DROP)
    )
    y, along = y[pair], along[pair, None]
    pose = np.zeros((len(pair), 4, 4), dtype=np.float32)
    pose[:, :3, 0] = np.cross(y, -up)
    pose[:, :3, 1] = y
    pose[:, :3, 2] = -up
    contact_z = gripper.contact_z_at(2 * along)
    pose[:, :3, 3] = contact[pair] - along * y + contact_z * up
    pose[:, 3, 3] = 1.0
    depth = np.maximum(-edge[pair] @ up, 0.0)
    return Candidates(pair, approach_index[pair], contact_index[pair], -pose[:, :3, 2], depth, pose)


def closing_headings(cloud: Cloud, support: SupportPlane) -> Headings:
    """The horizontal heading of the surface at each point low over the support.

    Args:
        cloud: N points.
        support: The plane; of unit normal.
    """
    up = np.asarray(support.normal, dtype=np.float32)
    low = cloud.points @ up - support.offset < LOW
    level = cloud.normals - (cloud.normals @ up)[:, None] * up
    certain = low & (np.linalg.norm(level, axis=1) > MIN_LEVEL)
    flat = np.flatnonzero(low & ~certain)
    if len(flat):
        tree = cKDTree(cloud.points)
        around: Any = tree.query_ball_point(cloud.points[flat], OUTLINE_RADIUS, return_sorted=True)
        count = np.array([len(rows) for rows in around])  # the point itself at least
        sums = np.add.reduceat(cloud.points[np.concatenate(around)], np.cumsum(count) - count)
        outward = cloud.points[flat] - sums / count[:, None]
        outward -= (outward @ up)[:, None] * up
        level[flat] = outward
        certain[flat] = np.linalg.norm(outward, axis=1) > MIN_OUTWARD
    length = np.linalg.norm(level, axis=1, keepdims=True)
    return Headings((level / np.maximum(length, 1e-9)).astype(np.float32), certain)
