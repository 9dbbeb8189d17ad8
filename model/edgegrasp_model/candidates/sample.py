"""From a scene to the candidates that the network scores."""

import math
from collections import defaultdict
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from edgegrasp_camera.arrays import Bools, Float32, Floats, Int64
from edgegrasp_model.candidates.collision import collides
from edgegrasp_model.candidates.edge_grasps import (
    Candidates,
    centred_grasps,
    coarse_to_fine_sample,
    crop_balls,
    edge_grasps,
    outline_grasps,
    outlines,
    retract,
)
from edgegrasp_model.gripper import HALF_TURN, Gripper
from edgegrasp_model.kernels import non_max_suppression
from edgegrasp_model.options import (
    APPROACH_STREAM,
    CANDIDATE_STREAM,
    ApproachDirection,
    DetectOptions,
)
from edgegrasp_model.results import Outcome
from edgegrasp_model.scene.cloud import UP, CanonicalFrame
from edgegrasp_model.scene.scene import Scene

POINTS_PER_APPROACH = 40  # voxels of an object for one approach point: some 8 square centimetres
MAX_APPROACH_POINTS = 64  # per view, for up to four views; at least half of them are used
MIN_PER_OBJECT = 4  # for each object, or twice as many where there are few objects
OUTCOME_CODE = {outcome: np.int8(code) for code, outcome in enumerate(Outcome)}


@dataclass(frozen=True)
class Sample:
    """Candidates to score, around some approach points; canonical frame."""

    candidates: Candidates  # E of them
    collision_free: Bools  # (E,)
    turned: Bools  # (E,) collision-free only if turned by 180 degrees about z after scoring
    drawn: Candidates  # all C of them
    outcome: NDArray[np.int8]  # (C,) each one's OUTCOME_CODE; RETURNED: it is to be scored
    row: Int64  # (E,) rows of `candidates` in `drawn`
    logits: Float32 = field(default_factory=lambda: np.empty(0, np.float32))  # (E,) once scored

    def followed_by(self, other: "Sample") -> "Sample":
        """This sample joined with a later one."""
        return Sample(
            Candidates.concatenate([self.candidates, other.candidates]),
            np.concatenate([self.collision_free, other.collision_free]),
            np.concatenate([self.turned, other.turned]),
            Candidates.concatenate([self.drawn, other.drawn]),
            np.concatenate([self.outcome, other.outcome]),
            np.concatenate([self.row, other.row + len(self.drawn)]),
            np.concatenate([self.logits, other.logits]),
        )

    def scored(self, logits: Float32) -> "Sample":
        """This sample with its logits (E,); the network saw the hands before they are turned."""
        pose = self.candidates.T_cloud_hand
        pose = np.where(self.turned[:, None, None], pose * HALF_TURN, pose)
        return replace(self, candidates=replace(self.candidates, T_cloud_hand=pose), logits=logits)


class Sampler:
    """Draws candidates in rounds, collision-free ones if possible, at most `num_candidates`."""

    def __init__(
        self,
        scene: Scene,  # with at least one point in the approach region
        options: DetectOptions,
        gripper: Gripper,
        crop_radius: float,  # of the balls, metres
        counts: defaultdict[str, int],  # gets what each constraint leaves, over all rounds
        sees_hands: bool = False,  # whether the network can score hands that are not edge grasps
    ) -> None:
        """Share the approach points among the objects."""
        self.scene, self.options, self.gripper = scene, options, gripper
        self.crop_radius, self.counts, self.sees_hands = crop_radius, counts, sees_hands
        self._rng_approach = np.random.default_rng([options.seed, APPROACH_STREAM])
        self._rng = np.random.default_rng([options.seed, CANDIDATE_STREAM])
        self._rows = np.flatnonzero(scene.approach_allowed)
        self._objects, size = np.unique(scene.object_of_point[self._rows], return_counts=True)
        most = options.num_approach_points
        if most is None and len(size) <= MAX_APPROACH_POINTS:
            wanted = np.clip(size // POINTS_PER_APPROACH, 2 * MIN_PER_OBJECT, MAX_APPROACH_POINTS)
            wanted = np.maximum(wanted, MAX_APPROACH_POINTS // 2 // len(size))
            wanted = np.floor(wanted * min(MAX_APPROACH_POINTS / wanted.sum(), 1.0))
            views = np.clip(len(scene.viewpoints), 1, 4)
            wanted = np.maximum(wanted.astype(np.int64), MIN_PER_OBJECT) * views
        else:  # the largest objects first where there are fewer approach points than objects
            total = most or MAX_APPROACH_POINTS
            share = np.sqrt(size) / np.sqrt(size).sum() * total
            wanted = np.floor(share).astype(np.int64)
            wanted[np.argsort(wanted - share, kind="stable")[: total - wanted.sum()]] += 1
        self._wanted, self._first = wanted, (wanted + 1) // 2 if most is None else wanted
        self._used, self._round = self._rows[:0], 0

    def sample(
        self,
        done: Int64 | tuple[()] = (),  # (D,) numbers of objects that need no more candidates
        *,
        last_resort: bool = False,  # also hands that hold less often or are scored too high
    ) -> Sample | None:
        """Candidates around further approach points; None if there is no point to add.

        The first round uses half of the points, or all if their number is given; the second uses
        the rest; in each further round an object gets as many as in the first two together.
        """
        open_ = np.where(np.isin(self._objects, done), 0, self._wanted)
        left = (self._wanted - self._first).sum()
        counts = [self._first, open_ * left // max(open_.sum(), 1), open_][min(self._round, 2)]
        more = self._spread(counts)
        self._round += 1
        self._used = np.concatenate([self._used, more])
        if len(more) == 0:
            return None
        options, mode = self.options, self.options.collision.mode
        drawn, outcome = self._constrained(more, last_resort=last_resort)
        passed = np.flatnonzero(outcome == OUTCOME_CODE[Outcome.RETURNED])
        row = random_rows(passed, 4 * options.num_candidates, self._rng)  # many collide
        checked = drawn.take(row)
        hands = checked.T_cloud_hand, checked.opening
        free = ~collides(self.scene, *hands, self.gripper, options.collision)
        turned = np.zeros_like(free)
        if not self.gripper.symmetric:  # with a camera on one side, for example
            hit = checked.take(np.flatnonzero(~free))
            hands = hit.T_cloud_hand * HALF_TURN, hit.opening
            turned[~free] = ~collides(self.scene, *hands, self.gripper, options.collision)
            free |= turned
        outcome[passed] = OUTCOME_CODE[Outcome.NOT_CHECKED]
        outcome[row] = OUTCOME_CODE[Outcome.NOT_SCORED]
        if mode != "ignore":
            outcome[row[~free]] = OUTCOME_CODE[Outcome.COLLISION]
        self.counts["checked"] += len(row)
        self.counts["collision_free"] += int(free.sum())
        new = free | (mode != "avoid")
        new[new] = distinct_hands(checked.T_cloud_hand[new], free[new], self.gripper, options)
        most = options.num_candidates - self.counts["scored"]
        scored = random_rows(np.flatnonzero(new & (free | (mode == "ignore"))), most, self._rng)
        if mode == "penalise":  # then those that collide
            rest = random_rows(np.flatnonzero(new & ~free), most - len(scored), self._rng)
            scored = np.sort(np.concatenate([scored, rest]))
        row, free, turned = row[scored], free[scored], turned[scored]
        outcome[row] = OUTCOME_CODE[Outcome.RETURNED]
        self.counts["scored"] += len(row)
        return Sample(drawn.take(row), free, turned, drawn, outcome, row)

    def all(self) -> Sample:
        """Candidates of two rounds, regardless of their scores."""
        samples = self.sample(), self.sample(last_resort=True)
        return reduce(Sample.followed_by, [one for one in samples if one is not None])

    def _constrained(
        self, approach_index: Int64, *, last_resort: bool
    ) -> tuple[Candidates, NDArray[np.int8]]:
        """Candidates around approach points; RETURNED: all constraints hold except collision.

        A network that sees hands also gets centred grasps and outline grasps, and as a last resort
        tilted outline grasps. A network that sees edges gets outline grasps only as a last resort.
        """
        scene, options, gripper = self.scene, self.options, self.gripper
        points, margin = scene.cloud.points, options.collision.margin
        crop = crop_balls(points, approach_index, self.crop_radius)
        self.counts["approach_points"] += len(approach_index)
        self.counts["pairs"] += len(crop.ball_rows)
        pair = np.flatnonzero(scene.contact_allowed[crop.ball_rows])
        self.counts["in_contact_region"] += len(pair)
        approach, contact = approach_index[crop.ball_of_point[pair]], crop.ball_rows[pair]
        candidates, _ = edge_grasps(scene.cloud, approach, contact, gripper)
        candidates = replace(candidates, pair=pair[candidates.pair])
        if self.sees_hands:
            centred = centred_grasps(points, crop, candidates, gripper)
            candidates = Candidates.concatenate([candidates, centred])
        if self.sees_hands or last_resort:
            contacts = np.flatnonzero(np.bincount(contact))
            leaning = self.sees_hands and last_resort
            seen = outlines(points, scene.viewpoints, contacts, leaning=leaning)
            balls, hand = (crop, approach_index, pair), (scene.support, gripper, margin)
            across = [outline_grasps(points, *balls, outline, *hand) for outline in seen]
            candidates = Candidates.concatenate([candidates, *across])
        self.counts["candidates"] += len(candidates)
        outcome = np.full(len(candidates), OUTCOME_CODE[Outcome.RETURNED])
        if scene.support is not None:
            candidates, clear = retract(candidates, scene.support, gripper, margin)
            outcome[~clear] = OUTCOME_CODE[Outcome.SUPPORT]
        allowed = allowed_directions(-candidates.approach, options.approach_direction, scene.frame)
        outcome[~allowed] = OUTCOME_CODE[Outcome.DIRECTION]
        self.counts["in_direction"] += int(allowed.sum())
        self.counts["clear_of_support"] += int((outcome == OUTCOME_CODE[Outcome.RETURNED]).sum())
        return candidates, outcome

    def _spread(self, counts: Int64) -> Int64:
        """Rows of more approach points in the cloud, `counts` (O,) on each of the objects."""
        number, chosen = self.scene.object_of_point[self._rows], [self._rows[:0]]
        for which, count in zip(self._objects[counts > 0], counts[counts > 0], strict=True):
            mine = self._rows[number == which]
            used = np.isin(mine, self._used)
            if self.options.sampling == "uniform":
                left = mine[~used]
                count = min(count, len(left))
                chosen.append(self._rng_approach.choice(left, count, replace=False))
            else:
                points = self.scene.cloud.points[mine]
                chosen.append(mine[coarse_to_fine_sample(points, count, np.flatnonzero(used))])
        return np.concatenate(chosen)


def distinct_hands(
    T_cloud_hand: Float32, first: Bools, gripper: Gripper, options: DetectOptions
) -> Bools:
    """Hands (E,) that remain after non-maximum suppression without scores; `first` take precedence.

    Only one of the hands within 4 mm and 10 degrees of each other is scored.
    """
    rule = options.suppression
    near = 0.0 if rule is None else min(0.004, rule.translation)
    turned = 0.0 if rule is None else min(math.radians(10), rule.rotation)
    kept, T_cloud_tcp = np.zeros(len(first), dtype=bool), T_cloud_hand @ gripper.T_hand_tcp
    order = np.argsort(~first, kind="stable")
    kept[non_max_suppression(T_cloud_tcp, order, near, turned)[0]] = True
    return kept


def random_rows(rows: Int64, limit: int, rng: np.random.Generator) -> Int64:
    """At most `limit` rows, chosen at random from ascending rows and kept in order."""
    return rows if len(rows) <= limit else np.sort(rng.choice(rows, limit, replace=False))


def allowed_directions(
    direction: Floats,  # (E, 3) unit, the hands' +z, in the frame
    constraint: ApproachDirection | None,
    frame: CanonicalFrame,
) -> Bools:
    """Which directions (E,) a hand may move in."""
    rise = direction @ UP
    if constraint is None:
        return np.asarray(rise < 0.1)  # not from far below the horizontal
    allowed, preset = np.zeros(len(direction), dtype=bool), math.radians(30)
    for cone in constraint.cones:
        axis = frame.directions_from_cloud(cone.direction)
        allowed |= direction @ (axis / np.linalg.norm(axis)) >= math.cos(cone.max_angle)
    if constraint.preset == "top-down":
        allowed |= -rise >= math.cos(preset)
    if constraint.preset == "side":
        allowed |= np.abs(rise) <= math.sin(preset)
    return allowed
