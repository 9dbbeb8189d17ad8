"""Training examples: the balls or hands of a view, with labels, packed as input of networks.

Labels are the outcomes of tried grasps, and the scores of a teacher.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from edgegrasp_camera.arrays import Float32, Int64
from edgegrasp_model.candidates.edge_grasps import (
    Candidates,
    crop_balls,
    edge_grasps,
    outline_grasps,
    outlines,
    retract,
)
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import load_checkpoint
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.networks.hand import HEIGHT_NUMBERS, UNKNOWN_HEIGHT, HandBatch
from edgegrasp_model.scene.cloud import CanonicalFrame, Cloud
from edgegrasp_model.scene.scene import Surroundings
from edgegrasp_training.recipes import LENGTH_UNIT
from edgegrasp_training.views import UNTRIED, UP, LabelledView, load_view

SPARE_POINTS = 2  # factor of points kept per hand, from which each step draws
TRIED_WEIGHT = 4.0  # weight of a simulated label in the loss; a teacher's score has weight 1
SHAKEN_SHARE = 0.2  # part of a successful grasp's label that depends on surviving shaking
FIRM_SHARE = 0.78  # share of successful grasps that survive shaking; used if shaking was not tried
TAUGHT_BALLS = 24  # balls of a view in which a teacher scores candidates
OWN_BALLS = 16  # maximum number of these balls around approach points of tried grasps
GRASPS_PER_BALL = 64  # scored at most; about a third of a ball's candidates


@dataclass(frozen=True)
class TriedGrasps:
    """The labelled edge grasps of one view, ready to be packed ball by ball."""

    cloud: Cloud
    candidates: Candidates  # E of them
    # Input of a hand network, float16 to keep many views in memory; None for ball networks.
    hand_batch: HandBatch | None
    label: Float32  # (E,) 0: not held; 1: held, less if it did not survive shaking
    R_canonical_world: Float32  # (3, 3) rotation of the cloud's axes to the detector's frame

    def without_support(self) -> "TriedGrasps":
        """The same grasps, described as for a request without a support plane."""
        if self.hand_batch is None:
            return self
        unknown = self.hand_batch.description.clone()
        unknown[:, HEIGHT_NUMBERS] = UNKNOWN_HEIGHT
        return replace(self, hand_batch=replace(self.hand_batch, description=unknown))

    def balls(self) -> Int64:
        """Approach points of the labelled candidates: ascending rows of the cloud."""
        return np.unique(self.candidates.approach_index)


class SoftLabels(NamedTuple):
    """Candidates of a view with a teacher's scores, in 16 bits, to keep many views in memory."""

    candidates: Candidates  # E of them
    chance: NDArray[np.float16]  # (E,) probability that it holds, by the teacher


class Batch(NamedTuple):
    """One step's input of a network, and its targets."""

    batch: BallBatch | HandBatch
    label: Tensor  # (E,) float32 target: above 1/2 if it held, or if the teacher's score is
    weight: Tensor  # (E,) float32, in the loss


def tried_grasps(
    view: LabelledView, config: NetworkConfig, viewpoint_known: bool = True
) -> TriedGrasps:
    """Build the tried candidates of a view, with the inputs of a hand network."""
    rows = view.tried()
    cloud = Cloud(view.points, view.normals)
    candidates = _candidates(view, cloud, rows)
    # The label of a successful grasp is a little higher if it survived shaking.
    shaken = UNTRIED if view.firm is None else view.firm
    firm = np.where(shaken == UNTRIED, FIRM_SHARE, shaken == 1)
    labels = np.asarray((view.success == 1) * (1.0 - SHAKEN_SHARE * (1.0 - firm)), np.float32)
    seen = None
    if config.architecture == "hand":
        viewpoints = view.camera_position[None] if viewpoint_known else np.empty((0, 3), np.float32)
        batch = hand_batch(view, candidates, viewpoints, SPARE_POINTS * config.hand_points)
        seen = replace(batch, description=batch.description.half(), points=batch.points.half())
    frame = CanonicalFrame.from_scene(view.points, view.up, view.camera_position)
    turn = frame.directions_from_cloud(np.eye(3)).T.astype(np.float32)
    return TriedGrasps(cloud, candidates, seen, labels[rows[candidates.pair]], turn)


def hand_batch(
    view: LabelledView,  # the observed scene
    candidates: Candidates,  # E hands to try
    viewpoints: Float32,  # (W, 3) camera positions, metres; none if they are unknown
    max_points: int,  # maximum number of points of each hand
) -> HandBatch:
    """The hand network's inputs for candidates in a simulated scene."""
    known = view.support_plane, viewpoints, view.cut_off(), view.numbered_objects()
    around = Surroundings(Cloud(view.points, view.normals), view.up, *known)
    return HandBatch.from_hands(around, candidates, view.hand, max_points)


class Teacher:
    """A hand network that scores the candidates of views."""

    def __init__(self, weights: Path, crop_radius: float) -> None:
        """Load a `hand` checkpoint; candidates are drawn from balls of `crop_radius` metres."""
        self.network, self.metadata = load_checkpoint(weights)
        if (found := self.metadata.network.architecture) != "hand":
            raise ValueError(f"teacher: got a network of architecture {found!r}. Use a `hand` one.")
        self.crop_radius = crop_radius

    def soft_labels(self, path: Path) -> SoftLabels:
        """Score candidates around some of a view's points, chosen by the file's contents."""
        view, rng = load_view(path), np.random.default_rng(zlib.crc32(path.read_bytes()))
        own = np.unique(view.approach_index[view.tried()])
        others = np.setdiff1d(np.flatnonzero(view.numbered_objects() >= 0), own)
        own = rng.permutation(own)[:OWN_BALLS]
        balls = np.sort(np.concatenate([own, rng.permutation(others)[: TAUGHT_BALLS - len(own)]]))
        candidates = self._candidates(view, balls, rng) if len(balls) else Candidates.none()
        chance = np.empty(0)
        if len(candidates):
            max_points = self.metadata.network.hand_points
            hands = hand_batch(view, candidates, view.camera_position[None], max_points)
            with torch.inference_mode():
                chance = torch.sigmoid(self.network(hands) / self.metadata.temperature).numpy()
        short = (
            array.astype(np.uint16 if array.dtype.kind == "i" else np.float16)
            for array in vars(candidates).values()
        )
        return SoftLabels(Candidates(*short), chance.astype(np.float16))

    def _candidates(self, view: LabelledView, balls: Int64, rng: np.random.Generator) -> Candidates:
        """At most GRASPS_PER_BALL candidates in each ball (A,), made like the detector's."""
        cloud, support = Cloud(view.points, view.normals), view.support_plane
        crop = crop_balls(cloud.points, balls, self.crop_radius)
        pairs = balls[crop.ball_of_point], crop.ball_rows
        every = np.arange(len(crop.ball_rows))
        sides = outlines(cloud.points, view.camera_position[None], np.unique(crop.ball_rows))
        across = [
            outline_grasps(cloud.points, crop, balls, every, seen, support, view.hand)
            for seen in sides
        ]
        both = Candidates.concatenate([edge_grasps(cloud, *pairs, view.hand)[0], *across])
        if support is not None:
            both, clear = retract(both, support, view.hand)
            both = both.take(np.flatnonzero(clear))
        both = both.take(rng.permutation(len(both)))
        rows = [np.flatnonzero(both.approach_index == ball)[:GRASPS_PER_BALL] for ball in balls]
        return both.take(np.concatenate(rows))


def pack_balls(
    grasps: TriedGrasps, balls: Int64, config: NetworkConfig, soft_labels: SoftLabels | None = None
) -> Batch:
    """Pack candidates in balls, rows (A,) of a view, in the detector's axes and LENGTH_UNITs."""
    candidates, label = grasps.candidates, grasps.label
    weight = np.ones(len(label), dtype=np.float32)
    if soft_labels is not None:
        candidates = Candidates.concatenate([candidates, soft_labels.candidates])
        weight = np.append(TRIED_WEIGHT * weight, np.ones_like(soft_labels.chance))
        label = np.append(label, soft_labels.chance)
    points = grasps.cloud.points.astype(np.float64)
    edge = points[candidates.contact_index] - points[candidates.approach_index]
    inside = np.square(edge).sum(axis=1) <= config.crop_radius**2
    kept = inside & np.isin(candidates.approach_index, balls)
    some = candidates.take(kept)
    batch = BallBatch.from_candidates(grasps.cloud, some, config.crop_radius, config.k)
    batch = replace(batch, points=batch.points / LENGTH_UNIT, depth=batch.depth / LENGTH_UNIT)
    targets = torch.from_numpy(label[kept]), torch.from_numpy(weight[kept])
    return Batch(turned(batch, grasps.R_canonical_world), *targets)


def joined(batches: Sequence[BallBatch | HandBatch]) -> BallBatch | HandBatch:
    """Batches of one kind as one batch; scores keep the order."""
    columns = {name: [vars(batch)[name] for batch in batches] for name in vars(batches[0])}
    if balls := [batch for batch in batches if isinstance(batch, BallBatch)]:
        points = np.cumsum([0, *(len(batch.points) for batch in balls)]).tolist()
        first = np.cumsum([0, *(batch.num_balls for batch in balls)]).tolist()
        for name, begins in (("neighbors", points), ("contact", points), ("ball_of_point", first)):
            columns[name] = [rows + at for rows, at in zip(columns[name], begins, strict=False)]
    return type(batches[0])(*map(torch.cat, columns.values()))


def pack_hands(
    grasps: TriedGrasps, balls: Int64, config: NetworkConfig, rng: np.random.Generator | None = None
) -> Batch:
    """Pack the hand network's inputs in balls, rows (A,) of the cloud."""
    seen = grasps.hand_batch
    assert seen is not None
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, balls))
    points, count = seen.points.numpy()[rows], seen.point_count.numpy()[rows]
    limit, slot = config.hand_points, np.arange(seen.points.shape[1])
    if rng is None:
        order = slot * np.maximum(count[:, None], limit) // limit  # (E, P)
    else:
        there = slot < count[:, None]
        order = np.argsort(np.where(there, rng.random(there.shape, dtype=np.float32), 2.0), axis=1)
    chosen = np.take_along_axis(points, order[:, :limit, None], axis=1)
    batch = HandBatch(
        seen.description[torch.from_numpy(rows)].float(),
        torch.from_numpy(chosen.astype(np.float32)),
        torch.from_numpy(np.minimum(count, limit)),
    )
    return Batch(batch, torch.from_numpy(grasps.label[rows]), torch.ones(len(rows)))


def turned(batch: BallBatch, turn: Float32) -> BallBatch:
    """Rotate all balls of a batch by one rotation (3, 3)."""
    transposed = torch.from_numpy(turn.T.copy())
    vectors = ("points", "normals", "approach")
    return replace(batch, **{name: getattr(batch, name) @ transposed for name in vectors})


def random_turn(rng: np.random.Generator, *, upright: bool) -> Float32:
    """A random rotation (3, 3) of balls: any (paper, section IV-D), or about up."""
    if upright:
        turn = Rotation.from_rotvec(rng.uniform(0.0, 2 * np.pi) * UP)
    else:
        turn = Rotation.random(rng=rng)
    return turn.as_matrix().astype(np.float32)


def _candidates(view: LabelledView, cloud: Cloud, rows: Int64) -> Candidates:
    """The tried candidates; `pair` is an index into `rows`."""
    approach_index, contact_index = view.approach_index[rows], view.contact_index[rows]
    if view.T_world_hand is None:
        return edge_grasps(cloud, approach_index, contact_index, view.hand)[0]
    pose = view.T_world_hand[rows]
    edge = view.points[contact_index] - view.points[approach_index]  # (E, 3)
    depth = np.maximum(np.einsum("ed,ed->e", edge, pose[:, :3, 2]), 0.0)
    outward = view.points[contact_index] - pose[:, :3, 3]
    opening = 2 * np.abs(np.einsum("ed,ed->e", outward, pose[:, :3, 1]))
    pair = np.arange(len(rows), dtype=np.int64)
    return Candidates(pair, approach_index, contact_index, depth, opening, pose)
