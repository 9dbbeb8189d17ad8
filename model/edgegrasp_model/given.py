"""Edges and hand poses given by the caller, as candidates to score."""

from dataclasses import dataclass, replace

import numpy as np

from edgegrasp_camera.arrays import Array, Float32, Floats, Int64
from edgegrasp_model.candidates.collision import hand_views
from edgegrasp_model.candidates.edge_grasps import MIN_EDGE_LENGTH, Candidates, edge_grasps, retract
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import HALF_TURN, Gripper
from edgegrasp_model.options import MAX_CANDIDATES, are_rigid
from edgegrasp_model.results import NoGraspReason
from edgegrasp_model.scene.cloud import wrong_array
from edgegrasp_model.scene.scene import Scene

TOUCH_DEPTH = 0.004  # metres behind the outermost point; points in between are touched first too


@dataclass(frozen=True)
class Given:
    """M edges or hand poses, of which E define an edge grasp."""

    candidates: Candidates  # E candidates; `pair`, ascending, is the row of each among the M
    reason: list[NoGraspReason | None]  # M: why each defines no edge grasp; None: it defines one
    T_cloud_hand: Float32 | None = None  # (E, 4, 4) as given, canonical frame


def check_edges(edges: object, rows: int) -> Int64:
    """Check (M, 2) rows of the cloud as sent; raises InvalidRequest for type, shape and range."""
    fix = "Send integers of shape (M, 2): rows of the cloud, approach and contact point each."
    checked = _checked("edges", edges, "iu", (2,), fix)
    low, high = int(checked.min(initial=0)), int(checked.max(initial=0))
    if low < 0 or high >= rows:
        value = f"row {low if low < 0 else high} of a cloud of {rows} rows"
        raise InvalidRequest("edges", value, f"Send rows from 0 to {rows - 1}.")
    return checked.astype(np.int64)


def check_hand_poses(poses: object) -> Float32:
    """Check (M, 4, 4) poses T_cloud_hand; raises InvalidRequest unless they are rigid."""
    fix = "Send numbers of shape (M, 4, 4): T_cloud_hand."
    checked = _checked("hand_poses", poses, "fiu", (4, 4), fix)
    rigid = are_rigid(checked)
    if not rigid.all():
        fix = "Send 4 x 4 matrices of a rotation and a translation in metres, last row 0 0 0 1."
        value = f"pose {int(np.argmin(rigid))}, which is not a rigid transform"
        raise InvalidRequest("hand_poses", value, fix)
    return checked.astype(np.float32)


def _checked(field: str, array: object, kinds: str, shape: tuple[int, ...], fix: str) -> Array:
    """Check for 1 to MAX_CANDIDATES rows of the given shape, with a dtype of the given kinds."""
    if (
        not isinstance(array, np.ndarray)
        or array.dtype.kind not in kinds
        or array.shape[1:] != shape
    ):
        raise wrong_array(field, array, fix)
    if not 1 <= len(array) <= MAX_CANDIDATES:
        raise InvalidRequest(field, f"{len(array)} of them", f"Send 1 to {MAX_CANDIDATES}.")
    return array


def from_edges(
    scene: Scene,
    edges: Int64,  # (M, 2) rows of the cloud as sent: approach and contact point
    gripper: Gripper,
    crop_radius: float,  # metres from the approach point to the contact, at most
    margin: float,  # metres above the support plane to which hands are retracted
) -> Given:
    """Candidates for given edges, between the voxels that contain their rows."""
    point = scene.point_of_row[edges]
    reason: list[NoGraspReason | None] = [NoGraspReason.NO_POINT] * len(edges)
    there = np.flatnonzero((point >= 0).all(axis=1))
    approach, contact = point[there].T
    candidates, faults = edge_grasps(scene.cloud, approach, contact, gripper, crop_radius)
    for place, row in enumerate(there.tolist()):
        reason[row] = next((fault for fault, found in faults.items() if found[place]), None)
    if scene.support is not None:
        candidates, _ = retract(candidates, scene.support, gripper, margin)
    return Given(replace(candidates, pair=there[candidates.pair]), reason)


def from_hand_poses(
    scene: Scene, T_cloud_hand: Float32, gripper: Gripper, crop_radius: float
) -> Given:
    """The edge grasps nearest to hand poses (M, 4, 4), canonical frame; the poses stay as given.

    The contact point is the first that a closing finger touches, on the side whose normal is closer
    to the closing direction. It is chosen from the points within TOUCH_DEPTH of the outermost one
    between the fingers, as the one nearest to where the gripper puts contact points. The approach
    point is the point within `crop_radius` metres of it that is nearest to the approach axis.
    """
    view = hand_views(scene.cloud, T_cloud_hand, gripper)
    between = np.flatnonzero(gripper.between_fingers(view.position))
    hand, (x, y, z) = view.candidate[between], view.position[:, between]
    background = scene.object_of_point < 0
    off_contact = x**2 + (z - gripper.contact_z_at(2 * np.abs(y))) ** 2
    off_contact += background[view.row[between]]  # points of objects first
    facing = np.full((2, len(T_cloud_hand)), -np.inf)  # (+y, -y): cosine of normal and y axis
    touched = np.zeros((2, len(T_cloud_hand)), dtype=np.int64)  # rows of `view`
    half = np.zeros(len(T_cloud_hand), dtype=np.float32)  # metres from axis to outermost point
    for side, outward in enumerate((y, -y)):
        outermost = np.full(len(T_cloud_hand), -np.inf, dtype=np.float32)
        np.maximum.at(outermost, hand, outward)
        half = np.maximum(half, outermost)
        first = np.flatnonzero(outward > outermost[hand] - TOUCH_DEPTH)
        hands, best = _least(hand[first], off_contact[first])
        touched[side, hands] = between[first[best]]
        rows = view.row[touched[side, hands]]
        closing = T_cloud_hand[hands, :3, 1] * (1 - 2 * side)
        facing[side, hands] = np.einsum("ed,ed->e", scene.cloud.normals[rows], closing)
        facing[side, hands] -= 2.0 * background[rows]
    side = facing.argmax(axis=0)
    contact = touched[side, np.arange(len(T_cloud_hand))]  # rows of `view`
    approach = np.full(len(contact), -1, dtype=np.int64)  # rows of the cloud; -1: none
    apart = np.linalg.norm(view.position - view.position[:, contact[view.candidate]], axis=0)
    near = np.flatnonzero((apart > MIN_EDGE_LENGTH) & (apart < 0.99 * crop_radius))
    hands, best = _least(view.candidate[near], (view.position[:2, near] ** 2).sum(axis=0))
    approach[hands] = view.row[near[best]]
    found = np.flatnonzero(np.isfinite(facing.max(axis=0)) & (approach >= 0))
    reason: list[NoGraspReason | None] = [NoGraspReason.NOTHING_BETWEEN] * len(T_cloud_hand)
    for row in found.tolist():
        reason[row] = None
    given = T_cloud_hand[found]
    pose = np.where((side[found] == 0)[:, None, None], given, given * HALF_TURN)
    a, c = approach[found], view.row[contact[found]]
    edge = scene.cloud.points[c] - scene.cloud.points[a]
    depth = np.maximum(np.einsum("ed,ed->e", edge, pose[:, :3, 2]), 0.0)
    return Given(Candidates(found, a, c, depth, 2 * half[found], pose), reason, given)


def _least(group: Int64, key: Floats) -> tuple[Int64, Int64]:
    """The groups that occur, in ascending order, and the index of the least key in each."""
    order = np.lexsort((key, group))
    groups, first = np.unique(group[order], return_index=True)
    return groups, order[first]
