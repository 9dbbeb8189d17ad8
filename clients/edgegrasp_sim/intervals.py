"""Confidence intervals of shares and of differences between paired runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Z_95 = 1.959964  # standard normal deviate of a two-sided 95 % interval
RESAMPLES = 10_000


def wilson(successes: int, trials: int) -> tuple[float, float] | None:
    """Wilson's 95 % interval of a share; None without trials."""
    if trials == 0:
        return None
    share = successes / trials
    spread = Z_95**2 / trials
    centre = (share + spread / 2) / (1 + spread)
    half = Z_95 / (1 + spread) * ((share * (1 - share) + spread / 4) / trials) ** 0.5
    return max(0.0, centre - half), min(1.0, centre + half)


def paired_difference(
    numerators: ArrayLike, denominators: ArrayLike, rng: np.random.Generator
) -> tuple[float, tuple[float, float]] | None:
    """How a ratio of sums differs between two runs over the same scenes, by the bootstrap.

    Scenes are resampled, so that what two runs share by sharing scenes cancels out.

    Args:
        numerators: (2, S) counts of each run in each scene.
        denominators: (2, S) likewise.
        rng: source of the resampling.

    Returns:
        Second run's ratio minus the first's, and its 95 % interval; None if a run has no counts.
    """
    above, below = np.asarray(numerators, float), np.asarray(denominators, float)
    if (below.sum(axis=1) == 0).any():
        return None
    picks = rng.integers(above.shape[1], size=(RESAMPLES, above.shape[1]))
    with np.errstate(invalid="ignore"):
        ratios = above[:, picks].sum(axis=-1) / below[:, picks].sum(axis=-1)  # (2, resamples)
    low, high = np.nanpercentile(ratios[1] - ratios[0], [2.5, 97.5]).tolist()
    first, second = (above.sum(axis=1) / below.sum(axis=1)).tolist()
    return second - first, (low, high)
