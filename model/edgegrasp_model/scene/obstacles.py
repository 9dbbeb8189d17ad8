"""Solid boxes in any orientation: whether a moving hand hits them, and their distance."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float32, Float64, Floats, Int64
from edgegrasp_model.options import Box, OrientedBox
from edgegrasp_model.scene.cloud import CanonicalFrame, pose_matrix


@dataclass(frozen=True)
class SolidBoxes:
    """Boxes given by their centres and the vectors from there to the centres of their faces."""

    center: Float64  # (M, 3) metres
    half: Float64  # (M, 3, 3) rows: half extents times axes, metres

    @classmethod
    def from_shapes(cls, shapes: Sequence[Box | OrientedBox], frame: CanonicalFrame) -> Self:
        """Boxes of a request in the canonical frame."""
        centers, halves = np.empty((len(shapes), 3)), np.empty((len(shapes), 3, 3))
        for row, shape in enumerate(shapes):
            T_cloud_box, half = box_pose(shape)
            half = np.maximum(half, 1e-6)  # so that the axes of flat boxes have a direction
            centers[row], halves[row] = T_cloud_box[:3, 3], np.diag(half) @ T_cloud_box[:3, :3].T
        return cls(frame.points_from_cloud(centers), frame.directions_from_cloud(halves))

    @classmethod
    def from_hands(cls, T_cloud_hand: Float32, boxes: Float64) -> Self:
        """Boxes (B, 2, 3) of the hand frame at hands (E, 4, 4): E * B boxes, hand by hand."""
        pose = T_cloud_hand.astype(np.float64)
        turn = pose[:, :3, :3]
        middle, extent = boxes.mean(axis=1), (boxes[:, 1] - boxes[:, 0]) / 2  # (B, 3)
        center = np.einsum("edk,bk->ebd", turn, middle) + pose[:, None, :3, 3]
        half = np.einsum("edk,bk->ebkd", turn, extent)
        return cls(center.reshape(-1, 3), half.reshape(-1, 3, 3))

    def take(self, rows: NDArray[np.integer]) -> "SolidBoxes":
        """The boxes of the given rows."""
        return SolidBoxes(self.center[rows], self.half[rows])

    def corners(self) -> Float64:
        """The corners (M, 8, 3)."""
        signs = np.array(list(product((-1, 1), repeat=3)))
        return np.asarray(self.center[:, None] + signs @ self.half)

    @property
    def radius(self) -> Float64:
        """Distance (M,) of the corners from the middle."""
        return np.asarray(np.linalg.norm(self.half, axis=(1, 2)))


def box_pose(box: Box | OrientedBox) -> tuple[Float64, Float64]:
    """Pose T_cloud_box (4, 4) and half extents (3,) of a box."""
    if isinstance(box, OrientedBox):
        turn = Rotation.from_quat(box.quaternion).as_matrix()
        return pose_matrix(turn, box.center), np.array(box.half_extents)
    low, high = np.array(box.min), np.array(box.max)
    return pose_matrix(np.eye(3), (low + high) / 2), (high - low) / 2


def near_pairs(
    ours: SolidBoxes, theirs: SolidBoxes, within: Floats | float
) -> Iterator[tuple[Int64, SolidBoxes]]:
    """For each of their boxes, rows of ours that may be nearer than `within`, and copies of it.

    `within` is in metres. Bounding spheres are compared, so few pairs are left to measure exactly.
    """
    for place, (center, radius) in enumerate(zip(theirs.center, theirs.radius, strict=True)):
        apart = np.linalg.norm(ours.center - center, axis=1) - ours.radius - radius
        near = np.flatnonzero(apart < within)
        yield near, theirs.take(np.full(len(near), place))


def separation(ours: SolidBoxes, theirs: SolidBoxes, sweep: Float64 | None = None) -> Float64:
    """Widest gap (M,) between boxes along any separating axis, row by row, metres.

    Negative: they overlap, by the distance they would have to move apart. Positive: a lower bound
    of their distance. `sweep` (3,) is the motion over which ours are swept.
    """
    edges = ours.half  # (M, 3 or 4, 3) generators: a swept box is a sum of four segments
    center = ours.center
    if sweep is not None and sweep.any():
        edges = np.concatenate([edges, np.broadcast_to(sweep / 2, (len(edges), 1, 3))], axis=1)
        center = center + sweep / 2
    own = [np.cross(edges[:, i], edges[:, j]) for i in range(edges.shape[1]) for j in range(i)]
    crossed = np.cross(edges[:, :, None], theirs.half[:, None])
    crossed = crossed.reshape(len(center), 3 * edges.shape[1], 3)
    axes = np.concatenate([np.stack(own, axis=1), theirs.half, crossed], axis=1)  # (M, A, 3)
    length = np.linalg.norm(axes, axis=2)
    axes = axes * (1.0 / np.maximum(length, 1e-12))[..., None]
    reach = np.abs(axes @ edges.transpose(0, 2, 1)).sum(axis=2)
    reach += np.abs(axes @ theirs.half.transpose(0, 2, 1)).sum(axis=2)
    gap = np.abs(np.einsum("mad,md->ma", axes, theirs.center - center)) - reach
    return np.asarray(np.where(length > 1e-12, gap, -np.inf).max(axis=1))


def signed_distance(ours: SolidBoxes, theirs: SolidBoxes) -> Float64:
    """Metres (M,) between boxes, row by row; negative: how far they would have to move apart."""
    distance, some = separation(ours, theirs), 20_000  # pairs at a time, which bounds the memory
    apart = np.flatnonzero(distance > 0)
    # Edges (12, 2) join corners that differ in one sign.
    edges_of_box = np.array([(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit])
    for start in range(0, len(apart), some):
        rows = apart[start : start + some]
        one, other = ours.take(rows), theirs.take(rows)
        # The nearest points are a corner and a point of the other box, or lie on two edges.
        p, q = one.corners(), other.corners()
        least = np.minimum(_corner_distance(p, other), _corner_distance(q, one))
        edges = q[:, edges_of_box[:, 0]], q[:, edges_of_box[:, 1]]
        for first, last in edges_of_box:
            between = _segment_distance(p[:, first, None], p[:, last, None], *edges)
            least = np.minimum(least, between.min(axis=1))
        distance[rows] = least
    return distance


def _corner_distance(corners: Float64, boxes: SolidBoxes) -> Float64:
    """Least distance (M,) of corners (M, 8, 3) to M boxes."""
    extent = np.linalg.norm(boxes.half, axis=2)  # (M, 3)
    axes = boxes.half / extent[..., None]
    within = np.abs((corners - boxes.center[:, None]) @ axes.transpose(0, 2, 1))  # (M, 8, 3)
    outside = np.maximum(within - extent[:, None], 0.0)
    return np.asarray(np.linalg.norm(outside, axis=2).min(axis=1))


def _segment_distance(p0: Float64, p1: Float64, q0: Float64, q1: Float64) -> Float64:
    """Distance between segments p0 p1 and q0 q1, (..., 3) each, of nonzero length."""
    p, q, r = p1 - p0, q1 - q0, p0 - q0
    pp, qq, pq = (p * p).sum(-1), (q * q).sum(-1), (p * q).sum(-1)
    pr, qr = (p * r).sum(-1), (q * r).sum(-1)
    across = pp * qq - pq * pq
    parallel = across < 1e-9 * pp * qq
    s = np.where(parallel, 0.0, (pq * qr - pr * qq) / np.where(parallel, 1.0, across))
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((pq * s + qr) / qq, 0.0, 1.0)
    s = np.clip((pq * t - pr) / pp, 0.0, 1.0)
    return np.asarray(np.linalg.norm(r + s[..., None] * p - t[..., None] * q, axis=-1))
