"""A detection as the reference system does it: clean the dense cloud, voxelise, ball by ball.

The steps and limits of the authors' evaluation, each with the plain library call for it: outliers
by distance and by number of neighbours, normals of the dense cloud, turned one after another to
agree with their neighbours', voxels of 4.5 mm, farthest points, balls of 0.05 m, every contact that
fits the hand, hands that cut into the table left out: the only collision that is looked for.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import open3d as o3d
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from edgegrasp_model.networks.balls import BallBatch

Float32 = NDArray[np.float32]

VOXEL_SIZE, RADIUS, K = 0.0045, 0.05, 16  # metres, metres, neighbours
OUTLIER_NEIGHBORS, OUTLIER_DEVIATIONS = 30, 1.0
LONELY_NEIGHBORS, LONELY_RADIUS = 30, 0.03  # fewer points than that within the radius, metres
NORMAL_NEIGHBORS, NORMAL_RADIUS = 30, 0.04
EDGE_RANGE = (0.003, 0.038)  # metres
MAX_DEPTH = 0.04  # metres
MIN_RISE = -0.1  # of the outward approach, along up
CONTACT_Z = 0.065  # metres ahead of the frame that poses are given in
COM_Z = 0.04  # metres that this frame lies ahead of the panda_hand link
TABLE_MARGIN = 0.004  # metres that the hand stays above the table
# Points of the hand that must stay above the table: behind it, its corners, its fingers' tips.
HAND_POINTS = np.array(
    [
        [0, 0, -0.02],
        *([x, y, 0.015] for x in (-0.012, 0.012) for y in (-0.09, 0.09)),
        *([0.005, y, 0.078] for y in (-0.09, 0.09)),
    ],
    dtype=np.float32,
)


@dataclass(frozen=True)
class Candidates:
    """E edge grasps that fit the hand and clear the table."""

    ball: NDArray[np.int64]  # (E,) which of the approach points
    contact: NDArray[np.int64]  # (E,) rows of the cloud
    approach: Float32  # (E, 3) outward
    depth: Float32  # (E,) metres
    T_cloud_hand: Float32  # (E, 4, 4)


def prepare(cloud: Float32) -> tuple[Float32, Float32]:
    """Points (N, 3) and normals (N, 3) that the network sees, of a dense cloud (D, 3)."""
    dense = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.astype(np.float64)))
    dense, _ = dense.remove_statistical_outlier(OUTLIER_NEIGHBORS, OUTLIER_DEVIATIONS)
    dense, _ = dense.remove_radius_outlier(LONELY_NEIGHBORS, LONELY_RADIUS)
    near = o3d.geometry.KDTreeSearchParamHybrid(radius=NORMAL_RADIUS, max_nn=NORMAL_NEIGHBORS)
    dense.estimate_normals(near)
    dense.orient_normals_consistent_tangent_plane(NORMAL_NEIGHBORS)
    voxels = dense.voxel_down_sample(VOXEL_SIZE)
    return np.asarray(voxels.points, np.float32), np.asarray(voxels.normals, np.float32)


def farthest_points(points: Float32, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Ascending rows of `count` points (N, 3), each the farthest from those before it."""
    rows = [int(rng.integers(len(points)))]
    nearest = np.full(len(points), np.inf, dtype=np.float32)
    while len(rows) < count:
        nearest = np.minimum(nearest, ((points - points[rows[-1]]) ** 2).sum(axis=1))
        rows.append(int(nearest.argmax()))
    return np.unique(rows).astype(np.int64)


def candidates(
    points: Float32, normals: Float32, approach_rows: NDArray[np.int64], table_height: float
) -> Candidates:
    """Every contact around each approach point that makes an edge grasp, ball after ball."""
    tree, parts = cKDTree(points), []
    for ball, row in enumerate(approach_rows):
        members = np.array(sorted(tree.query_ball_point(points[row], RADIUS)))
        edge, normal = points[members] - points[row], normals[members]
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        ahead = edge - (edge * normal).sum(axis=1, keepdims=True) * normal
        depth, length = np.linalg.norm(ahead, axis=1), np.linalg.norm(edge, axis=1)
        approach = -ahead / np.maximum(depth, 1e-12)[:, None]
        fits = (length > EDGE_RANGE[0]) & (length < EDGE_RANGE[1]) & (depth < MAX_DEPTH)
        fits &= approach[:, 2] > MIN_RISE
        pose = poses(points[row], normal[fits], approach[fits], depth[fits])
        at = np.einsum("ed,pd->ep", pose[:, 2, :3], HAND_POINTS) + pose[:, 2, 3:]  # heights (E, 7)
        clear = (at > table_height + TABLE_MARGIN).all(axis=1)
        contact = members[fits][clear]
        balls = np.full(len(contact), ball)
        parts.append((balls, contact, approach[fits][clear], depth[fits][clear], pose[clear]))
    return Candidates(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def poses(approach_point: Float32, normal: Float32, approach: Float32, depth: Float32) -> Float32:
    """Poses (E, 4, 4) of the hand: z ahead, y along the contact's normal."""
    z = -approach
    x = np.cross(normal, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    pose = np.zeros((len(z), 4, 4), np.float32)
    pose[:, :3, 0], pose[:, :3, 1], pose[:, :3, 2] = x, np.cross(z, x), z
    pose[:, :3, 3] = approach_point + (CONTACT_Z - depth)[:, None] * approach
    pose[:, 3, 3] = 1.0
    return pose


def balls(
    points: Float32, normals: Float32, approach_rows: NDArray[np.int64], grasps: Candidates
) -> BallBatch:
    """The balls around the approach points, one after another, with the grasps in them."""
    tree, offset = cKDTree(points), 0
    parts, contacts = [], []
    for ball, row in enumerate(approach_rows):
        members = np.array(sorted(tree.query_ball_point(points[row], RADIUS)))
        centred = points[members] - points[row]
        _, neighbors = cKDTree(centred).query(centred, k=min(K, len(members)))
        parts.append((centred, normals[members], neighbors + offset))
        contacts.append(offset + np.searchsorted(members, grasps.contact[grasps.ball == ball]))
        offset += len(members)
    sizes = torch.tensor([len(part[0]) for part in parts])
    centred, normal, neighbors = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return BallBatch(
        points=torch.from_numpy(centred),
        normals=torch.from_numpy(normal),
        neighbors=torch.from_numpy(neighbors),
        ball_of_point=torch.repeat_interleave(torch.arange(len(sizes)), sizes),
        num_balls=len(sizes),
        contact=torch.from_numpy(np.concatenate(contacts)),
        approach=torch.from_numpy(grasps.approach),
        depth=torch.from_numpy(grasps.depth),
    )


def detect(
    cloud: Float32,
    table_height: float,
    logits: Callable[[BallBatch], Tensor],
    approach_points: int = 32,
    most: int = 2000,
    seed: int = 0,
) -> tuple[Float32, Float32]:
    """Scores (E,) and `T_cloud_hand` (E, 4, 4), best first, of a dense cloud (D, 3), metres."""
    rng = np.random.default_rng(seed)
    points, normals = prepare(cloud)
    rows = farthest_points(points, approach_points, rng)
    found = candidates(points, normals, rows, table_height)
    if len(found.contact) > most:
        some = np.sort(rng.choice(len(found.contact), most, replace=False))
        found = Candidates(*(getattr(found, name)[some] for name in Candidates.__annotations__))
    batch = balls(points, normals, rows, found)
    with torch.inference_mode():
        score = torch.sigmoid(logits(batch)).numpy()
    best = np.argsort(-score)
    T_cloud_hand = found.T_cloud_hand[best].copy()
    T_cloud_hand[:, :3, 3] -= COM_Z * T_cloud_hand[:, :3, 2]
    return score[best], T_cloud_hand
