"""From a caller's cloud to the candidates that the network scores."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model import cloud as clouds
from edgegrasp_model.ball_batch import BallCrop, crop_balls
from edgegrasp_model.candidates import Candidates, drawn_back, edge_grasps, from_above, level_grasps
from edgegrasp_model.cloud import Cloud
from edgegrasp_model.collision import collides
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import HandView, hand_views
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.sampling import sample_approach_points

Float32 = NDArray[np.float32]

SUPPORT_MARGIN = 0.005  # metres above the support plane below which points belong to it
MIN_POINTS = 4  # fewer make no surface
SAMPLING_ROUNDS = 4  # further approach points are tried where no hand is free of collision
OVERSAMPLING = 2  # hands checked for collision, in multiples of num_candidates
APPROACH_STREAM, CANDIDATE_STREAM = 0, 1  # random streams of one request


@dataclass(frozen=True)
class Sample:
    """Candidates around one set of approach points."""

    approach_index: NDArray[np.int64]  # (A,) rows of the cloud
    crop: BallCrop
    candidates: Candidates  # E of them; `pair` is their contact's row in `crop`
    view: HandView  # of the same candidates
    collision_free: NDArray[np.bool_]  # (E,)


def clean_cloud(
    points: Float32, options: DetectOptions, voxel_size: float, counts: dict[str, int]
) -> Cloud | None:
    """Crop, voxelise, drop outliers, estimate normals and turn them to the viewpoint.

    Args:
        points: (N, 3) validated, metres.
        options: workspace, support, viewpoint and up.
        voxel_size: Metres.
        counts: Gets the number of points left after each step.

    Returns:
        The cloud, or None where too few points are left to make a surface.
    """
    counts["points"] = len(points)
    if options.workspace is not None:
        box = options.workspace
        inside = (points >= np.asarray(box.min)) & (points <= np.asarray(box.max))
        points = points[inside.all(axis=1)]
    counts["in_workspace"] = len(points)
    if options.support is not None:
        height = points @ np.asarray(options.support.normal) - options.support.offset
        points = points[height > SUPPORT_MARGIN]
    counts["above_support"] = len(points)
    if len(points):
        points = clouds.voxel_downsample(points, voxel_size)
    counts["voxels"] = len(points)
    if len(points):
        points = clouds.without_outliers(points)
    counts["kept"] = len(points)
    if len(points) < MIN_POINTS:
        return None
    up = np.asarray(options.up, dtype=np.float32)
    viewpoint = clouds.assumed_viewpoint(points, up)
    if options.viewpoint is not None:
        viewpoint = np.asarray(options.viewpoint, dtype=np.float32)
    normals = clouds.orient_normals(points, clouds.estimate_normals(points), viewpoint)
    return Cloud(points, normals)


def sample_candidates(
    cloud: Cloud,
    options: DetectOptions,
    gripper: Gripper,
    crop_radius: float,
    k: int,
    counts: dict[str, int],
) -> Sample:
    """Sample approach points and the candidates around them, free of collision where possible.

    Args:
        cloud: The clean cloud.
        options: Sampling, constraints and seed.
        gripper: What has to fit.
        crop_radius: Radius of the balls, metres.
        k: Neighbours in the graph.
        counts: Gets the number of candidates left after each constraint, over all rounds.

    Returns:
        At most num_candidates candidates. With `collision: avoid` none of them collides.
    """
    rng_approach = np.random.default_rng([options.seed, APPROACH_STREAM])
    rng_candidates = np.random.default_rng([options.seed, CANDIDATE_STREAM])
    for _ in range(SAMPLING_ROUNDS):
        approach_index = sample_approach_points(
            cloud.points, options.num_approach_points, options.sampling, rng_approach
        )
        crop = crop_balls(cloud.points, approach_index, crop_radius, k)
        candidates = _constrained(cloud, approach_index, crop, options, gripper, counts)
        limit = OVERSAMPLING * options.num_candidates
        if len(candidates) > limit:
            candidates = candidates.take(_subset(len(candidates), limit, rng_candidates))
        view = hand_views(cloud, candidates.T_cloud_hand, gripper)
        free = ~collides(view, gripper)
        _add(counts, "collision_free", int(free.sum()))
        if free.any() or options.collision.mode == "ignore":
            break
    rows = _preferred(free, options, rng_candidates)
    counts["scored"] = len(rows)
    return Sample(approach_index, crop, candidates.take(rows), view.take(rows), free[rows])


def _constrained(
    cloud: Cloud,
    approach_index: NDArray[np.int64],
    crop: BallCrop,
    options: DetectOptions,
    gripper: Gripper,
    counts: dict[str, int],
) -> Candidates:
    """The edge grasps of some balls that satisfy every constraint but collision."""
    _add(counts, "approach_points", len(approach_index))
    _add(counts, "pairs", len(crop.ball_rows))
    pairs = approach_index[crop.ball_of_point], crop.ball_rows
    candidates = edge_grasps(cloud, *pairs, gripper)
    if options.support is not None:
        level = level_grasps(cloud, *pairs, options.support, gripper)
        candidates = Candidates.concatenate([candidates, level])
    _add(counts, "candidates", len(candidates))
    up = np.asarray(options.up, dtype=np.float32)
    candidates = candidates.take(from_above(candidates, up))
    _add(counts, "from_above", len(candidates))
    if options.support is not None:
        candidates = drawn_back(candidates, options.support, gripper)
    _add(counts, "clear_of_support", len(candidates))
    return candidates


def _preferred(
    free: NDArray[np.bool_], options: DetectOptions, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Ascending rows of at most num_candidates candidates, those free of collision first."""
    if options.collision.mode == "ignore":
        return _subset(len(free), options.num_candidates, rng)
    clear, hit = np.flatnonzero(free), np.flatnonzero(~free)
    rows = clear[_subset(len(clear), options.num_candidates, rng)]
    if options.collision.mode == "penalise":
        rest = _subset(len(hit), options.num_candidates - len(rows), rng)
        rows = np.sort(np.concatenate([rows, hit[rest]]))
    return rows


def _subset(size: int, limit: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Ascending rows of at most `limit` out of `size`."""
    if size <= limit:
        return np.arange(size, dtype=np.int64)
    return np.sort(rng.choice(size, limit, replace=False)).astype(np.int64)


def _add(counts: dict[str, int], name: str, number: int) -> None:
    counts[name] = counts.get(name, 0) + number
