"""From scored candidates to ranked grasps in the caller's frame."""

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Array, Bools, Float32, Floats, Int64
from edgegrasp_model.candidates.collision import clearances, hand_views
from edgegrasp_model.candidates.edge_grasps import Candidates
from edgegrasp_model.candidates.sample import OUTCOME_CODE, Sample
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.kernels import mean_over_similar, non_max_suppression
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import Outcome, UngraspableReason
from edgegrasp_model.scene.scene import Scene
from edgegrasp_model.scene.support import heights_over
from edgegrasp_model.unseen import leaves_image, unseen_space
from edgegrasp_results import DebugInfo, DetectedObject, Grasp

COLLISION_FACTOR = 0.5  # factor on the score of a colliding grasp in the ranking
GOOD_SCORE = 0.5  # score from which an object has a good grasp
SURE_SCORE = 0.9  # score from which the order `highest` goes by height (the paper's robot policy)
FINGER_CLEARANCE = 0.005  # metres left free between each finger and the object
MAX_HIDDEN_DEPTH = 0.004  # metres of unseen space into which an object may extend
FLAT_HEIGHT = 0.012  # metres of visible height below which the support may block grasps
MAX_DRAWBACK, FAR = 0.02, 0.1  # largest deduction per drawback; metres off centre for all of it
# How many of the best hands are compared; weight of the logarithm of the number of good hands
# around each; rating difference at which a hand counts 1/e as much.
COMPARED_HANDS, DENSITY_WEIGHT, RATING_SCALE = 100, 0.1, 0.02
OUTSIDE_LOSS = 0.3  # subtracted from the rating of a hand that reaches out of the image
# Hands whose logits are averaged: metres and radians apart; weight of a hand's own logit; factor
# that calibrates the average.
SIMILAR_DISTANCE, SIMILAR_ANGLE, OWN_WEIGHT, SHARPENING = 0.03, math.radians(30), 0.3, 1.3
OUTCOMES = list(Outcome)


def average_similar_hands(sample: Sample, scene: Scene, gripper: Gripper) -> Float32:
    """The logits (E,) of a sample, averaged over similar hands.

    The best of many logits is too high by chance, and a robot's pose is never exact: a hand slips
    where similar hands slip.
    """
    candidates, logits = sample.candidates, sample.logits
    number = scene.object_of_point[candidates.contact_index]
    T_cloud_tcp = candidates.T_cloud_hand @ gripper.T_hand_tcp
    others = mean_over_similar(logits, T_cloud_tcp, number, SIMILAR_DISTANCE, SIMILAR_ANGLE)
    own, rest = np.float32(SHARPENING * OWN_WEIGHT), np.float32(SHARPENING * (1.0 - OWN_WEIGHT))
    averaged = own * logits + rest * others
    return np.where(np.isnan(others), logits, averaged)


def select(
    scene: Scene,
    sample: Sample,  # E scored candidates
    score: Floats,  # (E,) probabilities
    rating: Floats,  # (E,) scores before rescaling by a robot's outcomes; they decide the order
    gripper: Gripper,
    options: DetectOptions,
    counts: dict[str, int],  # gets the number of candidates left after each step
) -> tuple[Int64, NDArray[np.int8]]:
    """Order the scored candidates, drop low scores and near duplicates, keep the first top_k.

    One good grasp of each object comes before a second one of any object. Returns the rows that
    are kept, best first, and codes (E,) of the outcomes.
    """
    candidates = sample.candidates
    hands, contact = candidates.T_cloud_hand, candidates.contact_index
    T_cloud_tcp = hands @ gripper.T_hand_tcp
    clearance = None
    if options.order == "clearance":
        clearance = clearances(scene, hands, candidates.opening, gripper)
    order, worth = ranked(
        scene, contact, hands, rating, sample.collision_free, gripper, options, clearance
    )
    outcome = np.full(len(score), OUTCOME_CODE[Outcome.BEYOND_TOP_K])
    good = score[order] >= options.min_score
    outcome[order[~good]] = OUTCOME_CODE[Outcome.LOW_SCORE]
    order, dropped = order[good], order[:0]
    counts["above_min_score"] = len(order)
    if options.order == "score":
        liked = densest_first(order, worth, T_cloud_tcp)
        order = objects_first(order, liked, rating, scene.object_of_point[contact])
    if (rule := options.suppression) is not None:
        near = rule.translation, rule.rotation
        order, dropped = non_max_suppression(T_cloud_tcp, order, *near)
        if options.order == "score":  # an object's first one may be suppressed by now
            order = objects_first(order, order, rating, scene.object_of_point[contact])
    order = order[: options.top_k]
    outcome[dropped] = OUTCOME_CODE[Outcome.SUPPRESSED]
    outcome[order] = OUTCOME_CODE[Outcome.RETURNED]
    counts["suppressed"], counts["returned"] = len(dropped), len(order)
    return order, outcome


def densest_first(order: Int64, worth: Floats, T_cloud_tcp: Floats) -> Int64:
    """The rows `order`, the best ones sorted by how many good hands surround each; worth (E,).

    Noise changes which hand is the best one, but hardly which hands good ones surround.
    """
    best = order[:COMPARED_HANDS]
    place, turn = T_cloud_tcp[best, :3, 3], T_cloud_tcp[best, :3, :3].reshape(-1, 9)
    trace, approach = turn @ turn.T, turn[:, 2::3] @ turn[:, 2::3].T
    trace = np.maximum(trace, 2 * approach - trace)  # half a turn about z changes nothing
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    away = np.square(cdist(place, place) / SIMILAR_DISTANCE) + np.square(angle / SIMILAR_ANGLE)
    with np.errstate(under="ignore"):  # even if the caller raises it
        good = np.exp((worth[best] - worth[best].max(initial=0.0)) / RATING_SCALE)
        raised = worth[best] + DENSITY_WEIGHT * np.log(np.exp(-away / 2) @ good)
    return np.concatenate([best[np.argsort(-raised, kind="stable")], order[COMPARED_HANDS:]])


def _drawbacks(
    scene: Scene, contact_index: Int64, T_cloud_hand: Float32, gripper: Gripper
) -> Floats:
    """What to subtract from ratings (E,), so that noise does not decide between equal hands.

    A hand should be vertical and near the middle of its object as seen from above. It should close
    horizontally and across the line of sight, where both sides are seen; its object should be
    large. Above all, the hand should stay in the image.
    """
    T_cloud_tcp = T_cloud_hand @ gripper.T_hand_tcp
    _, row, size = np.unique(scene.object_of_point, return_inverse=True, return_counts=True)
    x, y = (np.bincount(row, plan) / size for plan in scene.cloud.points.T[:2])
    mine = row[contact_index]
    apart = np.hypot(T_cloud_tcp[:, 0, 3] - x[mine], T_cloud_tcp[:, 1, 3] - y[mine])
    lean = np.hypot(T_cloud_tcp[:, 0, 2], T_cloud_tcp[:, 1, 2])
    along, _, tilt = np.abs(T_cloud_tcp[:, :3, 1].T)  # x points to the camera
    small = np.log(size[mine].max(initial=1) / size[mine]) / 3
    taken: Floats = MAX_DRAWBACK * (np.minimum(apart / FAR, 1.0) + lean + along + tilt + small)
    if scene.P_image_cloud is not None:
        taken = taken + OUTSIDE_LOSS * leaves_image(scene.P_image_cloud, T_cloud_hand, gripper)
    return taken


def objects_first(order: Int64, liked: Int64, score: Floats, number: Int64) -> Int64:
    """The rows `order`, with each object's first good row in `liked` moved to the front."""
    good = liked[score[liked] >= GOOD_SCORE]
    first = good[np.sort(np.unique(number[good], return_index=True)[1])]
    return np.concatenate([first, order[~np.isin(order, first)]])


def ranked(
    scene: Scene,
    contact_index: Int64,  # (E,) rows of the scene's cloud
    hands: Float32,  # (E, 4, 4) T_cloud_hand
    score: Floats,  # (E,) probabilities
    collision_free: Bools,  # (E,) the scores of the others are multiplied by COLLISION_FACTOR
    gripper: Gripper,
    # `highest`: by height where the score is SURE_SCORE or more; `clearance`: collision-free ones
    # first, by clearance
    options: DetectOptions,
    clearance: Floats | None,  # (E,) for `clearance`
) -> tuple[Int64, Floats]:
    """Rows in the requested order, best first, and the worth (E,), which breaks ties."""
    collision_free = collision_free | (options.collision.mode == "ignore")
    if options.order == "score":
        score = score - _drawbacks(scene, contact_index, hands, gripper)
    worth = np.where(collision_free, score, score - COLLISION_FACTOR * np.abs(score))
    keys: tuple[Array, ...] = (-worth,)
    if options.order == "highest":
        sure, height = worth >= SURE_SCORE, (hands @ gripper.T_hand_tcp)[:, 2, 3]
        keys = (-worth, np.where(sure, -height, -worth), ~sure)
    if options.order == "clearance" and clearance is not None:
        keys = (-score, -clearance, ~collision_free)
    return np.lexsort(keys).astype(np.int64), worth


def grasps_in_cloud(
    scene: Scene, candidates: Candidates, gripper: Gripper, score: Floats, collision_free: Bools
) -> list[Grasp]:
    """Grasps in the cloud's frame, of E candidates; all arrays are (E,)."""
    T_cloud_hand = scene.frame.poses_to_cloud(candidates.T_cloud_hand)
    T_cloud_tcp = T_cloud_hand @ gripper.T_hand_tcp
    met, hidden = _touched_first(scene, candidates.T_cloud_hand, gripper)
    width = 2 * (np.abs(met).max(axis=1) + np.float32(FINGER_CLEARANCE))
    widest = np.float32(gripper.max_opening)
    width = np.where(hidden, widest, np.minimum(width, widest))
    clearance = clearances(scene, candidates.T_cloud_hand, candidates.opening, gripper)
    number = scene.object_of_point[candidates.contact_index]
    return [
        Grasp(
            score=float(np.float32(score[row])),
            T_cloud_hand=T_cloud_hand[row],
            T_cloud_tcp=T_cloud_tcp[row],
            width=float(width[row]),
            approach_point=scene.points_in_cloud[candidates.approach_index[row]],
            contact_point=scene.points_in_cloud[candidates.contact_index[row]],
            approach_direction=T_cloud_hand[row, :3, 2],
            collision_free=bool(collision_free[row]),
            clearance=float(clearance[row]),
            object=None if number[row] < 0 else int(number[row]),
            far_side_hidden=bool(hidden[row]),
        )
        for row in range(len(candidates))
    ]


def _touched_first(scene: Scene, T_cloud_hand: Float32, gripper: Gripper) -> tuple[Float32, Bools]:
    """Where the fingers of hands (E, 4, 4) touch first, and whether unseen space lies beyond.

    Returns the greatest and least y (E, 2) of the points between the open fingers, hand frame, 0
    if there are none; and which hands (E,) have unseen space beyond a contact.
    """
    view = hand_views(scene.cloud, T_cloud_hand, gripper)
    between = gripper.between_fingers(view.position)
    hand, place = view.candidate[between], view.position[1, between]
    met = np.full((len(T_cloud_hand), 2), (-np.inf, np.inf), dtype=np.float32)
    np.maximum.at(met[:, 0], hand, place)
    np.minimum.at(met[:, 1], hand, place)
    met = np.where(np.isfinite(met), met, np.float32(0.0))
    beyond = unseen_space(scene.depths, T_cloud_hand, met, gripper).beyond
    return met, np.asarray(np.maximum(*beyond) > MAX_HIDDEN_DEPTH)


def detected_objects(
    scene: Scene,
    grasps: Sequence[Grasp],  # those that are returned
    sample: Sample | None,  # E scored candidates; None: there are none
    score: Floats,  # (E,) probabilities
    gripper: Gripper,
) -> list[DetectedObject]:
    """The scene's objects, largest first, with their best grasp or why they have no good one."""
    number, count = np.unique(scene.object_of_point[scene.object_of_point >= 0], return_counts=True)
    best = {grasp.object: grasp.score for grasp in sorted(grasps, key=lambda grasp: grasp.score)}
    objects = []
    for row in np.argsort(-count, kind="stable"):
        which = int(number[row])
        T_cloud_box, half, width = _upright_box(scene, scene.object_of_point == which)
        turn = Rotation.from_matrix(T_cloud_box[:3, :3])
        good = best.get(which, 0.0) >= GOOD_SCORE
        objects.append(
            DetectedObject(
                number=which,
                points=int(count[row]),
                center=T_cloud_box[:3, 3],
                half_extents=half,
                quaternion=turn.as_quat().astype(np.float32),
                best_score=best.get(which),
                confidence=scene.confidence.get(which),
                reason=None if good else _reason(scene, which, width, sample, score, gripper),
            )
        )
    return objects


def _reason(
    scene: Scene, number: int, width: float, sample: Sample | None, score: Floats, gripper: Gripper
) -> UngraspableReason | None:
    """Why an object whose least width as seen from above is `width` has no good grasp."""
    if sample is None:
        return None
    drawn = scene.object_of_point[sample.drawn.contact_index] == number
    scored = np.flatnonzero(drawn[sample.row])
    if score[scored].max(initial=0.0) >= GOOD_SCORE:
        return None
    if width > gripper.max_opening:
        return UngraspableReason.TOO_WIDE
    outcome = sample.outcome[drawn]
    codes = OUTCOME_CODE[Outcome.SUPPORT], OUTCOME_CODE[Outcome.DIRECTION]
    out_of_reach = np.isin(outcome, codes)
    mine = scene.cloud.points[scene.object_of_point == number]
    height = np.ptp(mine[:, 2])
    if scene.support is not None:
        height = heights_over(scene.support, mine).max()
    if height < FLAT_HEIGHT and out_of_reach.sum() >= len(outcome) / 2:
        return UngraspableReason.TOO_FLAT
    if not sample.collision_free[scored].any():
        allowed = outcome != OUTCOME_CODE[Outcome.DIRECTION]
        untried = OUTCOME_CODE[Outcome.NOT_CHECKED], OUTCOME_CODE[Outcome.NOT_SCORED]
        blocked = allowed.any() and not np.isin(outcome, untried).any()
        return UngraspableReason.BLOCKED if blocked else None
    hands = sample.candidates.T_cloud_hand[scored]
    _, hidden = _touched_first(scene, hands, gripper)
    return UngraspableReason.HIDDEN if hidden.mean() > 0.5 else None


def _upright_box(scene: Scene, held: Bools) -> tuple[Float32, Float32, float]:
    """The smallest upright box around points: its pose T_cloud_box (4, 4) and half extents (3,).

    The last value is the points' least width as seen from above, metres.
    """
    points = scene.cloud.points[held].astype(np.float64)
    plan = points[:, :2]
    corners = plan[np.lexsort(plan.T)[[0, -1]]]  # the ends if all lie on a line
    with suppress(QhullError, ValueError):  # too few points, or all on a line
        corners = plan[ConvexHull(plan).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    edges = edges[np.linalg.norm(edges, axis=1) > 0]
    edges = np.concatenate([edges, [[1.0, 0.0]]])
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    # The smallest rectangle around points has a side along an edge of their convex hull.
    axes = np.stack([edges, np.stack([-edges[:, 1], edges[:, 0]], axis=1)], axis=1)  # (K, 2, 2)
    turned = np.einsum("kad,cd->kca", axes, corners)
    size = np.ptp(turned, axis=1)
    best = int(size.prod(axis=1).argmin())
    bottom, top = points[:, 2].min(), points[:, 2].max()
    T_canonical_box = np.eye(4)
    T_canonical_box[:2, :2] = axes[best].T
    middle = axes[best].T @ (turned[best].min(axis=0) + size[best] / 2)
    T_canonical_box[:3, 3] = [*middle, (bottom + top) / 2]
    half: Float32 = np.array([*size[best], top - bottom], dtype=np.float32) / np.float32(2)
    return scene.frame.poses_to_cloud(T_canonical_box), half, float(size.min())


def debug_info(
    scene: Scene,
    sample: Sample | None,  # all candidates and which of them (E) were scored; None: none
    score: Floats,  # (E,) probabilities
    outcome: NDArray[np.int8],  # (E,) codes of their outcomes
    labels: Int64,  # (R,) of the rows of the cloud as sent
) -> DebugInfo:
    """The processed cloud and every candidate of a request."""
    candidates = Candidates.none() if sample is None else sample.drawn
    codes = outcome[:0] if sample is None else sample.outcome.copy()
    scores = np.full(len(candidates), np.nan, dtype=np.float32)
    if sample is not None and len(outcome):
        scores[sample.row], codes[sample.row] = score, outcome
    plane = None
    if scene.support is not None:
        normal = scene.frame.directions_to_cloud(scene.support.normal)
        foot = scene.frame.points_to_cloud(np.multiply(scene.support.normal, scene.support.offset))
        plane = np.append(normal, normal @ foot).astype(np.float32)
    return DebugInfo(
        points=scene.points_in_cloud,
        normals=scene.frame.directions_to_cloud(scene.cloud.normals),
        approach_index=candidates.approach_index,
        contact_index=candidates.contact_index,
        T_cloud_hand=scene.frame.poses_to_cloud(candidates.T_cloud_hand),
        score=scores,
        outcome=[OUTCOMES[code] for code in codes.tolist()],
        support_plane=plane,
        labels=labels,
    )
