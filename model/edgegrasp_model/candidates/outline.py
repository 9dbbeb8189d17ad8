"""Grasps across an outline: the hand comes from above or the camera and closes on a depth edge.

At a depth edge the side of the object is not seen, so the normal that an edge grasp needs is
missing. These grasps need only the direction of the outline and what lies between, beside and below
the fingers.
"""

from dataclasses import dataclass

import numpy as np

from edgegrasp_camera.arrays import Bools, Float32, Int64
from edgegrasp_model.candidates.collision import APPROACH_LENGTH
from edgegrasp_model.candidates.edge_grasps import (
    EDGE_MARGIN,
    MIN_EDGE,
    TIP_MARGIN,
    BallCrop,
    Candidates,
    support_clearance,
)
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_kernels import free_way
from edgegrasp_model.kernels import extents_across, level_spread
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import UP, unit

OUTLINE_RADIUS = 0.016  # metres of surface from which the outline's direction is estimated
MIN_OUTWARD = 0.002  # metres from a neighbourhood's mean to a point on the outline
THIN = 0.003  # metres of standard deviation across a rim, all of which counts as outline
LEAN, LEANING = np.radians(30.0), 4  # radians off vertical; directions around it
DROP = 0.006  # metres below an edge from which a surface counts as another one
GAP = 0.007  # metres without a point in which a surface ends
ONE_VIEW = np.cos(np.radians(15.0))  # radians; directions closer than this show the same outline
CLEARANCE = 0.002  # metres kept free ahead of the hand as it goes in
MAX_INSERTION = 0.020  # metres deeper than an edge grasp; more does not hold better
LEVEL = 1e-6  # cosine below which a hand moves along the support


@dataclass(frozen=True)
class Outline:
    """The depth edges of a cloud of N points, as seen from a viewpoint."""

    toward: Float32  # (N, 3) unit, from each point to the viewpoint
    heading: Float32  # (N, 3) unit, orthogonal to `toward`: across the edge, out of the object
    is_edge: Bools  # (N,)


def outlines(
    points: Float32,  # (N, 3) canonical frame, metres
    viewpoints: Float32 | None,  # (W, 3); None where they are unknown
    rows: Int64,  # (M,) of the points to look at
    *,
    leaning: bool = False,  # also from all around, LEAN off above
) -> list[Outline]:
    """The outlines of a cloud from above and, if that is another direction, from each camera."""
    toward = [np.broadcast_to(UP, points.shape)]
    toward += [unit(eye - points) for eye in ([] if viewpoints is None else viewpoints)]
    if leaning:
        for turn in np.linspace(0.0, 2 * np.pi, LEANING, endpoint=False):
            way = np.array([np.sin(LEAN) * np.cos(turn), np.sin(LEAN) * np.sin(turn), np.cos(LEAN)])
            toward.append(np.broadcast_to(way.astype(np.float32), points.shape))
    ways = np.stack([each[rows] for each in toward])
    spreads = level_spread(points, rows, ways, OUTLINE_RADIUS, DROP)
    found: list[Outline] = []
    for each, way, least, outward, spread in zip(toward, ways, *spreads, strict=True):
        heading, is_edge = np.zeros_like(points), np.zeros(len(points), dtype=bool)
        # A point is on the outline if its neighbours at its height or above lie on one side.
        heading[rows] = least
        is_edge[rows] = (outward > MIN_OUTWARD) | (spread < THIN)
        if found:
            is_edge[rows] &= way @ UP < ONE_VIEW
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
    """Hands that approach from the outline's viewpoint and close across it; at most one a contact.

    The contact point lies on the outline, the hand in the middle between it and the opposite edge
    of the same surface, and the approach point nearest to the hand's axis. The hand moves in until
    something is right ahead of it, at most MAX_INSERTION deeper than an edge grasp.
    """
    y, z = outline.heading, -outline.toward
    frame = np.stack([points, np.cross(y, z), y, z], axis=1)  # (N, 4, 3)
    pair = pair[outline.is_edge[crop.ball_rows[pair]]]
    contact, approach = crop.ball_rows[pair], approach_index[crop.ball_of_point[pair]]
    apart = points[contact] - points[approach]
    edge = np.einsum("md,mkd->km", apart, frame[contact, 1:])
    between = (np.abs(edge[0]) < gripper.pad_half_width) & (edge[2] > -DROP)
    row = np.flatnonzero(between & (edge[1] > MIN_EDGE) & (edge[1] < gripper.max_opening))
    first, last = crop.bounds(crop.ball_of_point[pair[row]])
    strip = np.array([gripper.pad_half_width, gripper.max_opening, DROP, GAP], dtype=np.float32)
    # How far the surface extends between the pads from each contact, outward and inward: (M, 2).
    extent = extents_across(points, crop.ball_rows, first, last, frame[contact[row]], strip)
    width = extent[:, 1] - extent[:, 0]
    held = (extent[:, 0] > -MIN_EDGE) & (width < gripper.max_opening - 2 * EDGE_MARGIN)
    held &= edge[1][row] < extent[:, 1] + MIN_EDGE  # the approach point lies on the same surface
    off_axis = np.hypot(edge[0][row], edge[1][row] - extent.mean(axis=1))
    nearest = np.lexsort((off_axis, contact[row], ~held))[: held.sum()]
    chosen = nearest[np.unique(contact[row[nearest]], return_index=True)[1]]
    row, extent, width = row[chosen], extent[chosen], width[chosen]
    contact, z = contact[row], z[contact[row]]
    pose = np.zeros((len(row), 4, 4), dtype=np.float32)
    pose[:, :3, :3] = frame[contact, 1:].transpose(0, 2, 1)
    middle = points[contact] - extent.mean(axis=1, keepdims=True) * y[contact]
    pose[:, :3, 3] = middle - gripper.contact_z_at(width)[:, None] * z
    pose[:, 3, 3] = 1.0
    depth = np.maximum(edge[2][row], 0.0)
    hands = Candidates(pair[row], approach[row], contact, depth, pose)
    return _inserted(points, hands, support, gripper, margin)


def _inserted(
    points: Float32,
    candidates: Candidates,
    support: SupportPlane | None,
    gripper: Gripper,
    margin: float,
) -> Candidates:
    """The hands moved in until something is right ahead, without those that stop early."""
    least = gripper.contact_z + TIP_MARGIN - gripper.tip_z  # metres of way that it takes
    room = np.full(len(candidates), np.inf, dtype=np.float32)  # metres of way above the support
    if support is not None:
        fall = candidates.approach @ np.asarray(support.normal, dtype=np.float32)
        height = support_clearance(candidates.T_cloud_hand, support, gripper) - margin
        room = np.where(fall > LEVEL, height / np.maximum(fall, LEVEL), room)
    enough = np.flatnonzero(room >= least)
    candidates = candidates.take(enough)
    boxes = gripper.open_boxes + margin * np.array([[-1.0], [1.0]])
    way = free_way(points, candidates.T_cloud_hand, boxes, APPROACH_LENGTH) - CLEARANCE
    way = np.minimum(way, room[enough])
    row = np.flatnonzero(way >= least)
    hands = candidates.take(row)
    hands.T_cloud_hand[:, :3, 3] -= np.minimum(way[row], MAX_INSERTION)[:, None] * hands.approach
    return hands
