"""A trained network as a teacher, which scores candidates that were not executed in simulation."""

import zlib
from pathlib import Path

import numpy as np
import torch

from edgegrasp_camera.arrays import Int64
from edgegrasp_model.candidates.edge_grasps import Candidates, crop_balls, edge_grasps, retract
from edgegrasp_model.candidates.outline import outline_grasps, outlines
from edgegrasp_model.networks.checkpoint import load_checkpoint
from edgegrasp_model.scene.cloud import Cloud
from edgegrasp_training.examples import SoftLabels, hand_batch
from edgegrasp_training.views import LabelledView, load_view

BALLS = 24  # of a view,
OWN_BALLS = 16  # of them at most around approach points of its tried grasps
GRASPS_PER_BALL = 64  # scored at most; about a third of a ball's candidates


class Teacher:
    """A hand network that scores the candidates of views."""

    def __init__(self, weights: Path, crop_radius: float) -> None:
        """Load a `hand` checkpoint; candidates are drawn from balls of `crop_radius` metres."""
        self.network, self.metadata = load_checkpoint(weights)
        if self.metadata.network.architecture != "hand":
            found = self.metadata.network.architecture
            raise ValueError(f"teacher: got a network of architecture {found!r}. Use a `hand` one.")
        self.crop_radius = crop_radius

    def soft_labels(self, path: Path) -> SoftLabels:
        """The scores of a view's candidates, the same each time for the same file."""
        return self.score(load_view(path), np.random.default_rng(zlib.crc32(path.read_bytes())))

    def score(self, view: LabelledView, rng: np.random.Generator) -> SoftLabels:
        """Score candidates around some of a view's points."""
        own = np.unique(view.approach_index[view.tried()])
        others = np.setdiff1d(np.flatnonzero(view.numbered_objects() >= 0), own)
        own = rng.permutation(own)[:OWN_BALLS]
        balls = np.sort(np.concatenate([own, rng.permutation(others)[: BALLS - len(own)]]))
        candidates = self._candidates(view, balls, rng) if len(balls) else None
        if candidates is None or len(candidates) == 0:
            rows, numbers = np.empty(0, np.uint16), np.empty(0, np.float16)
            return SoftLabels(rows, rows, np.empty((0, 3), np.float16), numbers, numbers)
        max_points = self.metadata.network.hand_points
        hands = hand_batch(view, candidates, view.camera_position[None], max_points)
        with torch.inference_mode():
            chance = torch.sigmoid(self.network(hands) / self.metadata.temperature).numpy()
        return SoftLabels(
            candidates.approach_index.astype(np.uint16),
            candidates.contact_index.astype(np.uint16),
            candidates.approach.astype(np.float16),
            candidates.depth.astype(np.float16),
            chance.astype(np.float16),
        )

    def _candidates(self, view: LabelledView, balls: Int64, rng: np.random.Generator) -> Candidates:
        """At most GRASPS_PER_BALL candidates in each ball (A,), made as the detector makes them."""
        cloud, support = Cloud(view.points, view.normals), view.support_plane
        crop = crop_balls(cloud.points, balls, self.crop_radius)
        pairs = balls[crop.ball_of_point], crop.ball_rows
        every = np.arange(len(crop.ball_rows))
        across = [
            outline_grasps(cloud.points, crop, balls, every, seen, support, view.hand)
            for seen in outlines(
                cloud.points, view.camera_position[None], np.unique(crop.ball_rows)
            )
        ]
        both = Candidates.concatenate([edge_grasps(cloud, *pairs, view.hand), *across])
        if support is not None:
            both, clear = retract(both, support, view.hand)
            both = both.take(np.flatnonzero(clear))
        both = both.take(rng.permutation(len(both)))
        both = both.take(np.argsort(both.approach_index, kind="stable"))
        _, first = np.unique(both.approach_index, return_index=True)
        place = np.arange(len(both)) - np.repeat(first, np.diff([*first, len(both)]))
        return both.take(place < GRASPS_PER_BALL)
