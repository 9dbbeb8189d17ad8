"""Follow grasps from one answer to the next: `previous` in, ids and moved grasps out.

Nothing is kept between requests. An answer contains points on the surface of each object; when they
are sent back, they are registered with the next cloud and the object's grasps move with them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float32, Float64, Int64
from edgegrasp_model.candidates.edge_grasps import coarse_to_fine_sample
from edgegrasp_model.candidates.sample import allowed_directions
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.kernels import mean_over_similar, non_max_suppression
from edgegrasp_model.options import (
    MAX_SURFACE,
    Collision,
    DetectOptions,
    ObjectChoice,
    Previous,
    Suppression,
    Workspace,
)
from edgegrasp_model.ranking import COLLISION_FACTOR, objects_first, ranked
from edgegrasp_model.results import OBSTACLE, Following
from edgegrasp_model.scene.cloud import pose_matrix, subsample, unit
from edgegrasp_model.scene.scene import (
    Scene,
    SelectedPoints,
    labels_of_all_pixels,
    resolve_object_choice,
)
from edgegrasp_model.scene.segment import BACKGROUND, UNDECIDED
from edgegrasp_results import Evaluation, Grasp, Tracking

SWITCH_MARGIN = 0.1  # score difference by which another grasp must be better to replace it
MIN_FOLLOWED_SCORE = 0.25  # score from which a followed grasp may stay the first
ALLOWED_OVERLAP = 0.006  # metres by which the hand of a followed grasp may overlap the cloud
SEARCH_MARGIN = 0.03  # metres around followed objects in which they are searched
HIDING_SHARE = 0.3  # of a place's distance from the camera; anything nearer hides the place
MAX_FRAME_DISTANCE = 0.5  # metres from the cloud beyond which `previous` must be in another frame
OUT_OF_VIEW_ANGLE, MAX_VIEW_DISTANCE = 0.1, 2.0  # radians beside the view; metres from the camera
# Registration: in each step, points farther from the cloud than this are left out, metres.
REGISTRATION_DISTANCES = (*(0.03,) * 4, *(0.015,) * 4, *(0.008,) * 4)
SURFACE_SPACING = 0.004  # metres along a surface to its nearest point, unless it ends there
TANGENT_WEIGHT = 0.3  # weight of distances beyond that, relative to 1 across the surface
# Prior for no motion, in points: where the shape leaves motion undetermined, the object stays.
STILL_PRIOR = (0.5,) * 3 + (0.3,) * 3
LEAST_INFORMATION = 0.05  # per point, on a rotation; less, as about a can's axis, is noise
MIN_REGISTERED_POINTS = 6  # points that registration needs
FOUND_SHARE, WELL_SEEN_SHARE = 0.5, 0.75  # share of its points on the cloud: found; well seen
# Points this near to an object's surface belong to it: metres, or spacings of the surface's points.
OBJECT_REACH, REACH_SPACINGS = 0.012, 1.5


@dataclass(frozen=True)
class Followed:
    """The objects of `previous` that were found again, by their numbers."""

    # (4, 4) T_now_before of each, cloud frame, and its number now: the same, or its segment.
    moved: dict[int | None, tuple[Float64, int | None]]  # None: grasps on no object stay
    surface: dict[int, Float32]  # (K, 3) points, by numbers in the answer; new ones if few fit
    named: dict[int, int]  # numbers in the scene: numbers in the answer
    next_id: int


def narrowed(options: DetectOptions, gripper: str, points: Float32) -> DetectOptions:
    """The options for building the scene: without a search, only around followed objects.

    Objects are chosen by their numbers in the answer, which `follow` finds.
    InvalidRequest: `previous` is for another gripper, or in another frame than the points (N, 3).
    """
    previous = options.previous
    assert previous is not None
    if not isinstance(options.objects, str):
        options = options.model_copy(update={"objects": "auto"})
    if previous.gripper not in ("", gripper) or (previous.grasps and not previous.gripper):
        fix = f"Send what was found for {gripper!r}, or leave previous out."
        raise InvalidRequest("options.previous.gripper", repr(previous.gripper), fix)
    places = [np.reshape(grasp.T_cloud_hand, (4, 4))[:3, 3] for grasp in previous.grasps]
    places += [place for one in previous.objects for place in np.reshape(one.surface, (-1, 3))]
    if not places:
        return options
    some = subsample(points, 2000)
    apart = np.asarray(cKDTree(some).query(np.array(places))[0])
    if options.viewpoint is not None:  # unseen places need no points near them
        eye = np.reshape(options.viewpoint, (-1, 3)).mean(axis=0)
        aside, row = cKDTree(unit(some - eye)).query(unit(places - eye))
        distance = np.linalg.norm(places - eye, axis=1)
        before = np.linalg.norm(some[row] - eye, axis=1)
        unseen = (aside > OUT_OF_VIEW_ANGLE) | (before < HIDING_SHARE * distance)
        apart[unseen & (distance < MAX_VIEW_DISTANCE)] = 0.0
    if (away := float(np.min(apart))) > MAX_FRAME_DISTANCE:
        value = f"grasps {away:.2g} m from the nearest point of the cloud"
        fix = "Send previous in the frame of this cloud, or leave it out."
        raise InvalidRequest("options.previous", value, fix)
    if previous.search:
        return options
    low, high = np.min(places, axis=0) - SEARCH_MARGIN, np.max(places, axis=0) + SEARCH_MARGIN
    if options.workspace is not None:
        whole = np.array([options.workspace.min, options.workspace.max])
        low, high = np.maximum(low, whole[0]), np.minimum(high, whole[1])
        low, high = (low, high) if (low < high).all() else whole
    box = Workspace(min=tuple(low.tolist()), max=tuple(high.tolist()))
    unused = dict.fromkeys(("at", "near", "approach_region", "contact_region"))
    return options.model_copy(update={**unused, "workspace": box, "objects": "off"})


def follow(scene: Scene, previous: Previous, given: bool, chosen: bool) -> tuple[Scene, Followed]:
    """Find the objects of an earlier answer again.

    `given`: the caller gave the objects' numbers; `chosen`: the request leaves objects out, and the
    remaining ones must not be mistaken for them.
    """
    points, number = scene.points_in_cloud, scene.object_of_point
    seen = np.flatnonzero((number >= 0) | (chosen & (number == BACKGROUND)))
    normals = scene.frame.directions_to_cloud(scene.cloud.normals[seen])
    cloud = Surface(points[seen], normals, cKDTree(points[seen]))
    moved: dict[int | None, tuple[Float64, int | None]] = {None: (np.eye(4), None)}
    surface: dict[int, Float32] = {}
    found = np.unique(number[number >= 0])
    named = {int(one): int(one) for one in found} if given else {}
    renamed = number.copy() if given else np.where(number >= 0, UNDECIDED, number)
    taken = np.zeros(len(number), dtype=bool)
    places = [np.reshape(one.surface, (-1, 3)).astype(np.float64) for one in previous.objects]
    matches = [(*register_icp(before, cloud), row) for row, before in enumerate(places)]
    matches = [match for match in matches if match[1] >= FOUND_SHARE]
    placed = {row: places[row] @ T[:3, :3].T + T[:3, 3] for T, _, row in matches}
    nearest = np.zeros(len(number), dtype=np.int64)  # row of the object nearest to each point
    if several := len(placed) > 1 and not previous.search:
        rows = np.repeat([*placed], [len(now) for now in placed.values()])
        tree = cKDTree(np.concatenate([*placed.values()]))
        nearest[seen] = rows[tree.query(cloud.points)[1]]
    # If two objects match the same points, the better match gets them.
    for T, share, row in sorted(matches, key=lambda match: -match[1]):
        now = placed[row]
        if np.median(number[near := seen[cloud.near(now)]]) < 0:
            continue
        near = near[(number[near] >= 0) & ((nearest[near] == row) | (not several))]
        if len(near) == 0:
            continue
        there, count = np.unique(number[near], return_counts=True)
        which, name = int(there[count.argmax()]), previous.objects[row].number
        mine = number == which if previous.search else near
        if given:
            name = which
        elif taken[mine].mean() > 0.5:
            continue
        else:
            renamed[mine], taken[mine], named[which] = name, True, name
        moved[previous.objects[row].number] = T, name
        fits = share >= WELL_SEEN_SHARE
        here = now.astype(np.float32) if fits else sampled(points[renamed == name])
        surface.setdefault(name, here)
    next_id = previous.free_id
    for which in found if previous.search else ():
        if which not in named:
            named[int(which)], next_id = next_id, next_id + 1
            renamed[number == which] = named[which]
        if (mine := named[which]) not in surface:
            surface[mine] = sampled(points[renamed == mine])
    confidence = {named[old]: value for old, value in scene.confidence.items() if old in named}
    if not previous.search:
        known = [(one.number, one.confidence) for one in previous.objects]
        confidence = {which: value for which, value in known if value is not None}
    scene = replace(scene, object_of_point=renamed, confidence=confidence)
    return scene, Followed(moved, surface, named, next_id)


def only_chosen(
    scene: Scene, followed: Followed, choice: ObjectChoice | str, warnings: list[str]
) -> tuple[Scene, Followed]:
    """Leave out the objects that a choice does not name, by their numbers in the answer."""
    number = scene.object_of_point
    wanted = resolve_object_choice(np.unique(number[number >= 0]), choice, warnings)
    held = np.isin(number, wanted)
    moved = {was: now for was, now in followed.moved.items() if now[1] is None or now[1] in wanted}
    scene = replace(
        scene,
        object_of_point=np.where((number >= 0) & ~held, BACKGROUND, number),
        approach_allowed=scene.approach_allowed & held,
        contact_allowed=scene.contact_allowed & held,
    )
    return scene, replace(followed, moved=moved)


def merged(
    found: list[Grasp],  # found in this cloud alone, best first
    followed: Followed,
    options: DetectOptions,
    scene: Scene,
    gripper: Gripper,
    score: Callable[[Float32, Collision], list[Evaluation]],  # of poses (M, 4, 4) T_cloud_hand
) -> tuple[list[Grasp], Tracking]:
    """The earlier answer's grasps at their new poses, then others; the kept grasp comes first."""
    previous, kept = options.previous, list[Grasp]()
    assert previous is not None
    old = [one for one in previous.grasps if one.object in followed.moved]
    if old:
        before = np.reshape([one.T_cloud_hand for one in old], (-1, 4, 4))
        move, number = zip(*(followed.moved[one.object] for one in old), strict=True)
        # A small overlap is allowed, since the hand was fully checked when it was found.
        margin = options.collision.margin - ALLOWED_OVERLAP
        rule = options.collision.model_copy(update={"margin": margin})
        there = zip(old, number, score((move @ before).astype(np.float32), rule), strict=True)
        kept = [replace(e.grasp, id=one.id, object=now) for one, now, e in there if e.grasp]
    if kept:
        # A new grasp near a followed one is the same grasp; its score is averaged, unlike this one.
        some = [*kept, *found]
        own = np.array([one.score for one in some], dtype=np.float32)
        best = np.fmax(own, _mean_over_same(own, some, options)).tolist()
        kept = [replace(one, score=score) for one, score in zip(kept, best, strict=False)]
        ways = scene.frame.directions_from_cloud([one.approach_direction for one in kept])
        fit = allowed_directions(ways, options.approach_direction, scene.frame)
        fit &= np.array([one.score >= options.min_score for one in kept])
        fit &= np.array([one.collision_free or options.collision.mode != "avoid" for one in kept])
        kept = [kept[row] for row in np.flatnonzero(fit)]
    grasps = kept + [replace(one, id=followed.next_id + row) for row, one in enumerate(found)]
    order = _order(grasps, options, scene, gripper, len(kept))
    outcome, first = untracked(previous).first, [one.id for one in previous.grasps[:1]]
    held = next((row for row in order if grasps[row].id in first), None)
    if held is not None and (worth := _worth(grasps[held], options)) >= MIN_FOLLOWED_SCORE:
        # Without a search, all grasps are from the earlier answer; their scores vary with noise.
        better = previous.search and _worth(grasps[order[0]], options) > worth + SWITCH_MARGIN
        outcome = Following.REPLACED if better else Following.KEPT
        order = order if better else [held, *(row for row in order if row != held)]
    tracking = Tracking(outcome, followed.next_id + len(found))
    return [grasps[row] for row in order[: options.top_k]], tracking


def untracked(previous: Previous) -> Tracking:
    """The tracking state if nothing is seen."""
    outcome = Following.LOST if previous.grasps else Following.STARTED
    return Tracking(outcome, previous.free_id)


def _order(
    grasps: list[Grasp], options: DetectOptions, scene: Scene, gripper: Gripper, kept: int
) -> list[int]:
    """Rows of grasps, best first, without duplicates of the first `kept` or of a better one.

    The grasps after those are already in order.
    """
    if kept == 0:
        return list(range(len(grasps)))
    rows = np.arange(len(grasps), dtype=np.int64)
    if (rule := options.suppression) is None:  # only new grasps near a kept one are left out
        like_kept = _mean_over_same((rows < kept).astype(np.float32), grasps, options) > 0.0
        rows = rows[(rows < kept) | ~like_kept]
    else:
        T_cloud_tcp = np.stack([grasp.T_cloud_tcp for grasp in grasps])
        rows, _ = non_max_suppression(T_cloud_tcp, rows, rule.translation, rule.rotation)
    some = [grasps[row] for row in rows]
    score = np.array([one.score for one in some])
    free = np.array([one.collision_free for one in some])
    clearance = np.array([one.clearance for one in some])
    hands = scene.frame.poses_from_cloud([one.T_cloud_hand for one in some])
    places = np.stack([one.contact_point for one in some])
    contact = np.asarray(cKDTree(scene.points_in_cloud).query(places)[1])
    order, _ = ranked(scene, contact, hands, score, free, gripper, options, clearance)
    if options.order == "score":
        number = np.array([-1 if one.object is None else one.object for one in some])
        order = objects_first(order, order, score, number)
    return [int(row) for row in rows[order]]


def _worth(grasp: Grasp, options: DetectOptions) -> float:
    free = grasp.collision_free or options.collision.mode == "ignore"
    return grasp.score if free else COLLISION_FACTOR * grasp.score


class Surface(NamedTuple):
    """V visible points, cloud frame."""

    points: Float32  # (V, 3)
    normals: Float32  # (V, 3) unit
    tree: cKDTree

    def near(self, places: Float64) -> Int64:
        """Rows of the points on an object, found by K points (K, 3) of its surface."""
        spacing = float(np.median(cKDTree(places).query(places, k=[2])[0]))
        rows = self.tree.query_ball_point(places, max(OBJECT_REACH, REACH_SPACINGS * spacing))
        return np.unique(np.concatenate([np.asarray(one, dtype=np.int64) for one in rows]))


def register_icp(before: Float64, cloud: Surface) -> tuple[Float64, float]:
    """An object's motion (4, 4) T_now_before, and the share of its points (K, 3) found there.

    This is the iterative closest point algorithm (ICP), mostly point-to-plane, from the old pose;
    distances along the surface count only where an object ends.
    """
    T = np.eye(4)
    if len(before) < MIN_REGISTERED_POINTS or len(cloud.points) < MIN_REGISTERED_POINTS:
        return T, 0.0
    spread = max(float(np.square(before - before.mean(axis=0)).sum(axis=1).mean()), 1e-9)
    still, total = np.diag(np.multiply(STILL_PRIOR, [spread] * 3 + [1.0] * 3)), np.zeros(6)
    for reach in REGISTRATION_DISTANCES:
        now = before @ T[:3, :3].T + T[:3, 3]
        apart, row = cloud.tree.query(now, distance_upper_bound=reach)
        row, hit = np.asarray(row), np.isfinite(apart)
        if hit.sum() < MIN_REGISTERED_POINTS:
            return T, 0.0
        off, normal = cloud.points[row[hit]] - now[hit], cloud.normals[row[hit]].astype(np.float64)
        middle = now.mean(axis=0)
        across = np.einsum("kd,kd->k", off, normal)
        along = off - across[:, None] * normal
        length = np.linalg.norm(along, axis=1)
        along *= (np.maximum(length - SURFACE_SPACING, 0.0) / np.maximum(length, 1e-9))[:, None]
        arm = now[hit] - middle
        moves = np.zeros((len(arm), 3, 6))  # of each point, per rotation and translation
        moves[:, (1, 2, 0), (2, 0, 1)], moves[:, (2, 0, 1), (1, 2, 0)] = arm, -arm
        moves[:, :, 3:] = np.eye(3)
        rows, ends = np.einsum("kd,kdm->km", normal, moves), length > SURFACE_SPACING
        sides = moves[ends].reshape(-1, 6)
        system, stiff = rows.T @ rows + TANGENT_WEIGHT * sides.T @ sides + still, still.copy()
        # Information of the points on rotations, for any translation: little about a can's axis.
        alone = np.linalg.solve(system[3:, 3:], system[3:, :3])
        known, axes = np.linalg.eigh(system[:3, :3] - system[:3, 3:] @ alone)
        doubt = np.square(LEAST_INFORMATION * spread * len(arm)) / known
        stiff[:3, :3] += (axes * doubt) @ axes.T
        system += stiff - still
        target = rows.T @ across + TANGENT_WEIGHT * sides.T @ along[ends].ravel() - stiff @ total
        step = np.linalg.solve(system, target)
        total += step
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        T = pose_matrix(turn, middle + step[3:] - turn @ middle) @ T
    now = before @ T[:3, :3].T + T[:3, 3]
    apart, _ = cloud.tree.query(now, distance_upper_bound=REGISTRATION_DISTANCES[-1])
    return T, float(np.isfinite(apart).mean())


def _mean_over_same(values: Float32, grasps: list[Grasp], options: DetectOptions) -> Float32:
    """The mean value (E,), for each grasp, of the others near enough to be the same; NaN: none."""
    rule = options.suppression or Suppression()
    T_cloud_tcp, number = np.stack([one.T_cloud_tcp for one in grasps]), np.zeros(len(grasps), int)
    return mean_over_similar(values, T_cloud_tcp, number, rule.translation, rule.rotation)


def sampled(points: Float32) -> Float32:
    """Up to MAX_SURFACE of points (N, 3), spread over them."""
    return points[coarse_to_fine_sample(points, MAX_SURFACE)]


def relabelled(selected: SelectedPoints, scene: Scene, followed: Followed, search: bool) -> Int64:
    """Labels (R,) of rows by the answer's object numbers; OBSTACLE where there is none."""
    labels = selected.labels
    renamed = np.where(labels >= 0, OBSTACLE, labels)
    if search:
        for before, now in followed.named.items():
            renamed[labels == before] = now
        return renamed
    # Without a search, everything was one object while the scene was built.
    rows = np.flatnonzero((labels >= 0) & (scene.point_of_row >= 0))
    renamed[rows] = np.maximum(scene.object_of_point[scene.point_of_row[rows]], OBSTACLE)
    return labels_of_all_pixels(selected.cloud, renamed)
