"""Planners without a network, Edge-Sample and an oracle, and the candidates they choose from."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from edgegrasp_cli.planners.detection import request_options, view_ids
from edgegrasp_model.candidates.edge_grasps import (
    edge_grasp_poses,
    measure_edges,
    sample_approach_points,
)
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.options import parse_options
from edgegrasp_model.scene.cloud import Cloud, CloudInput, Voxels
from edgegrasp_sim.camera import Observation, crop
from edgegrasp_sim.hand import MAX_OPENING, GraspResult
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.trial import PlannedGrasp

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# From what is seen to poses `T_world_hand` in random order, (E, 4, 4); can be pickled.
Sampler: TypeAlias = Callable[[Observation, np.random.Generator], Float32]

MAX_TRIES = 300  # candidates tried in one view
# Metres along the hand's x and y: a grasp that holds there as well is no close call.
SHIFTS = ((0.002, 0.0), (-0.002, 0.0), (0.0, 0.002), (0.0, -0.002))

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
class EdgeSamplePlanner:
    """Edge-Sample, the paper's baseline: takes any candidate, without a network."""

    sampler: Sampler

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """A random candidate; None where there is none."""
        poses = self.sampler(observation, np.random.default_rng(seed))
        if len(poses) == 0:
            return None
        return PlannedGrasp(poses[0], score=0.0, width=MAX_OPENING)


class OraclePlanner:
    """Tries candidates in a copy of the scene: the ceiling of what sampling offers.

    Takes the first random candidate that holds when tried, and when tried a little aside.
    Without one, it takes the first that holds at all; without that, any.
    """

    def __init__(self, sampler: Sampler) -> None:
        self.sampler = sampler
        self._try_grasp: Callable[[ArrayLike], GraspResult] | None = None

    def use_trial(self, try_grasp: Callable[[ArrayLike], GraspResult]) -> None:
        """Take what tries a grasp without changing the scene."""
        self._try_grasp = try_grasp

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """A candidate that holds; score 1 if safely, 0.5 if barely, 0 if none did."""
        poses = self.sampler(observation, np.random.default_rng(seed))[:MAX_TRIES]
        if len(poses) == 0:
            return None
        fallback = PlannedGrasp(poses[0], 0.0, MAX_OPENING)
        for pose in poses:
            if not self._holds(pose):
                continue
            if all(self._holds(shifted) for shifted in _shifted(pose)):
                return PlannedGrasp(pose, 1.0, MAX_OPENING)
            if fallback.score == 0.0:
                fallback = PlannedGrasp(pose, 0.5, MAX_OPENING)
        return fallback

    def _holds(self, pose: Float32) -> bool:
        if self._try_grasp is None:
            raise RuntimeError("the oracle has no scene to try grasps in; call use_trial first")
        return self._try_grasp(pose).success


def _shifted(pose: Float32) -> Iterator[Float32]:
    for along_x, along_y in SHIFTS:
        shifted = pose.copy()
        shifted[:3, 3] += along_x * pose[:3, 0] + along_y * pose[:3, 1]
        yield shifted


@dataclass(frozen=True)
class PaperCandidates:
    """Draws the candidates of the paper's evaluation, as its published code does.

    There are no top-down grasps among them, and no collision is checked but that with the table,
    at the published code's seven points of the hand. Outliers are dropped and normals estimated in
    the dense cloud, approach points sampled farthest from each other in the voxelised one. No
    constraint depends on which way a normal points.
    """

    num_approach_points: int
    num_candidates: int  # at most
    voxel_size: float  # metres

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


@dataclass
class OwnCandidates:
    """Draws the candidates that our own pipeline would score: collision-free, top-down ones too.

    The weights decide only how clouds are prepared.
    """

    rules: PlanningRules
    options: dict[str, Any] = field(default_factory=dict)
    weights: tuple[Path, ...] = ()
    model: str = ""

    @cached_property
    def detector(self) -> GraspDetector:
        """Loaded where it is first needed, so that this can be sent to worker processes."""
        return ModelCatalogue.load(self.weights).get(self.model)

    def __call__(self, observation: Observation, rng: np.random.Generator) -> Float32:
        """Poses `T_world_hand` of candidates, in random order: (E, 4, 4)."""
        seed = int(rng.integers(2**31))
        options = request_options(observation, seed, self.rules, self.options)
        cloud = CloudInput(observation.cloud, view_ids=view_ids(observation))
        prepared = self.detector.prepare(cloud, parse_options(options))
        if prepared.scene is None or not prepared.scene.approach_allowed.any():
            return np.empty((0, 4, 4), dtype=np.float32)
        sample = self.detector.sampler(prepared).all()
        poses = sample.candidates.take(sample.collision_free).T_cloud_hand
        return prepared.scene.frame.poses_in_cloud(poses[rng.permutation(len(poses))])


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

    Returns:
        The mean of the points and normals in each voxel; normals are of either sign.
    """
    dense = points.astype(np.float64)
    if len(dense) >= MIN_POINTS:  # statistical outliers
        mean = _nearest(dense)[0].mean(axis=1)
        dense = dense[mean < mean.mean() + OUTLIER_DEVIATIONS * mean.std(ddof=1)]
    if len(dense) >= MIN_POINTS:  # isolated points
        dense = dense[_nearest(dense, NEIGHBORS + 1)[0][:, -1] <= ISOLATED]
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
