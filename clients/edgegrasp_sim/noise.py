"""Noise of depth images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scipy.ndimage import zoom

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """One random factor on the whole image, and smooth Gaussian noise on some (dex style).

    Attributes:
        gamma_shape: shape of the gamma distribution of the factor; 0: no factor.
        gamma_scale: its scale.
        correlated_std: standard deviation of the smooth noise, metres.
        correlated_pixels: pixels between its independent values, interpolated in between.
        correlated_share: share of the images that have it.
    """

    gamma_shape: float
    gamma_scale: float
    correlated_std: float
    correlated_pixels: int
    correlated_share: float

    def apply(self, depth: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """A noisy copy of a depth image: (height, width) metres."""
        noisy: NDArray[np.float64] = depth
        if self.gamma_shape > 0:
            noisy = noisy * rng.gamma(self.gamma_shape, self.gamma_scale)
        if self.correlated_std > 0 and rng.random() < self.correlated_share:
            height, width = depth.shape
            step = self.correlated_pixels
            coarse = rng.normal(0.0, self.correlated_std, (height // step, width // step))
            factors = (height / coarse.shape[0], width / coarse.shape[1])
            noisy = noisy + zoom(coarse, factors, order=1, mode="nearest", grid_mode=True)
        return noisy
