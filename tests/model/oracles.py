"""Straightforward NumPy versions of the compiled loops, which the kernels are tested against."""

import numpy as np


def in_hand(points: np.ndarray, T_cloud_hand: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the frames of hands (E, 4, 4).  # (E, N, 3)."""
    shifted = points.astype(np.float64) - T_cloud_hand[:, None, :3, 3]
    return shifted @ T_cloud_hand[:, :3, :3].astype(np.float64)


def any_point_in_boxes(
    points: np.ndarray, T_cloud_hand: np.ndarray, boxes: np.ndarray
) -> np.ndarray:
    """Which hands (E,) have a point in one of their boxes (B, 2, 3)."""
    position = in_hand(points, T_cloud_hand)[:, :, None]  # (E, N, 1, 3)
    inside = ((position > boxes[:, 0]) & (position < boxes[:, 1])).all(axis=3)
    return inside.any(axis=(1, 2))


def signed_distance_to_boxes(
    points: np.ndarray, T_cloud_hand: np.ndarray, boxes: np.ndarray
) -> np.ndarray:
    """Least signed distance (E,) of points to the boxes (B, 2, 3) of each hand."""
    position = in_hand(points, T_cloud_hand)[:, :, None]  # (E, N, 1, 3)
    beyond = np.maximum(boxes[:, 0] - position, position - boxes[:, 1])
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=3)
    return np.where(outside > 0, outside, beyond.max(axis=3)).min(axis=(1, 2))
