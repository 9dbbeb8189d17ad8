"""Describe each candidate by what the cloud looks like from its own hand.

Invariant under rotations, translations and reflections of the whole scene by construction: how
many points the hand would hit, what lies between its fingers, from where it was seen, how the hand
stands to gravity and support, and how much of the space around it the camera did not see.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.candidates.edge_grasps import Candidates, support_clearance
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_view import (
    APPROACH_LENGTH,
    NEAR,
    HandView,
    hand_views,
    mirror_sides,
    reach_of,
)
from edgegrasp_model.kernels import runs_along
from edgegrasp_model.options import Boxes, SupportPlane
from edgegrasp_model.scene.cloud import Cloud
from edgegrasp_model.unseen import DepthMap, unseen_space

Float32 = NDArray[np.float32]

AXIS = 0.001  # metres from the approach axis, on which the approach point itself lies
SLAB = 0.004  # metres; thickness of the first layer each finger would meet
FACING = 0.7  # cosine from which a normal faces a finger
UNKNOWN_HEIGHT = 0.10  # metres; heights are cut off here, and unknown ones are this
GAP = 0.007  # metres without a point in which what is between the fingers ends
HAND_DESCRIPTION_SIZE = 71
HEIGHTS = slice(58, 61)  # of them: heights over the support plane


class _Points(NamedTuple):
    """Seen points, P of them, ordered by hand."""

    hand: NDArray[np.int64]  # (P,) ascending
    row: NDArray[np.int64]  # (P,) row of the cloud
    x: Float32  # (P,) metres, in the hand frame
    y: Float32
    z: Float32
    num_hands: int

    def where(self, mask: NDArray[np.bool_]) -> "_Points":
        """Those for which something holds."""
        kept = np.flatnonzero(mask)
        x, y, z = self.x[kept], self.y[kept], self.z[kept]
        return _Points(self.hand[kept], self.row[kept], x, y, z, self.num_hands)


class _Region:
    """Statistics, per hand, of the seen points that lie in one region."""

    def __init__(self, points: _Points, mask: NDArray[np.bool_]) -> None:
        self._mask = mask
        hand = points.hand[mask]
        self.count = np.bincount(hand, minlength=points.num_hands)
        self._hand = hand
        self._starts = np.cumsum(self.count) - self.count
        self._present = self.count > 0

    def log_count(self) -> Float32:
        return np.log1p(self.count).astype(np.float32)

    def mean(self, values: Float32, default: float = 0.0) -> Float32:
        sums = np.bincount(self._hand, values[self._mask], minlength=len(self.count))
        means = sums / np.maximum(self.count, 1)
        return np.where(self._present, means, default).astype(np.float32)

    def highest(self, values: Float32, default: float = 0.0) -> Float32:
        result = np.full(len(self.count), default, dtype=np.float32)
        if self._present.any():
            starts = self._starts[self._present]
            result[self._present] = np.maximum.reduceat(values[self._mask], starts)
        return result

    def lowest(self, values: Float32, default: float = 0.0) -> Float32:
        return -self.highest(-values, -default)


def describe_hands(
    cloud: Cloud,
    candidates: Candidates,
    gripper: Gripper,
    up: Float32,
    support: SupportPlane | None,
    viewpoint: Float32 | None = None,
    at_side: NDArray[np.bool_] | None = None,
    view: HandView | None = None,
) -> Float32:
    """The hand-frame description of each candidate.

    A hand and what it would grasp may be mirrored in the hand's x without changing the outcome:
    where the viewpoint is known, each is described with the camera on the side of positive x.

    Args:
        cloud: N points with normals.
        candidates: E candidates.
        gripper: Fingers open to its maximum.
        up: (3,) away from gravity.
        support: Plane that heights are measured from; None where it is unknown.
        viewpoint: (3,) the camera; None where it is unknown, or there are several.
        at_side: (N,) points where a side of the workspace cuts things off: what is between the
            fingers there may be wider than it seems. None: nowhere.
        view: `hand_views` of the same candidates, where the caller has it already.

    Returns:
        (E, HAND_DESCRIPTION_SIZE) counts (logarithm of 1 + n), metres and cosines.
    """
    reach = reach_of(gripper)
    view = (view or hand_views(cloud, candidates.T_cloud_hand, reach)).within(reach)
    side = mirror_sides(candidates.T_cloud_hand, viewpoint)
    x, y, z = view.columns
    seen = _Points(view.candidate, view.row, x * side[view.candidate], y, z, view.num_candidates)
    wide = _around_pads(seen, gripper)
    between = wide.where(np.abs(wide.x) < gripper.pad_half_width)
    first_met, runs = runs_along(between.hand, between.y, between.num_hands, GAP)
    depth = None
    if viewpoint is not None and len(cloud.points):
        depth = DepthMap.of_cloud(cloud.points, viewpoint, up)
    unseen = unseen_space(depth, candidates.T_cloud_hand, first_met, gripper)
    columns = [
        *_hits(seen, gripper),
        *_between_fingers(wide, cloud.normals, candidates.T_cloud_hand, side, gripper),
        _cut_off(seen, at_side, gripper),
        *_directions(candidates.T_cloud_hand, viewpoint, up, side),
        *unseen.parts,
        *_stance(cloud, candidates, gripper, up, support),
        # Older networks read no further: what is new goes here, at the end.
        *unseen.ways,
        *unseen.depths,
        *unseen.beyond,
        unseen.free,
        *runs.T,
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def without_support(description: NDArray[np.floating]) -> NDArray[np.floating]:
    """The description (E, F) that the same hands have where the support plane is not known."""
    unknown = description.copy()
    unknown[:, HEIGHTS] = UNKNOWN_HEIGHT
    return unknown


def _cut_off(seen: _Points, at_side: NDArray[np.bool_] | None, gripper: Gripper) -> Float32:
    """Points between the fingers where a side of the workspace cuts things off."""
    if at_side is None or not at_side.any():
        return np.zeros(seen.num_hands, dtype=np.float32)
    inside = (
        (np.abs(seen.x) < gripper.pad_half_width + NEAR)
        & (np.abs(seen.y) < gripper.max_opening / 2)
        & (seen.z > gripper.palm_z)
        & (seen.z < gripper.tip_z + NEAR)
    )
    return _Region(seen, inside & at_side[seen.row]).log_count()


def _directions(
    T_cloud_hand: Float32, viewpoint: Float32 | None, up: Float32, side: Float32
) -> list[Float32]:
    """Where the camera and up are, in hand frames; a camera that is not known is nowhere."""
    mirrored = T_cloud_hand[:, :3, :3].copy()
    mirrored[:, :, 0] *= side[:, None]
    toward = np.zeros((len(mirrored), 3), dtype=np.float32)
    if viewpoint is not None:
        toward = viewpoint - T_cloud_hand[:, :3, 3]
        toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    ups = np.broadcast_to(up / np.linalg.norm(up), toward.shape)
    return [*np.einsum("ed,edk->ke", toward, mirrored), *np.einsum("ed,edk->ke", ups, mirrored)]


def _hits(seen: _Points, gripper: Gripper) -> list[Float32]:
    """Points inside the open hand, near its fingers, on its way in and beyond its tips."""
    hand, fingers = gripper.hand_boxes, gripper.finger_boxes
    inner = gripper.max_opening / 2
    on_way = _in_any(hand, seen.x, seen.y, seen.z, behind=np.inf)
    # Few points lie in the fingers' plane: the rest need not be compared with their boxes.
    low, high = min(box[0][0] for box in fingers), max(box[1][0] for box in fingers)
    level = (seen.x > low - NEAR) & (seen.x < high + NEAR)
    near = seen.where(level)
    x, y, z = near.x, near.y, near.z
    right, left = (x, y - inner, z), (x, -y - inner, z)  # from each finger's inner face
    in_line = (np.abs(x) < gripper.pad_half_width) & (np.abs(y) < inner)
    on_way[level] |= _in_any(fingers, *right, behind=APPROACH_LENGTH)
    on_way[level] |= _in_any(fingers, *left, behind=APPROACH_LENGTH)
    regions = [
        _Region(near, _in_any(fingers, *right)),
        _Region(near, _in_any(fingers, *left)),
        _Region(seen, _in_any(hand, seen.x, seen.y, seen.z)),
        _Region(near, _in_any(fingers, *right, around=NEAR)),
        _Region(near, _in_any(fingers, *left, around=NEAR)),
        _Region(seen, on_way),
        _Region(near, in_line & (z >= gripper.tip_z)),
    ]
    return [region.log_count() for region in regions]


def _in_any(
    boxes: Boxes, x: Float32, y: Float32, z: Float32, around: float = 0.0, behind: float = 0.0
) -> NDArray[np.bool_]:
    """Which points lie in one of some boxes, grown around (not behind) and lengthened behind."""
    inside = np.zeros(len(x), dtype=bool)
    for low, high in boxes:
        inside |= (
            (x > low[0] - around)
            & (x < high[0] + around)
            & (y > low[1] - around)
            & (y < high[1] + around)
            & (z > low[2] - behind)
            & (z < high[2] + around)
        )
    return inside


def _around_pads(seen: _Points, gripper: Gripper) -> _Points:
    """Those between the planes of the fingers, up to three pads wide."""
    above = seen.z - gripper.palm_z
    around = (np.abs(seen.y) < gripper.max_opening / 2) & (above > 0)
    around &= above < gripper.max_tip_z - gripper.palm_z
    return seen.where(around & (np.abs(seen.x) < 3 * gripper.pad_half_width))


def _between_fingers(
    points: _Points, normals: Float32, T_cloud_hand: Float32, side: Float32, gripper: Gripper
) -> list[Float32]:
    """Extent, middle and normals of what the closing fingers would meet."""
    half, length = gripper.pad_half_width, gripper.max_tip_z - gripper.palm_z
    x, y, z, middle = points.x, points.y, points.z - gripper.palm_z, length / 2
    nx, ny, nz = np.einsum("pd,pdk->kp", normals[points.row], T_cloud_hand[points.hand, :3, :3])
    nx *= side[points.hand]
    inside = np.abs(x) < half
    wide = _Region(points, np.ones(len(x), dtype=bool))
    between = _Region(points, inside)
    y_high, y_low = between.highest(y), between.lowest(y)
    columns = [
        between.log_count(),
        *(between.highest(x), between.lowest(x), between.mean(x)),
        *(y_high, y_low, between.mean(y)),
        *(between.highest(z), between.lowest(z, length), between.mean(z, middle)),
        *(wide.log_count(), wide.highest(x), wide.lowest(x), wide.mean(x)),
        *(between.mean(np.abs(nx)), between.mean(np.abs(ny)), between.mean(nz)),
        _Region(points, inside & (ny > FACING)).log_count(),
        _Region(points, inside & (ny < -FACING)).log_count(),
        _Region(points, inside & (y > AXIS)).mean(ny),
        _Region(points, inside & (y < -AXIS)).mean(ny),
    ]
    for first in (y > y_high[points.hand] - SLAB, y < y_low[points.hand] + SLAB):
        slab = _Region(points, inside & first)  # what a finger meets first
        columns += [slab.log_count(), slab.mean(ny), slab.mean(z, middle), slab.mean(x)]
    return columns


def _stance(
    cloud: Cloud,
    candidates: Candidates,
    gripper: Gripper,
    up: Float32,
    support: SupportPlane | None,
) -> list[Float32]:
    """The edge itself, and how the hand stands to gravity and to the support plane."""
    up = up / np.linalg.norm(up)
    pose = candidates.T_cloud_hand
    contact = cloud.points[candidates.contact_index]  # (E, 3)
    edge = contact - cloud.points[candidates.approach_index]
    columns = [
        candidates.depth,
        np.linalg.norm(edge, axis=1),
        np.einsum("ed,ed->e", edge, pose[:, :3, 1]),
        candidates.approach @ up,
        np.abs(pose[:, :3, 1] @ up),
    ]
    if support is None:
        return columns + [np.full(len(pose), UNKNOWN_HEIGHT, dtype=np.float32)] * 3
    normal = np.asarray(support.normal)
    tips = pose[:, :3, 3] + gripper.tip_z * pose[:, :3, 2]
    heights = [
        tips @ normal - support.offset,
        contact @ normal - support.offset,
        support_clearance(pose, support, gripper),
    ]
    return columns + [np.clip(h, -UNKNOWN_HEIGHT, UNKNOWN_HEIGHT) for h in heights]
