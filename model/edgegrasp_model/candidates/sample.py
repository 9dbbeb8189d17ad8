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
from edgegrasp_model.hand_kernels import distinct_hands
from edgegrasp_model.hand_view import HandView, hand_views, reach_of
from edgegrasp_model.options import ApproachDirection, DetectOptions
from edgegrasp_model.results import Outcome
from edgegrasp_model.scene.cloud import UP
from edgegrasp_model.scene.scene import Scene

Int64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

SAMPLING_ATTEMPTS = 4  # further approach points are tried where few hands are free
FEW = 16  # hands free of collision
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
class Attempt:
    """Every candidate around one set of approach points, and what became of it so far."""

    candidates: Candidates  # E of them
    outcome: NDArray[np.int8]  # (E,) CODE of its Outcome; RETURNED: still in


@dataclass(frozen=True)
class Sample:
    """The candidates to score, around one set of approach points; canonical frame."""

    approach_index: Int64  # (A,) rows of the cloud
    crop: BallCrop
    candidates: Candidates  # E of them; `pair` is their contact's row in `crop`
    view: HandView  # of the same candidates
    collision_free: Bools  # (E,)
    attempts: list[Attempt]  # the last of which holds these candidates
    row: Int64  # (E,) their rows in it


class _Tried(NamedTuple):
    approach_index: Int64  # (A,)
    crop: BallCrop
    attempt: Attempt
    row: Int64  # (C,) of its candidates, those that were checked for collision
    free: Bools  # (C,) which of those do not collide


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
    mode, limit = options.collision.mode, OVERSAMPLING * options.num_candidates
    tried: list[_Tried] = []
    while len(tried) < SAMPLING_ATTEMPTS:
        approach_index = approach_points(scene, approach_rows, options, rng_approach)
        crop = crop_balls(scene.cloud.points, approach_index, crop_radius)
        attempt = _constrained(
            scene, approach_index, crop, options, gripper, counts, centre, leaning=bool(tried)
        )
        row, free = _checked(attempt, scene, options, gripper, limit, counts, rng)
        tried.append(_Tried(approach_index, crop, attempt, row, free))
        found = len(row) if mode == "ignore" else int(free.sum())
        # A further attempt would draw the same approach points and candidates.
        exhausted = len(approach_rows) <= len(approach_index) and len(row) < limit
        if found >= FEW or (len(tried) > 1 and (found or exhausted)):
            break
    tried.sort(key=lambda one: int(one.free.sum()))
    approach_index, crop, attempt, row, free = tried[-1]
    candidates = attempt.candidates.take(row)
    new = free | (mode != "avoid")
    T_cloud_tcp = candidates.T_cloud_hand[new] @ gripper.T_hand_tcp
    new[new] = distinct_hands(T_cloud_tcp, free[new], *alike(options))
    scored = rows_to_score(free, new, options, rng)
    attempt.outcome[row[scored]] = CODE[Outcome.RETURNED]
    counts["scored"] = len(scored)
    candidates = candidates.take(scored)
    return Sample(
        approach_index,
        crop,
        candidates,
        hand_views(scene.cloud, candidates.T_cloud_hand, reach_of(gripper)),
        free[scored],
        [one.attempt for one in tried],
        row[scored],
    )


def _checked(
    attempt: Attempt,
    scene: Scene,
    options: DetectOptions,
    gripper: Gripper,
    limit: int,
    counts: dict[str, int],
    rng: np.random.Generator,
) -> tuple[Int64, Bools]:
    """At most `limit` of an attempt's candidates (C,), and which of them (C,) do not collide."""
    passed = np.flatnonzero(attempt.outcome == CODE[Outcome.RETURNED])
    row = passed[random_rows(len(passed), limit, rng)]
    attempt.outcome[passed] = CODE[Outcome.NOT_CHECKED]
    T_cloud_hand = attempt.candidates.T_cloud_hand[row]
    free = ~collides(scene, T_cloud_hand, gripper, options.collision)
    attempt.outcome[row] = CODE[Outcome.NOT_SCORED]
    if options.collision.mode != "ignore":
        attempt.outcome[row[~free]] = CODE[Outcome.COLLISION]
    add_count(counts, "checked", len(row))
    add_count(counts, "collision_free", int(free.sum()))
    return row, free


def approach_points(
    scene: Scene, rows: Int64, options: DetectOptions, rng: np.random.Generator
) -> Int64:
    """Approach points spread over the objects: small ones get some, large ones more.

    Args:
        scene: Its cloud, and the object of each point.
        rows: (R,) points that may be chosen.
        options: How many, and how they are sampled.
        rng: Source of the random choice.

    Returns:
        Rows of the cloud.
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
    chosen = []
    for which, count in zip(objects[wanted > 0], wanted[wanted > 0], strict=True):
        mine = rows[number == which]
        points = scene.cloud.points[mine]
        chosen.append(mine[sample_approach_points(points, count, options.sampling, rng)])
    return np.concatenate(chosen)


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
) -> Attempt:
    """The edge grasps of some balls, and which satisfy every constraint but collision avoidance."""
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
    return Attempt(candidates, outcome)


def alike(options: DetectOptions) -> tuple[float, float]:
    """Metres and radians within which suppression drops the other of two hands, whatever it is."""
    rule = options.suppression
    return (0.0, 0.0) if rule is None else (min(NEAR, rule.translation), min(TURNED, rule.rotation))


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
