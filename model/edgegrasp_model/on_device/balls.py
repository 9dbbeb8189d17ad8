"""Balls around approach points on a device; `edgegrasp_model.ball_batch` by trying every pair."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgegrasp_model.ball_batch import BallBatch, BallCrop
from edgegrasp_model.on_device.candidates import DeviceCandidates
from edgegrasp_model.on_device.cloud import PAIRS, DeviceCloud, squared_distances


class DeviceCrop(NamedTuple):
    """Balls as rows of their cloud. P ball points in A balls, ball after ball."""

    ball_rows: Tensor  # (P,) rows of the cloud, ascending within each ball
    ball_of_point: Tensor  # (P,) ascending, 0..A-1
    radius: float  # metres

    @property
    def on_processor(self) -> BallCrop:
        """The same in arrays."""
        rows, balls = self.ball_rows.cpu().numpy(), self.ball_of_point.cpu().numpy()
        return BallCrop(rows.astype(np.int64), balls.astype(np.int64), self.radius)


def crop_balls(points: Tensor, approach_index: Tensor, radius: float) -> DeviceCrop:
    """Crop a ball of `radius` metres around each approach point (A,) of points (N, 3)."""
    inside = squared_distances(points[approach_index], points) <= radius * radius
    ball_of_point, ball_rows = inside.nonzero(as_tuple=True)
    return DeviceCrop(ball_rows, ball_of_point, radius)


def nearest_in_ball(centred: Tensor, crop: DeviceCrop, balls: int, k: int) -> Tensor:
    """Join the points of balls to their k nearest in the same ball.

    Args:
        centred: (P, 3) ball points around their own approach points.
        crop: Their balls.
        balls: A.
        k: Neighbours of a point, itself included; its own row fills up small balls.

    Returns:
        (P, k) rows of `centred`.
    """
    size = torch.zeros(balls, dtype=torch.int64, device=centred.device)
    size.index_add_(0, crop.ball_of_point, torch.ones_like(crop.ball_of_point))
    first = size.cumsum(0) - size
    largest = int(size.max())
    place = torch.arange(len(centred), device=centred.device) - first[crop.ball_of_point]
    padded = centred.new_zeros((balls, largest, 3))
    padded[crop.ball_of_point, place] = centred
    beyond = torch.arange(largest, device=centred.device) >= size.unsqueeze(1)  # (A, M)
    found = torch.zeros((balls, largest, k), dtype=torch.int64, device=centred.device)
    together = max(1, PAIRS // largest**2)
    for start in range(0, balls, together):
        part = slice(start, start + together)
        apart = squared_distances(padded[part], padded[part])  # (a, M, M)
        apart = apart.masked_fill(beyond[part].unsqueeze(1), torch.inf)
        near = apart.topk(min(k, largest), largest=False)
        rows = near.indices + first[part, None, None]
        found[part, :, : rows.shape[2]] = rows.masked_fill(near.values.isinf(), -1)
    if k > largest:
        found[:, :, largest:] = -1
    neighbors = found[crop.ball_of_point, place]
    own_row = torch.arange(len(centred), device=centred.device).unsqueeze(1)
    return torch.where(neighbors < 0, own_row, neighbors)


def ball_batch(
    cloud: DeviceCloud,
    approach_index: Tensor,
    crop: DeviceCrop,
    candidates: DeviceCandidates,
    k: int,
) -> BallBatch:
    """What the networks on balls need of some candidates, whose `pair` is their row in `crop`."""
    centred = cloud.points[crop.ball_rows] - cloud.points[approach_index][crop.ball_of_point]
    balls = len(approach_index)
    return BallBatch(
        points=centred,
        normals=cloud.normals[crop.ball_rows],
        neighbors=nearest_in_ball(centred, crop, balls, k),
        ball_of_point=crop.ball_of_point,
        num_balls=balls,
        contact=candidates.pair,
        approach=candidates.approach,
        depth=candidates.depth,
    )
