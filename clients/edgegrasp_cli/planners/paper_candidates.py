"""The candidates of the paper's evaluation, as its published code draws them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edgegrasp_model.candidates.edge_grasps import (
    edge_grasp_poses,
    measure_edges,
    sample_approach_points,
)
from edgegrasp_model.scene.cloud import Cloud, Voxels
from edgegrasp_sim.observation import Observation, crop

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NEIGHBORS = 30  # of each point, itself among them, for outliers and normals
OUTLIER_DEVIATIONS = 1.0
ISOLATED = 0.03  # metres in which a point must have more than NEIGHBORS others
NORMAL_RADIUS = 0.04  # metres
MIN_POINTS = 100  # fewer are no view

MIN_EDGE, MAX_EDGE = 0.003, 0.038  # metres between approach and contact point
MAX_DEPTH = 0.04  # metres the contact lies ahead of the approach point
MIN_APPROACH_UP = -0.1  # the hand does not come from below: cosine of approach and up
MIN_CANDIDATES = 10  # fewer before the table check are no answer
CONTACT_Z = 0.105  # metres along the hand's z: 7 mm inside the fingertips, to the paper's 72 mm

# Points of the hand, metres in its frame, that have to stay TABLE_CLEARANCE above the table.
PROBES = np.array(
    [
        [0.0, 0.0, 0.02],
        [0.012, -0.09, 0.055],
        [-0.012, -0.09, 0.055],
        [0.012, 0.09, 0.055],
        [-0.012, 0.09, 0.055],
        [0.005, 0.09, 0.118],
        [0.005, -0.09, 0.118],
    ]
)
TABLE_CLEARANCE = 0.004  # metres


@dataclass(frozen=True)
class PaperCandidates:
    """Draws candidate edge grasps without level grasps and without a check for collisions.

    Outliers are dropped and normals estimated in the dense cloud, approach points sampled
    farthest from each other in the voxelised one; what of a hand may come near the table is the
    published code's probe points. No constraint depends on which way a normal points.

    Attributes:
        num_approach_points: approach points sampled.
        num_candidates: candidates kept at most.
        voxel_size: metres.
    """

    num_approach_points: int
    num_candidates: int
    voxel_size: float

    def __call__(self, observation: Observation, rng: np.random.Generator) -> Float32:
        """Poses `T_world_hand` of random candidates, in random order: (E, 4, 4)."""
        cloud = clean_cloud(crop(observation.cloud, observation.workspace), self.voxel_size)
        if cloud is None:
            return np.empty((0, 4, 4), dtype=np.float32)
        approach = sample_approach_points(cloud.points, self.num_approach_points, "farthest", rng)
        balls: Any = cKDTree(cloud.points).query_ball_point(
            cloud.points[approach], MAX_EDGE, return_sorted=True
        )
        approach = np.repeat(approach, [len(rows) for rows in balls])
        contact = np.concatenate([np.asarray(rows, dtype=np.int64) for rows in balls])
        _, poses = paper_grasps(cloud, approach, contact, observation.table_height)
        return poses[rng.permutation(len(poses))[: self.num_candidates]]


def paper_grasps(
    cloud: Cloud, approach_index: Int64, contact_index: Int64, table_height: float
) -> tuple[Int64, Float32]:
    """The candidates among pairs of points.

    Args:
        cloud: world frame.
        approach_index: (M,) rows of the cloud.
        contact_index: (M,) rows of the cloud.
        table_height: metres.

    Returns:
        Which pairs (E,) are candidates, and their `T_world_hand` (E, 4, 4).
    """
    edge = measure_edges(cloud, approach_index, contact_index)
    with np.errstate(invalid="ignore", divide="ignore"):
        approach_up = -edge.ahead[:, 2] / edge.depth
    pair = np.flatnonzero(
        (edge.length > MIN_EDGE)
        & (edge.length < MAX_EDGE)
        & (edge.depth > 0.0)
        & (edge.depth < MAX_DEPTH)
        & (approach_up > MIN_APPROACH_UP)
    )
    if len(pair) < MIN_CANDIDATES:
        return np.empty(0, dtype=np.int64), np.empty((0, 4, 4), dtype=np.float32)
    pose = edge_grasp_poses(
        cloud.points[approach_index[pair]],
        edge.ahead[pair],
        edge.normal[pair],
        edge.depth[pair],
        np.full(len(pair), CONTACT_Z, dtype=np.float32),
    )
    heights = PROBES @ pose[:, 2, :3].T + pose[:, 2, 3]  # (7, E)
    clear = heights.min(axis=0) > table_height + TABLE_CLEARANCE
    return pair[clear], pose[clear]


def clean_cloud(points: Float32, voxel_size: float) -> Cloud | None:
    """Outliers dropped, normals estimated, then voxels; None where too few points are left.

    Args:
        points: (N, 3) dense cloud above the table, metres.
        voxel_size: metres.

    Returns:
        The mean of the points and normals in each voxel; normals are of either sign.
    """
    dense = points.astype(np.float64)
    for keep in (_inliers, _in_company):
        if len(dense) < MIN_POINTS:
            return None
        dense = dense[keep(dense)]
    if len(dense) < MIN_POINTS:
        return None
    normals = estimate_normals(dense)
    cells = np.floor((dense - (dense.min(axis=0) - voxel_size / 2)) / voxel_size).astype(np.int64)
    _, first, voxel, count = np.unique(
        cells, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    voxels = Voxels(voxel.ravel(), count)
    against = np.einsum("nd,nd->n", normals, normals[first[voxels.voxel]]) < 0
    normals = np.where(against[:, None], -normals, normals)
    return Cloud(voxels.mean(dense), voxels.mean(normals))


def _inliers(points: Float64) -> NDArray[np.bool_]:
    """Which points (N,) are as near to their neighbours as the others."""
    distances, _ = _nearest(points)
    mean = distances.mean(axis=1)
    near: NDArray[np.bool_] = mean < mean.mean() + OUTLIER_DEVIATIONS * mean.std(ddof=1)
    return near


def _in_company(points: Float64) -> NDArray[np.bool_]:
    """Which points (N,) have more than NEIGHBORS points near them, themselves included."""
    distances, _ = _nearest(points, NEIGHBORS + 1)
    near: NDArray[np.bool_] = distances[:, -1] <= ISOLATED
    return near


def estimate_normals(points: Float64) -> Float64:
    """Unit normals (N, 3) of either sign: least variance among each point's neighbours."""
    distances, rows = _nearest(points)
    counts = (distances <= NORMAL_RADIUS)[:, :, None]
    near = points[rows]
    middle = (near * counts).sum(axis=1, keepdims=True) / counts.sum(axis=1, keepdims=True)
    near = (near - middle) * counts
    _, vectors = np.linalg.eigh(near.transpose(0, 2, 1) @ near)
    normals: Float64 = vectors[:, :, 0]
    return normals


def _nearest(points: Float64, count: int = NEIGHBORS) -> tuple[Float64, Int64]:
    """Distances and rows (N, count) of the points nearest to each, itself first."""
    distances, rows = cKDTree(points).query(points, k=count)
    return np.asarray(distances), np.asarray(rows)
