"""The batch that the ball networks score: the neighbourhoods of the approach points."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from edgegrasp_model.candidates.edge_grasps import Candidates, crop_balls
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.scene.cloud import Cloud


@dataclass(frozen=True)
class BallBatch:
    """P points in balls of one cloud or several, E edge grasps; metres."""

    points: Tensor  # (P, 3) float32, centred on their own ball's approach point
    normals: Tensor  # (P, 3) float32
    neighbors: Tensor  # (P, k) int64, rows of `points` in the same ball, the point's own included
    ball_of_point: Tensor  # (P,) int64, ascending, 0..num_balls-1, none of them empty
    contact: Tensor  # (E,) int64, rows of `points`: the contact point of each edge grasp
    approach: Tensor  # (E, 3) float32, outward approach direction u, unit length
    depth: Tensor  # (E,) float32, |r_perp|: contact below approach point along u

    @classmethod
    def from_candidates(
        cls,
        cloud: Cloud,
        candidates: Candidates,
        radius: float,  # metres, of the balls around their approach points; no contact is farther
        k: int = 16,  # neighbours of each point (paper, section IV)
    ) -> Self:
        """Pack candidates with the balls that they are in."""
        balls, size = np.unique(candidates.approach_index), len(cloud.points)
        crop = crop_balls(cloud.points, balls, radius)
        keys = crop.ball_of_point * size + crop.ball_rows  # ascending
        ball = np.searchsorted(balls, candidates.approach_index)
        contact = np.searchsorted(keys, ball * size + candidates.contact_index)
        centred = cloud.points[crop.ball_rows] - cloud.points[balls][crop.ball_of_point]
        # The nearest points of the same ball, the point itself first; it also pads small balls.
        neighbors = np.repeat(np.arange(len(centred))[:, None], k, axis=1)
        for start, stop in pairwise(crop.start.tolist()):
            points = centred[start:stop]
            there = min(k, len(points))
            nearest = cKDTree(points).query(points, k=range(1, there + 1))[1]
            neighbors[start:stop, :there] = start + nearest
        rows = cloud.normals[crop.ball_rows], neighbors, crop.ball_of_point, contact
        edges = np.ascontiguousarray(candidates.approach), candidates.depth
        return cls(*map(torch.from_numpy, (centred, *rows, *edges)))

    @classmethod
    def synthetic(cls, config: NetworkConfig) -> Self:
        """A fixed batch of 32 edge grasps, to check that a network still gives the same logits."""
        rng = np.random.default_rng(0)
        points = rng.uniform(-0.06, 0.06, (200, 3)).astype(np.float32)
        normals = rng.normal(size=(200, 3))
        normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        crop = crop_balls(points, np.array([0, 1]), config.crop_radius)
        row = rng.choice(len(crop.ball_rows), 32)
        depth = rng.uniform(0.0, 0.04, 32).astype(np.float32)
        hands = np.zeros((32, 4, 4), dtype=np.float32)
        hands[:, :3, 2] = -normals[:32]
        edges = Candidates(row, crop.ball_of_point[row], crop.ball_rows[row], depth, depth, hands)
        return cls.from_candidates(Cloud(points, normals), edges, config.crop_radius, config.k)

    @property
    def num_balls(self) -> int:
        """How many balls there are."""
        return int(self.ball_of_point[-1]) + 1

    @property
    def ball_of_edge(self) -> Tensor:
        """Ball (E,) int64 of each edge grasp."""
        return self.ball_of_point[self.contact]

    def to(self, device: torch.device | str) -> "BallBatch":
        """Moves every tensor to a device."""
        return BallBatch(*(tensor.to(device) for tensor in vars(self).values()))
