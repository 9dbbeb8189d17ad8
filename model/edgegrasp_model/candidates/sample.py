"""From a scene to the candidates that the network scores."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgegrasp_model.candidates.collision import collides
from edgegrasp_model.candidates.edge_grasps import (
    BallCrop,
    Candidates,
    centred_grasps,
    crop_balls,
    edge_grasps,
    retract,
    sample_approach_points,
)
from edgegrasp_model.candidates.outline import outline_grasps, outlines
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_kernels import non_max_suppression
from edgegrasp_model.hand_view import HandView, hand_views, reach_of
from edgegrasp_model.options import ApproachDirection, DetectOptions
from edgegrasp_model.results import Outcome
from edgegrasp_model.scene.cloud import UP
from edgegrasp_model.scene.scene import Scene

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

FURTHER_ATTEMPTS = 3  # with other approach points, where few hands are free
FEW = 16  # hands free of collision, of a scene
ENOUGH = 150  # different ones of a scene's objects together, with half of the approach points
POINTS_PER_APPROACH = 40  # voxels of an object for one approach point: some 8 square centimetres
APPROACH_POINTS_EACH = 8, 64  # of an object
MIN_APPROACH_POINTS, MAX_APPROACH_POINTS = 32, 64  # of a scene
FEWEST_EACH = 4  # of an object, however many there are
OVERSAMPLING = 2  # hands checked for collision, in multiples of num_candidates
NEAR, TURNED = 0.004, math.radians(10)  # TCPs and turns of hands that one score stands for
CODE = {outcome: np.int8(code) for code, outcome in enumerate(Outcome)}
TOP_DOWN_ANGLE = math.radians(30)  # between the hand's direction and straight down
SIDE_ANGLE = math.radians(30)  # between the hand's direction and the horizontal
MIN_APPROACH_UP = -0.1  # where nothing is asked for: cosine of the outward approach and up


APPROACH_STREAM, CANDIDATE_STREAM = 0, 1  # random streams of one request


@dataclass(frozen=True)
class Sample:
    """The candidates to score; canonical frame."""

    approach_index: Int64  # (A,) rows of the cloud
    crop: BallCrop
    candidates: Candidates  # E of them; `pair` is their contact's row in `crop`
    view: HandView  # of the same candidates
    collision_free: Bools  # (E,)
    drawn: Candidates  # all that there were, C of them
    outcome: NDArray[np.int8]  # (C,) CODE of what became of each; RETURNED: it is to be scored
    row: Int64  # (E,) places of the candidates among them


class _Tried(NamedTuple):
    """Every candidate around some approach points, and what became of it so far."""

    approach_index: Int64  # (A,)
    crop: BallCrop
    candidates: Candidates  # C of them
    outcome: NDArray[np.int8]  # (C,) CODE of its Outcome; RETURNED: still in
    row: Int64  # (K,) of those that were checked for collision
    free: Bools  # (K,) which of those do not collide

    def and_further(self, other: "_Tried") -> "_Tried":
        """This and what was tried after it."""
        further = replace(other.candidates, pair=other.candidates.pair + len(self.crop.ball_rows))
        ball = other.crop.ball_of_point + len(self.approach_index)
        return _Tried(
            np.concatenate([self.approach_index, other.approach_index]),
            BallCrop(
                np.concatenate([self.crop.ball_rows, other.crop.ball_rows]),
                np.concatenate([self.crop.ball_of_point, ball]),
                self.crop.radius,
            ),
            Candidates.concatenate([self.candidates, further]),
            np.concatenate([self.outcome, other.outcome]),
            np.concatenate([self.row, other.row + len(self.candidates)]),
            np.concatenate([self.free, other.free]),
        )


def sample_candidates(
    scene: Scene,
    options: DetectOptions,
    gripper: Gripper,
    crop_radius: float,
    counts: dict[str, int],
    centre: bool = False,
) -> Sample:
    """Sample approach points and the candidates around them, collision-free where possible.

    Args:
        scene: With at least one point in the approach region.
        options: Sampling, constraints and seed.
        gripper: What has to fit.
        crop_radius: Radius of the balls, metres.
        counts: Gets the number of candidates left after each constraint, over all attempts.
        centre: Whether there are centred hands among them: for networks that see where a hand is.

    Returns:
        At most num_candidates candidates. With `collision: avoid` none of them collides.
    """
    rng_approach = np.random.default_rng([options.seed, APPROACH_STREAM])
    rng = np.random.default_rng([options.seed, CANDIDATE_STREAM])
    approach_rows = np.flatnonzero(scene.approach_allowed)

    def look_around(approach_index: Int64, *, leaning: bool = False) -> _Tried:
        crop = crop_balls(scene.cloud.points, approach_index, crop_radius)
        candidates, outcome = _constrained(
            scene, approach_index, crop, options, gripper, counts, centre, leaning=leaning
        )
        row, free = _checked(candidates, outcome, scene, options, gripper, counts, rng)
        return _Tried(approach_index, crop, candidates, outcome, row, free)

    first, second = approach_points(scene, approach_rows, options, rng_approach)
    tried = look_around(first)
    second = second[_has_few_hands(scene, second, tried, gripper, options)]
    if len(second):
        tried = tried.and_further(look_around(second))
    for attempt in range(FURTHER_ATTEMPTS):
        found = len(_usable(tried, options))
        if found >= FEW or (attempt and found):
            break
        further = np.concatenate(approach_points(scene, approach_rows, options, rng_approach))
        if attempt and len(approach_rows) <= len(further):  # they would be the same ones
            break
        tried = tried.and_further(look_around(further, leaning=True))
    candidates = tried.candidates.take(tried.row)
    new = tried.free | (options.collision.mode != "avoid")
    new[new] = different(candidates.T_cloud_hand[new], tried.free[new], gripper, options)
    scored = rows_to_score(tried.free, new, options, rng)
    tried.outcome[tried.row[scored]] = CODE[Outcome.RETURNED]
    counts["scored"] = len(scored)
    candidates = candidates.take(scored)
    return Sample(
        tried.approach_index,
        tried.crop,
        candidates,
        hand_views(scene.cloud, candidates.T_cloud_hand, reach_of(gripper)),
        tried.free[scored],
        tried.candidates,
        tried.outcome,
        tried.row[scored],
    )


def _usable(tried: _Tried, options: DetectOptions) -> Int64:
    """Rows of the candidates that may be scored as they are."""
    return tried.row if options.collision.mode == "ignore" else tried.row[tried.free]


def _has_few_hands(
    scene: Scene, approach_index: Int64, tried: _Tried, gripper: Gripper, options: DetectOptions
) -> Bools:
    """Which further approach points (A,) are on objects at which few different hands were found."""
    hands = tried.candidates.take(_usable(tried, options))
    new = different(hands.T_cloud_hand, np.ones(len(hands), dtype=bool), gripper, options)
    number = scene.object_of_point[approach_index]
    each = max(FEW, ENOUGH // max(len(np.unique(number)), 1))
    of_hands = scene.object_of_point[hands.approach_index[new]]
    objects, count = np.unique(of_hands, return_counts=True)
    return np.isin(number, objects[count >= each], invert=True)


def _checked(
    candidates: Candidates,
    outcome: NDArray[np.int8],
    scene: Scene,
    options: DetectOptions,
    gripper: Gripper,
    counts: dict[str, int],
    rng: np.random.Generator,
) -> tuple[Int64, Bools]:
    """Some candidates that are still in (K,), and which of them (K,) do not collide."""
    passed = np.flatnonzero(outcome == CODE[Outcome.RETURNED])
    row = passed[random_rows(len(passed), OVERSAMPLING * options.num_candidates, rng)]
    outcome[passed] = CODE[Outcome.NOT_CHECKED]
    free = ~collides(scene, candidates.T_cloud_hand[row], gripper, options.collision)
    outcome[row] = CODE[Outcome.NOT_SCORED]
    if options.collision.mode != "ignore":
        outcome[row[~free]] = CODE[Outcome.COLLISION]
    add_count(counts, "checked", len(row))
    add_count(counts, "collision_free", int(free.sum()))
    return row, free


def approach_points(
    scene: Scene, rows: Int64, options: DetectOptions, rng: np.random.Generator
) -> tuple[Int64, Int64]:
    """Approach points spread over the objects: small ones get some, large ones more.

    Args:
        scene: Its cloud, and the object of each point.
        rows: (R,) points that may be chosen.
        options: How many, and how they are sampled.
        rng: Source of the random choice.

    Returns:
        Rows of the cloud: the first half of each object's, which often are enough, and the others.
        Where the request says how many, all come first.
    """
    number = scene.object_of_point[rows]
    objects, size = np.unique(number, return_counts=True)
    most = options.num_approach_points
    if most is None and len(objects) <= MAX_APPROACH_POINTS:
        wanted = np.clip(size // POINTS_PER_APPROACH, *APPROACH_POINTS_EACH)
        wanted = np.maximum(wanted, MIN_APPROACH_POINTS // len(objects))
        wanted = np.floor(wanted * min(MAX_APPROACH_POINTS / wanted.sum(), 1.0)).astype(np.int64)
        wanted = np.maximum(wanted, FEWEST_EACH)
    else:  # the largest objects first where there are fewer approach points than objects
        most = most or MAX_APPROACH_POINTS
        share = np.sqrt(size) / np.sqrt(size).sum() * most
        wanted = np.floor(share).astype(np.int64)
        rest = most - wanted.sum()
        wanted[np.argsort(wanted - share, kind="stable")[:rest]] += 1
    first, second = [rows[:0]], [rows[:0]]
    for which, count in zip(objects[wanted > 0], wanted[wanted > 0], strict=True):
        mine = rows[number == which]
        points = scene.cloud.points[mine]
        chosen = mine[sample_approach_points(points, count, options.sampling, rng)]
        half = len(chosen) if options.num_approach_points else (len(chosen) + 1) // 2
        first.append(chosen[:half])
        second.append(chosen[half:])
    return np.concatenate(first), np.concatenate(second)


def _constrained(
    scene: Scene,
    approach_index: Int64,
    crop: BallCrop,
    options: DetectOptions,
    gripper: Gripper,
    counts: dict[str, int],
    centre: bool,
    *,
    leaning: bool,
) -> tuple[Candidates, NDArray[np.int8]]:
    """The edge grasps of some balls; RETURNED: they satisfy all constraints but collision's."""
    add_count(counts, "approach_points", len(approach_index))
    add_count(counts, "pairs", len(crop.ball_rows))
    pair = np.flatnonzero(scene.contact_allowed[crop.ball_rows])
    add_count(counts, "in_contact_region", len(pair))
    pairs = approach_index[crop.ball_of_point[pair]], crop.ball_rows[pair]
    candidates = edge_grasps(scene.cloud, *pairs, gripper)
    candidates = replace(candidates, pair=pair[candidates.pair])
    if centre:
        centred = centred_grasps(scene.cloud.points, crop, candidates, gripper)
        candidates = Candidates.concatenate([candidates, centred])
    points, margin = scene.cloud.points, options.collision.margin
    is_contact = np.zeros(len(points), dtype=bool)
    is_contact[pairs[1]] = True
    across = [
        outline_grasps(points, crop, approach_index, pair, each, scene.support, gripper, margin)
        for each in outlines(points, scene.viewpoint, np.flatnonzero(is_contact), leaning=leaning)
    ]
    candidates = Candidates.concatenate([candidates, *across])
    add_count(counts, "candidates", len(candidates))
    outcome = np.full(len(candidates), CODE[Outcome.RETURNED])
    if scene.support is not None:
        candidates, clear = retract(candidates, scene.support, gripper, margin)
        outcome[~clear] = CODE[Outcome.SUPPORT]
    direction = -candidates.approach
    allowed = allowed_directions(direction, options.approach_direction, UP, scene.frame.directions)
    outcome[~allowed] = CODE[Outcome.DIRECTION]
    add_count(counts, "in_direction", int(allowed.sum()))
    add_count(counts, "clear_of_support", int((outcome == CODE[Outcome.RETURNED]).sum()))
    return candidates, outcome


def different(
    T_cloud_hand: Float32, first: Bools, gripper: Gripper, options: DetectOptions
) -> Bools:
    """Hands (E,) none of which suppression drops for another, whatever it is; `first` go before."""
    rule = options.suppression
    near = 0.0 if rule is None else min(NEAR, rule.translation)
    turned = 0.0 if rule is None else min(TURNED, rule.rotation)
    kept, T_cloud_tcp = np.zeros(len(first), dtype=bool), T_cloud_hand @ gripper.T_hand_tcp
    order = np.argsort(~first, kind="stable")
    kept[non_max_suppression(T_cloud_tcp, order, near, turned, len(order))[0]] = True
    return kept


def rows_to_score(
    free: Bools, new: Bools, options: DetectOptions, rng: np.random.Generator
) -> Int64:
    """Ascending rows of at most num_candidates new candidates, those free of collision first."""
    if options.collision.mode == "ignore":
        rows = np.flatnonzero(new)
        return rows[random_rows(len(rows), options.num_candidates, rng)]
    clear, hit = np.flatnonzero(free & new), np.flatnonzero(~free & new)
    rows = clear[random_rows(len(clear), options.num_candidates, rng)]
    if options.collision.mode == "penalise":
        rest = random_rows(len(hit), options.num_candidates - len(rows), rng)
        rows = np.sort(np.concatenate([rows, hit[rest]]))
    return rows


def random_rows(size: int, limit: int, rng: np.random.Generator) -> Int64:
    """Ascending rows of at most `limit` out of `size`."""
    if size <= limit:
        return np.arange(size, dtype=np.int64)
    return np.sort(rng.choice(size, limit, replace=False)).astype(np.int64)


def add_count(counts: dict[str, int], name: str, number: int) -> None:
    """Add to a count, which is 0 where it is not there yet."""
    counts[name] = counts.get(name, 0) + number


def allowed_directions(
    direction: NDArray[np.floating],
    constraint: ApproachDirection | None,
    up: ArrayLike,
    in_frame: Callable[[ArrayLike], NDArray[np.floating]] = np.asarray,
) -> NDArray[np.bool_]:
    """Which directions the hand may move in.

    Args:
        direction: (E, 3) unit, the directions in which hands move; their +z.
        constraint: What was asked for.
        up: (3,) unit, in the frame of `direction`.
        in_frame: Maps the constraint's directions to the frame of `direction`.

    Returns:
        (E,)
    """
    rise = direction @ np.asarray(up)
    if constraint is None:
        return np.asarray(-rise > MIN_APPROACH_UP)
    allowed = np.zeros(len(direction), dtype=bool)
    for cone in constraint.cones:
        axis = in_frame(cone.direction)
        allowed |= direction @ (axis / np.linalg.norm(axis)) >= math.cos(cone.max_angle)
    if constraint.preset == "top-down":
        allowed |= -rise >= math.cos(TOP_DOWN_ANGLE)
    if constraint.preset == "side":
        allowed |= np.abs(rise) <= math.sin(SIDE_ANGLE)
    return allowed
