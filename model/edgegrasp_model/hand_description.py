"""Describe each candidate by what the cloud looks like from its own hand.

Invariant under rotations, translations and reflections of the whole scene by construction: how
many points the hand would hit, what lies between its fingers, from where it was seen, how the hand
stands to gravity and support, and how much of the space around it the camera did not see.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from edgegrasp_model.options import Boxes, Corner, SupportPlane
from edgegrasp_model.scene.cloud import Cloud

Float32 = NDArray[np.float32]

AXIS = 0.001  # metres from the approach axis, on which the approach point itself lies
SLAB = 0.004  # metres; thickness of the first layer each finger would meet
FACING = 0.7  # cosine from which a normal faces a finger
UNKNOWN_HEIGHT = 0.10  # metres; heights are cut off here, and unknown ones are this
HAND_DESCRIPTION_SIZE = 61
HEIGHTS = 3  # the last of them: heights over the support plane
CELL = 0.0022  # metres across a cell of the depth map, at the middle of the cloud
SPLAT = 2  # cells around its own that a point covers: as far as the next point of the cloud
BEHIND = 0.004  # metres behind a surface that may still be the surface
DEEP = 0.02  # metres further behind at which space counts as wholly unknown
NOTHING = np.float32(np.inf)
STEEP = 1e-3  # sine of the angle to up below which up says nothing about the map
HALF = 256  # most cells from the middle of the map to its edge: some 0.5 m
FARTHEST = 10 * HALF  # stands for everything farther away


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
    columns = [
        *_hits(seen, gripper),
        *_between_fingers(seen, cloud.normals, candidates.T_cloud_hand, side, gripper),
        _cut_off(seen, at_side, gripper),
        *_directions(candidates.T_cloud_hand, viewpoint, up, side),
        *occlusion_fractions(cloud.points, candidates.T_cloud_hand, viewpoint, up, gripper),
        *_stance(cloud, candidates, gripper, up, support),
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def without_support(description: NDArray[np.floating]) -> NDArray[np.floating]:
    """The description (E, F) that the same hands have where the support plane is not known."""
    unknown = description.copy()
    unknown[:, -HEIGHTS:] = UNKNOWN_HEIGHT
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


def _between_fingers(
    seen: _Points, normals: Float32, T_cloud_hand: Float32, side: Float32, gripper: Gripper
) -> list[Float32]:
    """Extent, middle and normals of what the closing fingers would meet."""
    half, inner = gripper.pad_half_width, gripper.max_opening / 2
    length = gripper.max_tip_z - gripper.palm_z
    above = seen.z - gripper.palm_z
    around = (np.abs(seen.y) < inner) & (above > 0) & (above < length)
    points = seen.where(around & (np.abs(seen.x) < 3 * half))
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
        return columns + [np.full(len(pose), UNKNOWN_HEIGHT, dtype=np.float32)] * HEIGHTS
    normal = np.asarray(support.normal)
    tips = pose[:, :3, 3] + gripper.tip_z * pose[:, :3, 2]
    heights = [
        tips @ normal - support.offset,
        contact @ normal - support.offset,
        support_clearance(pose, support, gripper),
    ]
    return columns + [np.clip(h, -UNKNOWN_HEIGHT, UNKNOWN_HEIGHT) for h in heights]


def occlusion_fractions(
    points: Float32,
    T_cloud_hand: Float32,
    viewpoint: Float32 | None,
    up: Float32,
    gripper: Gripper,
) -> list[Float32]:
    """The fraction of each part of a hand, and of the space around it, that the camera did not see.

    Args:
        points: (N, 3) of the cloud.
        T_cloud_hand: (E, 4, 4).
        viewpoint: (3,) the only camera; None where it is unknown: then all counts as seen.
        up: (3,) away from gravity.
        gripper: Fingers open to its maximum.

    Returns:
        For each of the parts of `probes` the mean (E,) of what `DepthMap.hidden` says of it.
    """
    parts = probes(gripper)
    if viewpoint is None or len(points) == 0:
        return [np.zeros(len(T_cloud_hand), dtype=np.float32)] * len(parts)
    depth = DepthMap.of_cloud(points, viewpoint, up)
    turn, shift = T_cloud_hand[:, :3, :3], T_cloud_hand[:, None, :3, 3]
    hidden = depth.hidden(np.concatenate(parts) @ turn.transpose(0, 2, 1) + shift)  # (E, S)
    ends = np.cumsum([len(part) for part in parts])[:-1]
    return [part.mean(axis=1) for part in np.split(hidden, ends, axis=1)]


def probes(gripper: Gripper) -> list[Float32]:
    """Points of each part of the open hand, and of the space around it; hand frame, metres.

    Tips and roots of both fingers, what is beyond each of them, the space between the fingers in
    three layers, and the hand itself: each (S, 3).
    """
    half, inner = gripper.pad_half_width, gripper.max_opening / 2
    tip, palm = gripper.tip_z, gripper.palm_z
    thick = max(high[1] for _, high in gripper.finger_boxes) / 2
    middle, x = (tip + palm) / 2, [-0.7 * half, 0.7 * half]
    fingers = [
        _grid(x, side * (inner + np.array([0.3, 1.4]) * thick), np.linspace(low, high, 4)[1:])
        for low, high in ((middle, tip), (palm, middle))
        for side in (1.0, -1.0)
    ]
    beyond = [
        _grid([0.0], [side * (inner + thick)], [tip + 0.006, tip + 0.012]) for side in (1.0, -1.0)
    ]
    between = [
        _grid(x, inner * np.array(layer), np.linspace(palm, tip, 5)[1:])
        for layer in ([0.5, 0.85], [-0.25, 0.25], [-0.85, -0.5])
    ]
    inside = [
        _grid(*(np.linspace(*ends)[1:-1] for ends in _spans(box))) for box in gripper.hand_boxes
    ]
    return [*fingers, *beyond, *between, np.concatenate(inside)]


def _spans(box: tuple[Corner, Corner]) -> list[tuple[float, float, int]]:
    """Along each axis the ends of a box, and how many points to take from one to the other."""
    return list(zip(*box, (4, 7, 4), strict=True))


def _grid(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Float32:
    """All points with these coordinates.  # (X * Y * Z, 3)."""
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid.astype(np.float32)


class CameraFrame(NamedTuple):
    """How a camera looks at a cloud: what directions the cells of its depth map stand for."""

    viewpoint: Float32  # (3,)
    axes: Float32  # (3, 3) rows: across, down, toward the middle of the cloud
    cell: float  # tangent of the angle of a cell

    @classmethod
    def toward(cls, middle: ArrayLike, viewpoint: ArrayLike, up: ArrayLike) -> Self:
        """A camera that looks at the middle (3,) of a cloud; `up` (3,) turns with the scene."""
        way = np.asarray(middle, dtype=np.float64) - np.asarray(viewpoint, dtype=np.float64)
        distance = max(float(np.linalg.norm(way)), 1e-6)
        ahead = way / distance
        across = np.cross(ahead, np.asarray(up, dtype=np.float64))
        if np.linalg.norm(across) < STEEP * np.linalg.norm(up):  # seen from straight above
            across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(ahead, across), ahead]).astype(np.float32)
        return cls(np.asarray(viewpoint, dtype=np.float32), axes, CELL / distance)

    def seen(self, positions: Float32) -> tuple[NDArray[np.int64], Float32]:
        """The cells (N, 2) that positions (N, 3) lie in, the middle one 0, and how far they are."""
        along = (positions - self.viewpoint) @ self.axes.T  # (N, 3)
        tangents = along[:, :2] / np.maximum(along[:, 2:], np.float32(1e-6))
        cell = np.clip(np.floor(tangents / np.float32(self.cell)), -FARTHEST, FARTHEST)
        return cell.astype(np.int64), np.linalg.norm(along, axis=1).astype(np.float32)


@dataclass(frozen=True)
class DepthMap:
    """Distance of the first surface in each direction from a camera."""

    frame: CameraFrame
    distance: Float32  # (2 H + 1, 2 H + 1) metres from the camera; inf where nothing was seen

    @classmethod
    def of_cloud(cls, points: Float32, viewpoint: Float32, up: Float32) -> Self:
        """What a camera there saw of a cloud.

        Args:
            points: (N, 3), at least one, metres.
            viewpoint: (3,) in the same frame.
            up: (3,) turns the map, so that it turns with the scene.
        """
        frame = CameraFrame.toward(points.mean(axis=0, dtype=np.float64), viewpoint, up)
        cell, distance = frame.seen(points)
        half = min(int(np.abs(cell).max()) + SPLAT, HALF)
        depth = np.full((2 * half + 1, 2 * half + 1), NOTHING)
        order = np.argsort(-distance, kind="stable")  # the nearest is written last
        cell, distance = cell[order] + half, distance[order]
        for shift in np.ndindex(2 * SPLAT + 1, 2 * SPLAT + 1):
            place = cell + np.asarray(shift) - SPLAT
            inside = ((place >= 0) & (place <= 2 * half)).all(axis=1)
            nearest = np.full_like(depth, NOTHING)
            nearest[tuple(place[inside].T)] = distance[inside]
            np.minimum(depth, nearest, out=depth)
        return cls(frame, depth)

    def hidden(self, positions: Float32) -> Float32:
        """How far positions (..., 3) lie in space that the camera did not see: 0 seen, 1 deep."""
        half = len(self.distance) // 2
        cell, distance = self.frame.seen(positions.reshape(-1, 3))
        inside: NDArray[np.bool_] = np.abs(cell).max(axis=1) <= half
        i, j = np.where(inside, cell.T + half, 0)
        surface = np.where(inside, self.distance[i, j], NOTHING)
        deep: Float32 = np.clip((distance - surface - BEHIND) / DEEP, 0.0, 1.0)
        return deep.astype(np.float32).reshape(positions.shape[:-1])
