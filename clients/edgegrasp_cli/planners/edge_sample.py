"""Edge-Sample: candidate edge grasps drawn uniformly, no network (the paper's baseline)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edgegrasp_model.candidates import edge_grasps, support_clearance
from edgegrasp_model.cloud import Cloud, estimate_normals, inliers, orient_normals, voxelise
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.sampling import sample_approach_points
from edgegrasp_model.support import SupportPlane
from edgegrasp_sim.gripper import MAX_OPENING
from edgegrasp_sim.simulation import Observation
from edgegrasp_sim.trials import PlannedGrasp

Float32 = NDArray[np.float32]

MIN_APPROACH_UP = -0.1  # the hand does not come from below: cosine of approach and up
MIN_POINTS = 30  # fewer give no normals
TABLE_MARGIN = 0.005  # metres above the table below which points belong to it


@dataclass(frozen=True)
class CandidateSampler:
    """Draws the candidates of the reference evaluation: no level grasps, no collision check.

    Attributes:
        num_approach_points: approach points drawn uniformly from the cloud.
        num_candidates: candidates kept at most.
        voxel_size: metres.
    """

    num_approach_points: int
    num_candidates: int
    voxel_size: float

    def __call__(self, observation: Observation, rng: np.random.Generator) -> Float32:
        """Poses `T_world_hand` of random candidates, in random order: (E, 4, 4)."""
        cloud = _clean_cloud(observation, self.voxel_size)
        if cloud is None:
            return np.empty((0, 4, 4), dtype=np.float32)
        gripper = load_gripper("panda")
        approach = sample_approach_points(cloud.points, self.num_approach_points, "uniform", rng)
        candidates = edge_grasps(cloud, *_pairs(cloud, approach, gripper.max_opening / 2), gripper)
        candidates = candidates.take(candidates.approach[:, 2] > MIN_APPROACH_UP)
        table = SupportPlane(normal=(0.0, 0.0, 1.0), offset=observation.table_height)
        clearance = support_clearance(candidates.T_cloud_hand, table, gripper)
        poses = candidates.take(clearance >= 0.0).T_cloud_hand
        return poses[rng.permutation(len(poses))[: self.num_candidates]]


@dataclass(frozen=True)
class EdgeSampleFactory:
    """Makes the baseline in each worker process."""

    sampler: CandidateSampler

    def __call__(self) -> "EdgeSamplePlanner":
        """The baseline."""
        return EdgeSamplePlanner(self.sampler)


@dataclass(frozen=True)
class EdgeSamplePlanner:
    """Takes any candidate: what the candidates are worth without a network."""

    sampler: CandidateSampler

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """A random candidate; None where there is none."""
        poses = self.sampler(observation, np.random.default_rng(seed))
        if len(poses) == 0:
            return None
        return PlannedGrasp(poses[0], score=0.0, width=MAX_OPENING)


def _clean_cloud(observation: Observation, voxel_size: float) -> Cloud | None:
    """Voxels with normals turned to the camera that saw most of each; None of too few points."""
    above = observation.cloud[:, 2] > observation.table_height + TABLE_MARGIN
    points, views = observation.cloud[above], observation.view_ids[above].astype(np.int64)
    if len(points) < MIN_POINTS:
        return None
    voxels = voxelise(points, voxel_size)
    middles = voxels.mean(points)
    kept = inliers(middles)
    cameras = observation.camera_positions
    seen_from = cameras[voxels.commonest(views, len(cameras))][kept]
    middles = middles[kept]
    return Cloud(middles, orient_normals(middles, estimate_normals(middles), seen_from))


def _pairs(
    cloud: Cloud, approach: NDArray[np.int64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Approach points and the points within `radius` of them, as rows of the cloud: (M,) each."""
    balls = cKDTree(cloud.points).query_ball_point(
        cloud.points[approach], radius, return_sorted=True
    )
    contact = [np.asarray(rows, dtype=np.int64) for rows in balls]
    return np.repeat(approach, [len(rows) for rows in contact]), np.concatenate(contact)
