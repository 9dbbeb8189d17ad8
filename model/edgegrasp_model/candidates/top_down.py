"""Top-down grasps: straight down at the middle and at the near rim of each object.

Sampled hands differ from image to image. These follow from all points of an object, so that new
noise hardly moves them; the ranking prefers them to sampled hands that are hardly better.
"""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from edgegrasp_camera.arrays import Bools, Float32, Float64
from edgegrasp_model.candidates.edge_grasps import EDGE_MARGIN, GAP, Candidates, inserted
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.scene.cloud import UP
from edgegrasp_model.scene.scene import Scene

FEWEST = 20  # points of an object
ELONGATED = 1.25  # length over width from which an object has a short side
ACROSS_SIGHT, ALONG_SIGHT = np.array([0.0, 1.0]), np.array([1.0, 0.0])  # x points to the camera
FRONT = 0.01  # metres behind the point nearest to the camera: these points are its front
RIM = 0.02, 0.006  # metres behind the front and below the highest point there, at most
TOP = 95  # percentile of heights that counts as the highest point
END = 0.005  # metres from where a finger touches


def top_down_grasps(scene: Scene, gripper: Gripper, margin: float = 0.0) -> Candidates:
    """Hands that move straight down, up to four on each object, as deep as those across outlines.

    They close across the short side, across and along the camera's line of sight, and across the
    front rim. `pair` is -1, -2, -3 or -4, in this order: the first are preferred.
    """
    found: list[tuple[int, int, int, float, Float32]] = []
    for number in np.unique(scene.object_of_point[scene.object_of_point >= 0]):
        rows = np.flatnonzero(scene.object_of_point == number)
        points = scene.cloud.points[rows].astype(np.float64)
        for place, held in _between_pads(points, gripper.pad_half_width):
            approach = held.strip & scene.approach_allowed[rows]
            contact = held.strip & scene.contact_allowed[rows] & (points[:, 2] > held.top - END)
            narrow = held.width < gripper.max_opening - 2 * EDGE_MARGIN
            if not (narrow and approach.any() and contact.any()):
                continue
            middle = np.append(held.middle, held.top)
            away = np.linalg.norm(points - middle, axis=1)
            side = np.abs(points[:, :2] @ held.way - held.last)
            beside = side + (held.top - points[:, 2]).clip(0.0)
            a = int(rows[np.where(approach, away, np.inf).argmin()])
            c = int(rows[np.where(contact, beside, np.inf).argmin()])
            found.append((place, a, c, held.width, _pose(middle, held.way, gripper)))
    if not found:
        return Candidates.none()
    pair, approach_index, contact_index, width, pose = (
        np.array(column) for column in zip(*found, strict=True)
    )
    height = scene.cloud.points[:, 2]
    depth = (height[approach_index] - height[contact_index]).clip(0.0)
    opening = width.astype(np.float32)
    hands = Candidates(pair, approach_index, contact_index, depth, opening, pose)
    return inserted(scene.cloud.points, hands, scene.support, gripper, margin)


def smallest_rectangle(plan: Float64) -> tuple[Float64, Float64, Float64]:
    """The smallest rectangle around points (N, 2): its axes (2, 2), middle (2,) and size (2,)."""
    corners = plan
    with suppress(QhullError, ValueError):  # too few points, or all on a line
        corners = plan[ConvexHull(plan).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    edges = edges[np.linalg.norm(edges, axis=1) > 0] if len(corners) > 1 else edges[:0]
    edges = np.concatenate([edges, [[1.0, 0.0]]])
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    # It has a side along an edge of their hull.
    axes = np.stack([edges, np.stack([-edges[:, 1], edges[:, 0]], axis=1)], axis=1)  # (K, 2, 2)
    turned = np.einsum("kad,cd->kca", axes, corners)
    size = np.ptp(turned, axis=1)
    best = int(size.prod(axis=1).argmin())
    middle = axes[best].T @ (turned[best].min(axis=0) + size[best] / 2)
    return axes[best], middle, size[best]


class _Held(NamedTuple):
    """What pads close on."""

    way: Float64  # (2,) unit, the closing direction
    strip: Bools  # (P,) points of the object between the pads
    middle: Float64  # (2,) of the hand
    width: float  # metres
    last: float  # metres along the closing direction, where one finger touches
    top: float  # metres, height of the higher touched point


def _between_pads(points: Float64, half: float) -> Iterator[tuple[int, _Held]]:
    """What pads of a half width close on in each way at an object's points (P, 3), by `pair`."""
    if len(points) < FEWEST:
        return
    plan, height = points[:, :2], points[:, 2]
    axes, middle, size = smallest_rectangle(plan)
    short = axes[size.argmin()] if size.max() > ELONGATED * size.min() else None
    for pair, way in ((-1, short), (-2, ACROSS_SIGHT), (-3, ALONG_SIGHT), (-4, ALONG_SIGHT)):
        if way is None:
            continue
        across, rim = np.array([-way[1], way[0]]), pair == -4
        along, aside = plan @ way, plan @ across
        centre = middle @ across
        if rim:
            centre = float(np.median(aside[along > along.max() - FRONT]))
        strip = np.abs(aside - centre) < half
        if rim:
            strip &= along > along[strip].max(initial=-np.inf) - RIM[0]
        if not strip.any():
            continue
        top = float(np.percentile(height[strip], TOP))
        if rim:
            strip &= height > top - RIM[1]
        reach = np.sort(along[strip])[::-1]
        if rim and (gaps := np.flatnonzero(-np.diff(reach) > GAP)).size:
            reach = reach[: gaps[0] + 1]
        first, last = float(reach[-1]), float(reach[0])
        at = way * (first + last) / 2 + across * centre
        # A round object is touched below its top.
        ends = [strip & (np.abs(along - end) < END) for end in (first, last)]
        top = max(float(np.percentile(height[end], TOP)) for end in ends)
        yield pair, _Held(way, strip, at, last - first, last, top)


def _pose(middle: Float64, way: Float64, gripper: Gripper) -> Float32:
    """The pose (4, 4) of a hand over a place (3,) that closes along a level direction (2,)."""
    y = np.append(way, 0.0)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(y, -UP), y, -UP], axis=1)
    pose[:3, 3] = middle + gripper.contact_z * UP
    return pose.astype(np.float32)
