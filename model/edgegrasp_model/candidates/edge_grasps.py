"""Approach points and the hands around them: edge grasps, centred grasps and outline grasps.

At a depth edge no camera sees the side of the object, so the normal that an edge grasp needs is
missing. Grasps across an outline need only its direction and the points between, beside and below
the fingers: the hand approaches from above or from the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Bools, Float32, Int64
from edgegrasp_model.gripper import APPROACH_LENGTH, Gripper
from edgegrasp_model.kernels import compiled, extents_between, free_reach, in_hands
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.results import NoGraspReason
from edgegrasp_model.scene.cloud import UP, Cloud, pose_matrix, unit

MIN_EDGE_LENGTH = 0.003  # metres between approach and contact point
# Metres to spare: an edge is this much shorter than half the opening, a contact this far behind the
# fingertips, and a hand this far from what is ahead of it.
FIT_MARGIN = 0.002
CLOSING_ALLOWANCE = 0.01  # metres by which an object may be narrower than it looks
WIDE_SHARE = 0.75  # of the opening, from which an object counts as wide
PAD_ALLOWANCE = 0.004  # metres beside the finger pads in which points count


def coarse_to_fine_sample(
    points: Float32,  # (N, 3)
    count: int,
    before: Sequence[int] | Int64 = (),  # (B,) rows chosen earlier, which are excluded
) -> Int64:
    """Choose `count` different rows far from each other, or all of them if there are fewer.

    They are the points nearest to the nodes of grids around the middle of the points, from 4 cm to
    3 mm, each finer than the one before: noise and additional points hardly change the choice.
    """
    chosen, total = np.asarray(before, dtype=np.int64), min(len(before) + count, len(points))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    offset = (points - middle).astype(np.float64)
    side = 2**14  # nodes
    for cell in (0.04 * 0.7**level for level in range(8)):
        if len(chosen) == total:
            break
        place = offset / cell
        node = np.rint(place)
        number = (node + side // 2) @ (side**2, side, 1.0)
        order = np.argsort(number + np.square(place - node).sum(axis=1))
        nearest = order[np.diff(number[order], prepend=-1.0) > 0]
        free = nearest[~np.isin(number[nearest], number[chosen])]
        # In the order of Knuth's multiplicative hash.
        mixed = number[free].astype(np.uint64) * np.uint64(2654435761) % np.uint64(2**32)
        chosen = np.append(chosen, free[np.argsort(mixed)][: total - len(chosen)])
    rest = np.delete(np.arange(len(points)), chosen)[: total - len(chosen)]
    return np.append(chosen[len(before) :], rest)


class BallCrop(NamedTuple):
    """Balls of points, as rows of their cloud: P rows in total, ball after ball."""

    ball_rows: Int64  # (P,) rows of the cloud, ascending within each ball
    ball_of_point: Int64  # (P,) ascending, 0..A-1
    start: Int64  # (A + 1,) index in `ball_rows` where each ball begins, and the last one ends


def crop_balls(
    points: Float32,  # (N, 3) metres
    approach_index: NDArray[np.integer],  # (A,) rows of `points`; one ball each
    radius: float,  # metres
) -> BallCrop:
    """Crop a ball (paper: of radius G_w / 2) around each approach point; balls may overlap."""
    approach_index = np.asarray(approach_index, dtype=np.int64)
    members = cKDTree(points).query_ball_point(points[approach_index], radius, return_sorted=True)
    start = np.cumsum([0, *map(len, members)])
    ball_rows = np.concatenate([np.empty(0), *members]).astype(np.int64)
    return BallCrop(ball_rows, np.repeat(np.arange(len(members)), np.diff(start)), start)


@dataclass(frozen=True)
class Candidates:
    """Edge grasps of one cloud (paper section III)."""

    pair: Int64  # (E,) index of the given pair of points
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
    cloud: Cloud,
    approach_index: Int64,  # (M,) rows of the cloud
    contact_index: Int64,  # (M,) rows of the cloud
    gripper: Gripper,
    reach: float = np.inf,  # metres from the approach point to the contact, at most
) -> tuple[Candidates, dict[NoGraspReason, Bools]]:
    """The pairs that define an edge grasp which fits the gripper, and faults (M,) of the others.

    r = p_c - p_a; its part r_perp orthogonal to n_c points from the hand to the object (paper
    section III-A): z = r_perp / d, y = n_c, x = y x z. The contact lies at the gripper's contact_z
    and the approach point on the hand's axis.
    """
    normal = unit(cloud.normals[contact_index])
    edge = cloud.points[contact_index] - cloud.points[approach_index]  # (M, 3) r
    along = np.einsum("md,md->m", edge, normal)
    ahead = edge - along[:, None] * normal  # (M, 3) r_perp
    length, depth = np.linalg.norm(edge, axis=1), np.linalg.norm(ahead, axis=1)
    faults = {
        NoGraspReason.TOO_SHORT: length <= MIN_EDGE_LENGTH,
        NoGraspReason.TOO_LONG: length >= min(gripper.max_opening / 2 - FIT_MARGIN, reach),
        NoGraspReason.NO_DIRECTION: depth <= 1e-4,  # the approach direction would be noise
        NoGraspReason.TOO_DEEP: depth >= gripper.contact_z - gripper.palm_z,
    }
    pair = np.flatnonzero(~np.any(list(faults.values()), axis=0))
    approach_index, contact_index = approach_index[pair], contact_index[pair]
    normal, depth, opening = normal[pair], depth[pair], 2 * np.abs(along[pair])
    z = ahead[pair] / depth[:, None]
    y = normal - np.einsum("ed,ed->e", normal, z)[:, None] * z
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    place = cloud.points[approach_index] + (depth - gripper.contact_z_at(opening))[:, None] * z
    pose = pose_matrix(np.stack([np.cross(y, z), y, z], axis=2), place).astype(np.float32)
    return Candidates(pair, approach_index, contact_index, depth, opening, pose), faults


def retract(
    candidates: Candidates, support: SupportPlane, gripper: Gripper, margin: float = 0.0
) -> tuple[Candidates, Bools]:
    """Move hands that cut into the support plane back along their approach, if that frees them.

    The contact may move from contact_z as far as FIT_MARGIN behind the fingertips, so flat objects
    on a table are held by the tips. Returns the candidates, and a mask (E,) of those whose hand is
    now at least `margin` metres above the plane; the other hands are unchanged.
    """
    pose, opening = candidates.T_cloud_hand, candidates.opening
    clearance = support_clearance(pose, opening, support, gripper) - margin
    rise = candidates.approach @ np.asarray(support.normal, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        back = np.where(clearance >= 0, 0.0, -clearance / rise)
    room = max(gripper.tip_z - gripper.contact_z - FIT_MARGIN, 0.0)
    clear = (back >= 0) & (back <= room)
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

    Fingers that swing forward are assumed to close CLOSING_ALLOWANCE metres beyond that opening.
    """
    boxes = gripper.open_boxes
    middle, half = boxes.mean(axis=1), (boxes[:, 1] - boxes[:, 0]) / 2  # (B, 3) each
    x, y, z = support.normal
    rows = T_cloud_hand.astype(np.float64)
    along = x * rows[:, 0] + y * rows[:, 1] + z * rows[:, 2]  # (E, 4): of the axes, the origin
    normal_in_hand, origin_height = along[:, :3], along[:, 3] - support.offset
    corners = normal_in_hand @ middle.T - np.abs(normal_in_hand) @ half.T  # (E, B)
    ahead = gripper.furthest_advance(opening - CLOSING_ALLOWANCE)
    corners[:, len(gripper.hand.boxes) :] += (normal_in_hand[:, 2] * ahead)[:, None]
    clearance: Float32 = origin_height + np.min(list(corners.T), axis=0)
    return clearance.astype(np.float32)


MAX_SHIFT = 0.008  # metres; for larger shifts another approach point is better


def centred_grasps(
    points: Float32,  # (N, 3) the cloud
    crop: BallCrop,
    candidates: Candidates,  # E; `pair` is their contact's row in `crop`
    gripper: Gripper,
) -> Candidates:
    """Extra candidates for wide objects: hands shifted along their closing direction.

    The hand of an edge grasp is centred on its approach point, but few sampled points lie in the
    middle of an object that is almost as wide as the opening. The object's extent is measured on
    the ball's points between the fingers; the collision check decides whether the hand fits.
    """
    axes, origin = candidates.T_cloud_hand[:, :3, :3], candidates.T_cloud_hand[:, :3, 3]
    outward = np.einsum("ed,ed->e", points[candidates.contact_index] - origin, axes[:, :, 1])
    least = WIDE_SHARE * gripper.max_opening / 2 - MAX_SHIFT  # from the hand's axis to a contact
    wide = np.flatnonzero(np.abs(outward) > least)
    ball = crop.ball_of_point[candidates.pair[wide]]
    half = gripper.pad_half_width + PAD_ALLOWANCE
    pads = np.array([[-half, gripper.palm_z], [half, gripper.max_tip_z]], dtype=np.float32)
    hands = in_hands(points[crop.ball_rows], candidates.T_cloud_hand[wide])
    low, high = extents_between(hands, crop.start[ball], crop.start[ball + 1], pads).T
    middle, width = (low + high) / 2, high - low
    moved = (width > WIDE_SHARE * gripper.max_opening) & (width < gripper.max_opening)
    moved &= np.abs(middle) < MAX_SHIFT
    found = candidates.take(wide[moved])
    further = replace(found, opening=width[moved])
    further.T_cloud_hand[:, :3, 3] += middle[moved, None] * further.T_cloud_hand[:, :3, 1]
    # Fingers that swing are elsewhere along z at the new opening.
    now, before = gripper.contact_z_at(np.stack([further.opening, found.opening]))[..., None]
    further.T_cloud_hand[:, :3, 3] += (before - now) * further.T_cloud_hand[:, :3, 2]
    return further


# Grasps across an outline

OUTLINE_RADIUS = 0.016  # metres of surface from which the outline's direction is estimated
MIN_OUTLINE_OFFSET = 0.002  # metres from a neighbourhood's mean to a point on the outline
MAX_RIM_DEVIATION = 0.003  # metres, standard deviation across a thin rim, which is all outline
SURFACE_DROP = 0.006  # metres below an edge from which a surface counts as another one
SURFACE_GAP = 0.007  # metres without a point at which a surface counts as ended
MAX_INSERTION = 0.020  # metres deeper than an edge grasp; more does not hold better


class Outline(NamedTuple):
    """The depth edges of a cloud of N points, as seen from a viewpoint."""

    toward: Float32  # (N, 3) unit, from each point to the viewpoint
    heading: Float32  # (N, 3) unit, orthogonal to `toward`: across the edge, out of the object
    is_edge: Bools  # (N,)


def outlines(
    points: Float32,  # (N, 3) canonical frame, metres
    viewpoints: Float32,  # (W, 3)
    rows: Int64,  # (M,) of the points that may lie on an outline
    *,
    leaning: bool = False,  # also from four sides, 30 degrees off the vertical
) -> list[Outline]:
    """The outlines of a cloud as seen from above and, where that differs, from each camera."""
    toward, lean = [np.broadcast_to(UP, points.shape)], np.radians(30.0)
    toward += [unit(eye - points) for eye in viewpoints]
    if leaning:
        for turn in np.linspace(0.0, 2 * np.pi, 4, endpoint=False):
            level = np.sin(lean) * np.array([np.cos(turn), np.sin(turn)])
            way = np.array([*level, np.cos(lean)])
            toward.append(np.broadcast_to(way.astype(np.float32), points.shape))
    ways = np.stack([each[rows] for each in toward])
    cells = np.floor((points - points.min(axis=0)) / OUTLINE_RADIUS).astype(np.int64) + 1
    sizes = cells.max(axis=0) + 2
    key = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    order = np.argsort(key, kind="stable")
    reach = np.array([OUTLINE_RADIUS, SURFACE_DROP], np.float32)
    columns = np.ascontiguousarray(points[order].T)
    spreads = _level_spread(columns, key[order], points[rows], key[rows], sizes, ways, reach)
    found: list[Outline] = []
    for each, way, least, outward, deviation in zip(toward, ways, *spreads, strict=True):
        heading, is_edge = np.zeros_like(points), np.zeros(len(points), dtype=bool)
        # A point is on the outline if its neighbours at its height or above lie on one side.
        heading[rows] = least
        is_edge[rows] = (outward > MIN_OUTLINE_OFFSET) | (deviation < MAX_RIM_DEVIATION)
        if found:
            # Directions within half the lean of the vertical show the same outline.
            is_edge[rows] &= way @ UP < np.cos(lean / 2)
        found.append(Outline(each, heading, is_edge))
    return found


def outline_grasps(
    points: Float32,  # (N, 3) the cloud
    crop: BallCrop,  # balls around the approach points
    approach_index: Int64,  # (A,) rows of the approach points
    pair: Int64,  # (M,) rows of `crop`: the contact points that are allowed
    outline: Outline,  # of the same cloud
    support: SupportPlane | None,  # plane that the hand stays above
    gripper: Gripper,
    margin: float = 0.0,  # metres kept free around the hand
) -> Candidates:
    """Hands that come from the outline's viewpoint and close across it; at most one per contact.

    The contact point lies on the outline. The hand is centred between it and the opposite edge of
    the same surface; the approach point is the one nearest to the hand's axis. The hand moves in
    until something is right ahead of it, at most MAX_INSERTION deeper than an edge grasp.
    """
    y, z = outline.heading, -outline.toward
    frame = np.stack([points, np.cross(y, z), y, z], axis=1)  # (N, 4, 3)
    pair = pair[outline.is_edge[crop.ball_rows[pair]]]
    contact, approach = crop.ball_rows[pair], approach_index[crop.ball_of_point[pair]]
    apart = points[contact] - points[approach]
    edge = np.einsum("md,mkd->km", apart, frame[contact, 1:])
    between = (np.abs(edge[0]) < gripper.pad_half_width) & (edge[2] > -SURFACE_DROP)
    row = np.flatnonzero(between & (edge[1] > MIN_EDGE_LENGTH) & (edge[1] < gripper.max_opening))
    ball = crop.ball_of_point[pair[row]]
    first, last = crop.start[ball], crop.start[ball + 1]
    size = gripper.pad_half_width, gripper.max_opening
    strip = np.array([*size, SURFACE_DROP, SURFACE_GAP], dtype=np.float32)
    # How far the surface extends between the pads from each contact, outward and inward: (M, 2).
    extent = extents_across(points, crop.ball_rows, first, last, frame[contact[row]], strip)
    width = extent[:, 1] - extent[:, 0]
    held = (extent[:, 0] > -MIN_EDGE_LENGTH) & (width < gripper.max_opening - 2 * FIT_MARGIN)
    # The approach point lies on the same surface.
    held &= edge[1][row] < extent[:, 1] + MIN_EDGE_LENGTH
    off_axis = np.hypot(edge[0][row], edge[1][row] - extent.mean(axis=1))
    nearest = np.lexsort((off_axis, contact[row], ~held))[: held.sum()]
    chosen = nearest[np.unique(contact[row[nearest]], return_index=True)[1]]
    row, extent, width = row[chosen], extent[chosen], width[chosen]
    contact, z = contact[row], z[contact[row]]
    middle = points[contact] - extent.mean(axis=1, keepdims=True) * y[contact]
    place = middle - gripper.contact_z_at(width)[:, None] * z
    pose = pose_matrix(frame[contact, 1:].transpose(0, 2, 1), place).astype(np.float32)
    depth = np.maximum(edge[2][row], 0.0)
    hands = Candidates(pair[row], approach[row], contact, depth, width, pose)
    return _inserted(points, hands, support, gripper, margin)


def _inserted(
    points: Float32,
    candidates: Candidates,
    support: SupportPlane | None,
    gripper: Gripper,
    margin: float,
) -> Candidates:
    """Move hands in until something is right ahead of them; leave out those that stop too early."""
    least = gripper.contact_z + FIT_MARGIN - gripper.tip_z  # shortest way in, metres; below 0: out
    room = np.full(len(candidates), np.inf, dtype=np.float32)  # metres of way above the support
    if support is not None:
        fall = candidates.approach @ np.asarray(support.normal, dtype=np.float32)
        pose, opening = candidates.T_cloud_hand, candidates.opening
        height = support_clearance(pose, opening, support, gripper) - margin
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(fall > 0, height / fall, room)
    enough = np.flatnonzero(room >= least)
    candidates = candidates.take(enough)
    boxes = gripper.open_boxes + margin * np.array([[-1.0], [1.0]])
    seen = in_hands(points, candidates.T_cloud_hand)
    ends = least + FIT_MARGIN, MAX_INSERTION + FIT_MARGIN  # the exact way does not matter beyond
    way = free_reach(seen, boxes, APPROACH_LENGTH, *ends) - FIT_MARGIN
    way = np.minimum(way, room[enough])
    row = np.flatnonzero(way >= least)
    hands = candidates.take(row)
    hands.T_cloud_hand[:, :3, 3] -= np.minimum(way[row], MAX_INSERTION)[:, None] * hands.approach
    return hands


@compiled("contract")
def extents_across(
    points: Float32,  # (N, 3) of the cloud
    rows: Int64,  # (P,) of the points to measure, group after group
    first: Int64,  # (M,) indices in `rows` where the group of each edge begins
    last: Int64,  # (M,) indices where they end
    # (M, 4, 3) for each edge its point, and unit vectors across the strip, along it out of the
    # object, and ahead of the hand
    frame: Float32,
    # (4,) the strip's half width and length, how far ahead of the edge its points may be, and the
    # gap that ends it, metres
    strip: Float32,
) -> Float32:
    """Least and greatest distance (M, 2) of a surface from its edge, into the object; metres."""
    columns, extent = np.ascontiguousarray(points[rows].T), np.zeros((len(frame), 2), np.float32)
    length, gap = strip[1], strip[3]
    cell = gap / 4  # of a histogram along the strip
    cells = int(np.ceil((length + gap) / cell)) + 1
    reached = np.empty(cells, np.float32)
    depth = np.empty(np.max(last - first) if len(first) else 0, np.float32)
    for m in range(len(frame)):
        _into_strip(columns, first[m], last[m], frame[m], strip, depth)
        reached[:] = -np.inf
        least, found = np.float32(0.0), 0
        for i in range(last[m] - first[m]):
            depth[found] = depth[i]
            found += depth[i] < length
        for inward in depth[:found]:
            least = min(least, inward)
            place = int((inward + gap) / cell)
            reached[place] = max(reached[place], inward)
        furthest = np.float32(0.0)
        for place in range(int(gap / cell), cells):
            if reached[place] > furthest:
                if reached[place] - furthest > gap:
                    break
                furthest = reached[place]
        extent[m, 0], extent[m, 1] = least, furthest
    return extent


@compiled("contract")
def _into_strip(
    columns: Float32, first: int, last: int, frame: Float32, strip: Float32, depth: Float32
) -> None:
    """Set `depth` to the points' distances into the object; to the strip's length outside of it."""
    # Loops in separate functions on contiguous arrays are vectorised to 16 points at a time.
    xs, ys, zs = columns[0, first:last], columns[1, first:last], columns[2, first:last]
    origin, across, out, ahead = frame[0], frame[1], frame[2], frame[3]
    half, length, drop, gap = strip[0], strip[1], strip[2], strip[3]
    for i in range(len(xs)):
        x, y, z = xs[i] - origin[0], ys[i] - origin[1], zs[i] - origin[2]
        sideways = x * across[0] + y * across[1] + z * across[2]
        inward = -(x * out[0] + y * out[1] + z * out[2])
        below = x * ahead[0] + y * ahead[1] + z * ahead[2]
        inside = (abs(sideways) < half) & (below < drop) & (inward > -gap)
        depth[i] = inward if inside else length


@compiled("contract")
def _level_spread(
    columns: Float32,  # (3, N) points, sorted by
    key: Int64,  # (N,) the number of their cell
    middle: Float32,  # (M, 3) the points with these neighbourhoods
    middle_key: Int64,  # (M,)
    sizes: Int64,  # (3,) of the grid, cells
    toward: Float32,  # (T, M, 3) unit, toward each viewpoint
    reach: Float32,  # (2,) radius of a neighbourhood, and how far it extends downward, metres
) -> tuple[Float32, Float32, Float32]:
    """How the neighbours of each point are distributed, as seen from each viewpoint.

    Returns the direction orthogonal to `toward` in which they spread least, (T, M, 3) unit; how far
    (T, M) the point lies from their mean along it, not negative; their standard deviation (T, M)
    along it, metres.
    """
    ways = toward.shape[:2]
    offset, deviation = np.empty(ways, np.float32), np.empty(ways, np.float32)
    least = np.empty(toward.shape, np.float32)
    around, axes = np.empty(columns.shape, np.float32), np.zeros((3, 3), np.float32)
    for m in range(len(middle)):
        found = 0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                start = middle_key[m] + (dx * sizes[1] + dy) * sizes[2] - 1
                for j in range(np.searchsorted(key, start), np.searchsorted(key, start + 3)):
                    around[0, found] = columns[0, j]
                    around[1, found] = columns[1, j]
                    around[2, found] = columns[2, j]
                    found += 1
        near = around[0, :found], around[1, :found], around[2, :found]
        for way in range(len(toward)):
            _set_level_axes(toward[way, m], axes)
            count, a, b, aa, ab, bb = _moments(near, middle[m], axes, reach)
            a, b = a / count, b / count
            aa, ab, bb = aa / count - a * a, ab / count - a * b, bb / count - b * b
            turn = 0.5 * np.arctan2(-2.0 * ab, bb - aa)
            s, t = np.cos(turn), np.sin(turn)  # the direction of least variance
            outward = -(a * s + b * t)
            if outward < 0.0:
                s, t, outward = -s, -t, -outward
            for d in range(3):
                least[way, m, d] = s * axes[1, d] + t * axes[2, d]
            offset[way, m] = outward
            deviation[way, m] = np.sqrt(max(0.0, s * s * aa + 2.0 * s * t * ab + t * t * bb))
    return least, offset, deviation


@compiled("contract")
def _set_level_axes(up: Float32, axes: Float32) -> None:
    """Set `axes` to up and two level directions, chosen by the axis that is farthest from up."""
    first = 0
    for d in range(1, 3):
        first = d if abs(up[d]) < abs(up[first]) else first
    after, last = (first + 1) % 3, (first + 2) % 3
    length = np.sqrt(up[after] * up[after] + up[last] * up[last])
    for d in range(3):
        axes[0, d] = up[d]
    axes[1, first], axes[1, after], axes[1, last] = 0.0, -up[last] / length, up[after] / length
    for d in range(3):
        one, other = (d + 1) % 3, (d + 2) % 3
        axes[2, d] = up[one] * axes[1, other] - up[other] * axes[1, one]


@compiled("contract", "reassoc", "nsz")
def _moments(
    points: tuple[Float32, Float32, Float32], middle: Float32, axes: Float32, reach: Float32
) -> tuple[np.float32, ...]:
    """How many points are near, and the sums of their level coordinates s, t, s s, s t and t t."""
    count, a, b, aa, ab, bb = np.zeros(6, np.float32)
    xs, ys, zs = points
    for i in range(len(xs)):
        x, y, z = xs[i] - middle[0], ys[i] - middle[1], zs[i] - middle[2]
        above = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2] > -reach[1]
        near = above & (x * x + y * y + z * z < reach[0] * reach[0])
        one = np.float32(near)
        s = one * (x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2])
        t = one * (x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2])
        a, b, aa, ab, bb = a + s, b + t, aa + s * s, ab + s * t, bb + t * t
        count += one
    return count, a, b, aa, ab, bb
