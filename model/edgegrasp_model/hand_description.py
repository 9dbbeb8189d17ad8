"""Describe each candidate by what the cloud looks like from its own hand.

Invariant under rotations, translations and reflections of the whole scene by construction, and
quick to learn from: how many points the hand would hit, what lies between its fingers, from where
it was seen, how it stands to gravity and support.
"""

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.candidates import Candidates, support_clearance
from edgegrasp_model.cloud import Cloud
from edgegrasp_model.gripper import Boxes, Gripper
from edgegrasp_model.hand_view import APPROACH_LENGTH, NEAR, HandView, hand_views, reach_of
from edgegrasp_model.hidden_space import hidden_shares
from edgegrasp_model.support import SupportPlane

Float32 = NDArray[np.float32]

AXIS = 0.001  # metres from the approach axis, on which the approach point itself lies
SLAB = 0.004  # metres; thickness of the first layer each finger would meet
FACING = 0.7  # cosine from which a normal faces a finger
UNKNOWN_HEIGHT = 0.10  # metres; heights are cut off here, and unknown ones are this


class _Region:
    """Statistics, per candidate, of the seen points that lie in one region."""

    def __init__(self, view: HandView, mask: NDArray[np.bool_]) -> None:
        self._mask = mask
        candidate = view.candidate[mask]
        self.count = np.bincount(candidate, minlength=view.num_candidates)
        self._candidate = candidate
        self._starts = np.cumsum(self.count) - self.count
        self._present = self.count > 0

    def log_count(self) -> Float32:
        return np.log1p(self.count).astype(np.float32)

    def mean(self, values: Float32, default: float = 0.0) -> Float32:
        sums = np.bincount(self._candidate, values[self._mask], minlength=len(self.count))
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
    x, y, z = (np.ascontiguousarray(column) for column in view.position.T)
    turn = candidates.T_cloud_hand[view.candidate, :3, :3]
    normal = np.einsum("pd,pdk->kp", cloud.normals[view.row], turn)  # (3, P)
    side = mirror_sides(candidates.T_cloud_hand, viewpoint)
    x, normal[0] = x * side[view.candidate], normal[0] * side[view.candidate]
    columns = [
        *_hits(view, x, y, z, gripper),
        *_between_fingers(view, x, y, z, normal, gripper),
        _cut_off(view, x, y, z, at_side, gripper),
        *_directions(candidates.T_cloud_hand, viewpoint, up, side),
        *hidden_shares(cloud.points, candidates.T_cloud_hand, viewpoint, up, gripper),
        *_stance(cloud, candidates, gripper, up, support),
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def mirror_sides(T_cloud_hand: Float32, viewpoint: Float32 | None) -> Float32:
    """1 or -1 (E,): what a hand's x is multiplied by, so that the camera is on its positive side.

    1 for all where the viewpoint is not known.
    """
    if viewpoint is None:
        return np.ones(len(T_cloud_hand), dtype=np.float32)
    toward = viewpoint - T_cloud_hand[:, :3, 3]
    along_x = np.einsum("ed,ed->e", toward, T_cloud_hand[:, :3, 0])
    return np.where(along_x < 0.0, -1.0, 1.0).astype(np.float32)


def without_support(description: NDArray[np.floating]) -> NDArray[np.floating]:
    """The description (E, F) that the same hands have where the support plane is not known."""
    unknown = description.copy()
    unknown[:, -HEIGHTS:] = UNKNOWN_HEIGHT
    return unknown


def _cut_off(
    view: HandView,
    x: Float32,
    y: Float32,
    z: Float32,
    at_side: NDArray[np.bool_] | None,
    gripper: Gripper,
) -> Float32:
    """Points between the fingers where a side of the workspace cuts things off."""
    if at_side is None:
        return np.zeros(view.num_candidates, dtype=np.float32)
    inside = (
        (np.abs(x) < gripper.pad_half_width + NEAR)
        & (np.abs(y) < gripper.max_opening / 2)
        & (z > gripper.palm_z)
        & (z < gripper.tip_z + NEAR)
    )
    return _Region(view, inside & at_side[view.row]).log_count()


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


def _hits(view: HandView, x: Float32, y: Float32, z: Float32, gripper: Gripper) -> list[Float32]:
    """Points inside the open hand, near its fingers, on its way in and beyond its tips."""
    hand, fingers = gripper.hand_boxes, gripper.finger_boxes
    inner = gripper.max_opening / 2
    in_line = (np.abs(x) < gripper.pad_half_width) & (np.abs(y) < inner)
    right, left = (x, y - inner, z), (x, -y - inner, z)  # from each finger's inner face
    regions = [
        _in_any(fingers, *right),
        _in_any(fingers, *left),
        _in_any(hand, x, y, z),
        _in_any(fingers, *right, around=NEAR),
        _in_any(fingers, *left, around=NEAR),
        _in_any(hand, x, y, z, behind=np.inf)
        | _in_any(fingers, *right, behind=APPROACH_LENGTH)
        | _in_any(fingers, *left, behind=APPROACH_LENGTH),
        in_line & (z >= gripper.tip_z),
    ]
    return [_Region(view, region).log_count() for region in regions]


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


def _between_fingers(
    view: HandView, x: Float32, y: Float32, z: Float32, normal: Float32, gripper: Gripper
) -> list[Float32]:
    """Extent, middle and normals of what the closing fingers would meet."""
    half, inner = gripper.pad_half_width, gripper.max_opening / 2
    tip, palm = gripper.foremost_z, gripper.palm_z
    z = z - palm
    middle = (tip - palm) / 2
    around = (np.abs(y) < inner) & (z > 0) & (z < tip - palm)
    inside = around & (np.abs(x) < half)
    wide = _Region(view, around & (np.abs(x) < 3 * half))
    between = _Region(view, inside)
    y_high, y_low = between.highest(y), between.lowest(y)
    nx, ny, nz = normal
    columns = [
        between.log_count(),
        *(between.highest(x), between.lowest(x), between.mean(x)),
        *(y_high, y_low, between.mean(y)),
        *(between.highest(z), between.lowest(z, tip - palm), between.mean(z, middle)),
        *(wide.log_count(), wide.highest(x), wide.lowest(x), wide.mean(x)),
        *(between.mean(np.abs(nx)), between.mean(np.abs(ny)), between.mean(nz)),
        _Region(view, inside & (ny > FACING)).log_count(),
        _Region(view, inside & (ny < -FACING)).log_count(),
        _Region(view, inside & (y > AXIS)).mean(ny),
        _Region(view, inside & (y < -AXIS)).mean(ny),
    ]
    for first in (y > y_high[view.candidate] - SLAB, y < y_low[view.candidate] + SLAB):
        slab = _Region(view, inside & first)  # what a finger meets first
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
        return columns + [np.full(len(pose), UNKNOWN_HEIGHT, dtype=np.float32)] * HEIGHTS
    normal = np.asarray(support.normal)
    tips = pose[:, :3, 3] + gripper.tip_z * pose[:, :3, 2]
    heights = [
        tips @ normal - support.offset,
        contact @ normal - support.offset,
        support_clearance(pose, support, gripper),
    ]
    return columns + [np.clip(h, -UNKNOWN_HEIGHT, UNKNOWN_HEIGHT) for h in heights]


HAND_DESCRIPTION_SIZE = 61
HEIGHTS = 3  # the last of them: heights over the support plane
