"""Approach points, the edge grasps around them, and their centred variants."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Bools, Float32, Int64
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.kernels import extents_between, in_hands
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.results import NoGrasp
from edgegrasp_model.scene.cloud import Cloud, unit

MIN_EDGE = 0.003  # metres between approach and contact point
EDGE_MARGIN = 0.002  # metres an edge stays below half the opening
MIN_DEPTH = 1e-4  # metres; a shallower edge has no approach direction
TIP_MARGIN = 0.002  # metres a contact stays inside the fingertips when the hand retracts
CLOSED_FURTHER = 0.01  # metres by which an object may be narrower than it seems
WIDE = 0.75  # share of the opening from which an object counts as wide
BESIDE_PADS = 0.004  # metres beside the finger pads in which points count
CELLS = tuple(0.04 * 0.7**level for level in range(8))  # metres, of grids over points
NODES, SPREAD = 2**14, 2654435761  # nodes along a grid; its multiples modulo 2^32 look random


def spread(
    points: Float32,  # (N, 3)
    count: int,
    before: Sequence[int] | Int64 = (),  # (B,) rows chosen earlier, which are excluded
) -> Int64:
    """Choose `count` different rows far from each other, or all of them if there are fewer.

    They lie nearest to the nodes of grids, of which each is finer than the one before, around the
    middle of the points: noise and other points hardly change them.
    """
    chosen, total = np.asarray(before, dtype=np.int64), min(len(before) + count, len(points))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    offset = (points - middle).astype(np.float64)
    for cell in CELLS:
        if len(chosen) == total:
            break
        place = offset / cell
        node = np.rint(place)
        number = (node + NODES // 2) @ (NODES**2, NODES, 1.0)
        order = np.argsort(number + np.square(place - node).sum(axis=1))
        nearest = order[np.diff(number[order], prepend=-1.0) > 0]
        free = nearest[~np.isin(number[nearest], number[chosen])]
        mixed = number[free].astype(np.uint64) * np.uint64(SPREAD) % np.uint64(2**32)
        chosen = np.append(chosen, free[np.argsort(mixed)][: total - len(chosen)])
    rest = np.delete(np.arange(len(points)), chosen)[: total - len(chosen)]
    return np.append(chosen[len(before) :], rest)


class BallCrop(NamedTuple):
    """Balls of points, as rows of their cloud: P rows in total, ball after ball."""

    ball_rows: Int64  # (P,) rows of the cloud, ascending within each ball
    ball_of_point: Int64  # (P,) ascending, 0..A-1

    def bounds(self, ball: Int64) -> tuple[Int64, Int64]:
        """Places in `ball_rows` where the points of balls (M,) begin, and where they end."""
        ends = np.searchsorted(self.ball_of_point, np.arange(ball.max(initial=-1) + 2))
        return ends[ball], ends[ball + 1]


def crop_balls(
    points: Float32,  # (N, 3) metres
    approach_index: NDArray[np.integer],  # (A,) rows of `points`; one ball each
    radius: float,  # metres
) -> BallCrop:
    """Crop a ball (paper: of radius G_w / 2) around each approach point; balls may overlap."""
    approach_index = np.asarray(approach_index, dtype=np.int64)
    members = cKDTree(points).query_ball_point(points[approach_index], radius, return_sorted=True)
    ball_of_point = np.repeat(np.arange(len(members)), [len(rows) for rows in members])
    ball_rows = np.concatenate([np.empty(0), *members]).astype(np.int64)
    return BallCrop(ball_rows, ball_of_point)


@dataclass(frozen=True)
class Candidates:
    """Edge grasps of one cloud (paper section III)."""

    pair: Int64  # (E,) which of the given pairs of points; below 0: a top-down grasp
    approach_index: Int64  # (E,) p_a, rows of the cloud
    contact_index: Int64  # (E,) p_c, rows of the cloud
    depth: Float32  # (E,) d, metres the contact lies ahead of the approach point
    opening: Float32  # (E,) metres between the fingers when they touch the object
    T_cloud_hand: Float32  # (E, 4, 4)

    def __len__(self) -> int:
        return len(self.pair)

    @property
    def approach(self) -> Float32:
        """(E, 3) unit, outward: from the object back to the hand."""
        return -self.T_cloud_hand[:, :3, 2]

    @property
    def top_down(self) -> Bools:
        """Which (E,) are top-down grasps."""
        return self.pair < 0

    @staticmethod
    def none() -> "Candidates":
        """No candidate."""
        rows, numbers = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.float32)
        return Candidates(rows, rows, rows, numbers, numbers, np.empty((0, 4, 4), np.float32))

    @staticmethod
    def concatenate(parts: Sequence["Candidates"]) -> "Candidates":
        """All candidates of several sets, in order."""
        arrays = zip(*(vars(part).values() for part in parts), strict=True)
        return Candidates(*map(np.concatenate, arrays))

    def take(self, rows: NDArray[np.integer] | Bools) -> "Candidates":
        """The candidates of the given rows, in their order."""
        return Candidates(*(array[rows] for array in vars(self).values()))


def edge_grasps(
    cloud: Cloud, approach_index: Int64, contact_index: Int64, gripper: Gripper
) -> Candidates:
    """The pairs of approach and contact points that define an edge grasp which fits the gripper.

    r = p_c - p_a; its part r_perp orthogonal to n_c points from the hand to the object (paper
    section III-A): z = r_perp / d, y = n_c, x = y x z. The contact lies at the gripper's contact_z
    and the approach point on the hand's axis. The pairs are rows (M,) of the cloud.
    """
    edge = measure_edges(cloud, approach_index, contact_index)
    pair = np.flatnonzero(~np.any(list(faults_of(edge, gripper).values()), axis=0))
    approach_index, contact_index = approach_index[pair], contact_index[pair]
    normal, depth = edge.normal[pair], edge.depth[pair]
    opening = 2 * np.abs(edge.along[pair])
    contact_z = gripper.contact_z_at(opening)
    z = edge.ahead[pair] / depth[:, None]
    y = normal - np.einsum("ed,ed->e", normal, z)[:, None] * z
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    pose = np.zeros((len(z), 4, 4), dtype=np.float32)
    pose[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=2)
    pose[:, :3, 3] = cloud.points[approach_index] + (depth - contact_z)[:, None] * z
    pose[:, 3, 3] = 1.0
    return Candidates(pair, approach_index, contact_index, depth, opening, pose)


class EdgeMeasures(NamedTuple):
    """Edges r = p_c - p_a, decomposed along the normal at the contact."""

    normal: Float32  # (M, 3) unit n_c
    along: Float32  # (M,) r . n_c, metres
    ahead: Float32  # (M, 3) r_perp, the part of r orthogonal to n_c
    length: Float32  # (M,) |r|, metres
    depth: Float32  # (M,) |r_perp|, metres


def measure_edges(cloud: Cloud, approach_index: Int64, contact_index: Int64) -> EdgeMeasures:
    """Measure the edges of pairs (M,), (M,) of points, rows of the cloud."""
    normal = unit(cloud.normals[contact_index])
    edge = cloud.points[contact_index] - cloud.points[approach_index]  # (M, 3) r
    along = np.einsum("md,md->m", edge, normal)
    ahead = edge - along[:, None] * normal
    length, depth = np.linalg.norm(edge, axis=1), np.linalg.norm(ahead, axis=1)
    return EdgeMeasures(normal, along, ahead, length, depth)


def faults_of(edge: EdgeMeasures, gripper: Gripper) -> dict[NoGrasp, Bools]:
    """Which edges (M,) define no edge grasp that fits the gripper, by reason."""
    return {
        NoGrasp.TOO_SHORT: edge.length <= MIN_EDGE,
        NoGrasp.TOO_LONG: edge.length >= gripper.max_opening / 2 - EDGE_MARGIN,
        NoGrasp.NO_DIRECTION: edge.depth <= MIN_DEPTH,
        NoGrasp.TOO_DEEP: edge.depth >= gripper.finger_depth,
    }


def retract(
    candidates: Candidates, support: SupportPlane, gripper: Gripper, margin: float = 0.0
) -> tuple[Candidates, Bools]:
    """Move hands that cut into the support plane back along their approach, if that frees them.

    The contact may move from contact_z to at most TIP_MARGIN inside the fingertips, so flat objects
    on a table are held by the tips. Returns the candidates, and a mask (E,) of those whose hand is
    `margin` metres above the plane now; the other hands are unchanged.
    """
    pose, opening = candidates.T_cloud_hand, candidates.opening
    clearance = support_clearance(pose, opening, support, gripper) - margin
    rise = candidates.approach @ np.asarray(support.normal, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        back = np.where(clearance >= 0, 0.0, -clearance / rise)
    clear = (back >= 0) & (back <= gripper.tip_z - gripper.contact_z - TIP_MARGIN)
    pose = pose.copy()
    pose[clear, :3, 3] += back[clear, None] * candidates.approach[clear]
    return replace(candidates, T_cloud_hand=pose), clear


def support_clearance(
    T_cloud_hand: Float32,  # (E, 4, 4)
    opening: Float32,  # (E,) metres between the fingers when they touch the object
    support: SupportPlane,
    gripper: Gripper,
) -> Float32:
    """Height (E,), metres, of each hand's lowest corner over the support as it closes.

    Fingers that swing forward are assumed to close CLOSED_FURTHER metres beyond that opening.
    """
    boxes = gripper.open_boxes
    middle, half = boxes.mean(axis=1), (boxes[:, 1] - boxes[:, 0]) / 2  # (B, 3) each
    x, y, z = support.normal
    rows = T_cloud_hand.astype(np.float64)
    along = x * rows[:, 0] + y * rows[:, 1] + z * rows[:, 2]  # (E, 4): of the axes, the origin
    normal_in_hand, origin_height = along[:, :3], along[:, 3] - support.offset
    corners = normal_in_hand @ middle.T - np.abs(normal_in_hand) @ half.T  # (E, B)
    ahead = gripper.furthest_advance(opening - CLOSED_FURTHER)
    corners[:, len(gripper.hand_boxes) :] += (normal_in_hand[:, 2] * ahead)[:, None]
    clearance: Float32 = origin_height + np.min(list(corners.T), axis=0)
    return clearance.astype(np.float32)


MIN_SHIFT, MAX_SHIFT = 0.001, 0.008  # metres; for larger shifts another approach point is better


def centred_grasps(
    points: Float32,  # (N, 3) the cloud
    crop: BallCrop,
    candidates: Candidates,  # E; `pair` is their contact's row in `crop`
    gripper: Gripper,
) -> Candidates:
    """Extra candidates for wide objects: hands shifted along their closing direction.

    The hand of an edge grasp is centred on its approach point, and few sampled points lie in the
    middle of an object almost as wide as the hand opens. Its extent is taken from the points of the
    ball between the fingers; whether the hand fits is left to the collision check.
    """
    axes, origin = candidates.T_cloud_hand[:, :3, :3], candidates.T_cloud_hand[:, :3, 3]
    outward = np.einsum("ed,ed->e", points[candidates.contact_index] - origin, axes[:, :, 1])
    least = WIDE * gripper.max_opening / 2 - MAX_SHIFT  # from the hand's axis to a contact
    wide = np.flatnonzero(np.abs(outward) > least)
    first, last = crop.bounds(crop.ball_of_point[candidates.pair[wide]])
    half = gripper.pad_half_width + BESIDE_PADS
    pads = np.array([[-half, gripper.palm_z], [half, gripper.max_tip_z]], dtype=np.float32)
    hands = in_hands(points[crop.ball_rows], candidates.T_cloud_hand[wide])
    low, high = extents_between(hands, first, last, pads).T
    middle, width = (low + high) / 2, high - low
    moved = (width > WIDE * gripper.max_opening) & (width < gripper.max_opening)
    moved &= (np.abs(middle) > MIN_SHIFT) & (np.abs(middle) < MAX_SHIFT)
    further = replace(candidates.take(wide[moved]), opening=width[moved])
    further.T_cloud_hand[:, :3, 3] += middle[moved, None] * further.T_cloud_hand[:, :3, 1]
    return further
