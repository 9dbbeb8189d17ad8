"""A detection as the reference system does it: clean the dense cloud, then voxelise, ball by ball.

The same steps and limits as there: outliers and normals of the dense cloud, its voxels of 4.5 mm,
balls of 0.05 m one after another, every contact that fits the hand. No collision check.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import open3d as o3d
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from edgegrasp_model.ball_batch import BallBatch

Float32 = NDArray[np.float32]

VOXEL_SIZE, RADIUS, K = 0.0045, 0.05, 16  # metres, metres, neighbours
OUTLIER_NEIGHBORS, OUTLIER_DEVIATIONS = 30, 1.0
NORMAL_NEIGHBORS, NORMAL_RADIUS = 30, 0.04
EDGE_RANGE = (0.003, 0.038)  # metres
MAX_DEPTH = 0.04  # metres
MIN_RISE = -0.1  # of the outward approach, along up
CONTACT_Z = 0.065 + 0.04  # metres ahead of the panda_hand link


@dataclass(frozen=True)
class TextbookGrasps:
    """Ranked edge grasps, the best first."""

    score: Float32  # (E,)
    T_cloud_hand: Float32  # (E, 4, 4)


def prepare(cloud: Float32, viewpoint: Float32) -> tuple[Float32, Float32]:
    """Points (N, 3) and normals (N, 3) that the network sees, of a dense cloud (D, 3)."""
    dense = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.astype(np.float64)))
    dense, _ = dense.remove_statistical_outlier(OUTLIER_NEIGHBORS, OUTLIER_DEVIATIONS)
    near = o3d.geometry.KDTreeSearchParamHybrid(radius=NORMAL_RADIUS, max_nn=NORMAL_NEIGHBORS)
    dense.estimate_normals(near)
    dense.orient_normals_towards_camera_location(viewpoint.astype(np.float64))
    voxels = dense.voxel_down_sample(VOXEL_SIZE)
    return np.asarray(voxels.points, np.float32), np.asarray(voxels.normals, np.float32)


def balls(
    points: Float32, normals: Float32, approach_points: int, candidates: int, seed: int
) -> BallBatch:
    """Balls around approach points sampled at random, and the edge grasps in them."""
    rng = np.random.default_rng(seed)
    tree, offset = cKDTree(points), 0
    batches = []
    for row in rng.choice(len(points), approach_points, replace=False):
        members = np.array(sorted(tree.query_ball_point(points[row], RADIUS)))
        centred, normal = points[members] - points[row], normals[members]
        _, neighbors = cKDTree(centred).query(centred, k=min(K, len(members)))
        unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        ahead = centred - (centred * unit).sum(1, keepdims=True) * unit
        depth, length = np.linalg.norm(ahead, axis=1), np.linalg.norm(centred, axis=1)
        approach = -ahead / np.maximum(depth, 1e-9)[:, None]
        fits = (length > EDGE_RANGE[0]) & (length < EDGE_RANGE[1]) & (depth < MAX_DEPTH)
        fits &= (approach[:, 2] > MIN_RISE) & (depth > 1e-4)
        batches.append((centred, normal, neighbors + offset, approach, depth, fits))
        offset += len(members)
    sizes = [len(part[0]) for part in batches]
    centred, normal, neighbors, approach, depth, fits = (
        np.concatenate(parts) for parts in zip(*batches, strict=True)
    )
    contact = np.flatnonzero(fits)
    if len(contact) > candidates:
        contact = np.sort(rng.choice(contact, candidates, replace=False))
    return BallBatch(
        points=torch.from_numpy(centred),
        normals=torch.from_numpy(normal),
        neighbors=torch.from_numpy(neighbors),
        ball_of_point=torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes)),
        num_balls=len(sizes),
        contact=torch.from_numpy(contact),
        approach=torch.from_numpy(approach[contact]),
        depth=torch.from_numpy(depth[contact]),
    )


def detect(
    cloud: Float32,
    viewpoint: Float32,
    logits: Callable[[BallBatch], Tensor],
    approach_points: int = 32,
    candidates: int = 2000,
    seed: int = 0,
) -> TextbookGrasps:
    """Ranked grasps of a dense cloud (D, 3), in metres."""
    points, normals = prepare(cloud, viewpoint)
    batch = balls(points, normals, approach_points, candidates, seed)
    with torch.inference_mode():
        score = torch.sigmoid(logits(batch)).numpy()
    approach, y = batch.approach.numpy(), batch.normals[batch.contact].numpy()
    z = -approach
    y = y - (y * z).sum(1, keepdims=True) * z
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    pose = np.zeros((len(score), 4, 4), np.float32)
    pose[:, :3, 0], pose[:, :3, 1], pose[:, :3, 2] = np.cross(y, z), y, z
    from_approach = (CONTACT_Z - batch.depth.numpy())[:, None] * approach
    contact = batch.points[batch.contact].numpy()
    pose[:, :3, 3] = contact - batch.depth.numpy()[:, None] * z + from_approach
    pose[:, 3, 3] = 1.0
    best = np.argsort(-score)
    return TextbookGrasps(score[best], pose[best])
