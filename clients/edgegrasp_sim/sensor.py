"""Faults of depth cameras: structured light, stereo, time of flight, and plain noise.

Turns a rendered depth image into an image of such a camera, NaN where there is no reading. The
models follow measurements of such cameras: noise that grows with the square of the depth
(Khoshelham and Elberink 2012; Nguyen, Izadi and Lovell 2012), quantised disparities and the shadow
of the projector (Handa et al. 2014), windows that smooth over small steps, and flying pixels of
time-of-flight cameras between an edge and the surface behind it (Sarbolandi et al. 2015).
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveInt
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter, zoom

from edgegrasp_camera.arrays import Bools, Float32, Float64
from edgegrasp_sim.engine import SimCamera

EDGE = 0.015  # metres; a larger depth step between neighbouring pixels is an edge
SAME_SURFACE = 0.004  # metres; a pixel this little behind another is not hidden by it
WARP_PIXELS = 96  # pixels between the independent values of the warp
PATCH_PIXELS = 12  # pixels between the independent values of missing patches
Share = Annotated[float, Field(ge=0.0, le=1.0)]  # checked in a protocol's file


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Noise of depth images: a random factor on each, and smooth Gaussian noise on some."""

    gamma_shape: NonNegativeFloat = 0.0  # shape of the factor's gamma distribution; 0: no factor
    gamma_scale: NonNegativeFloat = 0.0  # its scale
    correlated_std: NonNegativeFloat = 0.0  # standard deviation of the smooth noise, metres
    correlated_pixels: PositiveInt = 4  # pixels between its independent values, interpolated
    correlated_share: Share = 0.0  # share of the images that have it

    def apply(self, depth: Float64, camera: SimCamera, rng: np.random.Generator) -> Float64:
        """A noisy copy of a depth image of any camera: (height, width) metres."""
        noisy: Float64 = depth
        if self.gamma_shape > 0:
            noisy = noisy * rng.gamma(self.gamma_shape, self.gamma_scale)
        if self.correlated_std > 0 and rng.random() < self.correlated_share:
            cells = np.maximum(np.floor_divide(depth.shape, self.correlated_pixels), 1)
            coarse = rng.normal(0.0, self.correlated_std, cells)
            factors = np.divide(depth.shape, coarse.shape)
            noisy = noisy + zoom(coarse, factors, order=1, mode="nearest", grid_mode=True)
        return np.where(depth < 0.999 * camera.far, noisy, depth)  # empty pixels stay empty


@dataclass(frozen=True, slots=True)
class DepthSensor:
    """A depth camera: the faults that `apply` adds to an image."""

    name: str  # of its kind
    baseline: float  # metres along x to the projector or second camera; 0: nothing is hidden
    window: int  # side in pixels of the window that smooths steps below `EDGE`; 1: not smoothed
    fattening: float  # share of the pixels behind an edge that get the depth of its front
    flying: float  # share of the pixels at an edge that lie between its front and its back
    noise_floor: float  # standard deviation of the noise at depth 0, metres
    noise_growth: float  # added to it per square metre of squared depth, 1 / metre
    noise_pixels: int  # pixels between independent values of the noise
    warp: float  # standard deviation of a smooth error over the whole image, metres
    disparity_step: float  # pixels to which disparities are rounded; 0: not rounded
    grazing: float  # degrees from the surface normal at which half of the readings are missing
    missing: float  # share of the image that is missing in patches

    def apply(self, depth: Float64, camera: SimCamera, rng: np.random.Generator) -> Float64:
        """The image that this camera gives: (height, width) metres, NaN without a reading."""
        true = depth.astype(np.float32)
        seen = self._at_edges(true, rng)
        lost = _shadow(true, self.baseline * camera.focal_length)
        lost |= self._grazing(true, camera, rng)
        if self.missing > 0:
            patches = _smooth(true.shape, PATCH_PIXELS, rng)
            lost |= patches > np.quantile(patches[::8, ::8], 1.0 - self.missing)
        std = self.noise_floor + self.noise_growth * true * true
        seen = seen + std * _smooth(true.shape, self.noise_pixels, rng)
        if self.warp > 0:
            seen += np.float32(self.warp) * _smooth(true.shape, WARP_PIXELS, rng)
        if self.disparity_step > 0:
            step = abs(self.baseline) * camera.focal_length / self.disparity_step
            seen = step / np.maximum(np.rint(step / seen), 1.0)
        seen[lost | (true >= 0.999 * camera.far)] = np.nan
        return seen.astype(np.float64)

    def _at_edges(self, depth: Float32, rng: np.random.Generator) -> Float32:
        """Depths smoothed over small steps, fattened or flying at edges."""
        across = max(self.window, 3)
        front = minimum_filter(depth, across, mode="nearest")
        back = maximum_filter(depth, across, mode="nearest")
        at_edge = back - front > EDGE * across / 3
        smoothed = uniform_filter(depth, self.window, mode="nearest") if self.window > 1 else depth
        seen = np.where(at_edge, depth, smoothed)
        rows, columns = np.nonzero(at_edge)
        draw = rng.random(len(rows), dtype=np.float32)
        near, far = front[rows, columns], back[rows, columns]
        here = depth[rows, columns]
        mixed = near + rng.random(len(rows), dtype=np.float32) * (far - near)
        here = np.where(draw < self.flying, mixed, here)
        # Whole stretches of an edge are fattened, not single pixels.
        fat = _smooth(depth.shape, 2 * across, rng)[rows, columns]
        share = 0.5 + np.clip(fat, -1.5, 1.5) / 3  # nearly uniform between 0 and 1
        seen[rows, columns] = np.where(share < self.fattening, near, here)
        return seen

    def _grazing(self, depth: Float32, camera: SimCamera, rng: np.random.Generator) -> Bools:
        """Pixels that see a surface at a grazing angle."""
        slope = np.zeros_like(depth)
        for axis in (0, 1):
            step = np.abs(np.diff(depth, axis=axis))
            # The smaller step to either side: an edge is not a slanted surface.
            lower = np.minimum(np.delete(step, 0, axis), np.delete(step, -1, axis))
            inner = slope[1:-1] if axis == 0 else slope[:, 1:-1]
            inner += lower * lower
        angle = np.degrees(np.arctan(np.sqrt(slope) * camera.focal_length / depth))
        limit = self.grazing + 4.0 * rng.standard_normal(depth.shape, dtype=np.float32)
        return np.asarray(angle > limit)


# A first-generation Kinect, an active stereo camera, a time-of-flight camera, at arm's length.
STRUCTURED_LIGHT = DepthSensor(
    name="structured-light", baseline=0.075, window=5, fattening=0.15, flying=0.0,
    noise_floor=0.0002, noise_growth=0.0014, noise_pixels=2, warp=0.001, disparity_step=0.125,
    grazing=78.0, missing=0.01,
)  # fmt: skip
STEREO = DepthSensor(
    name="stereo", baseline=0.05, window=7, fattening=0.35, flying=0.05, noise_floor=0.0003,
    noise_growth=0.0022, noise_pixels=4, warp=0.001, disparity_step=0.0625, grazing=80.0,
    missing=0.02,
)  # fmt: skip
TIME_OF_FLIGHT = DepthSensor(
    name="time-of-flight", baseline=0.0, window=1, fattening=0.0, flying=0.5, noise_floor=0.0010,
    noise_growth=0.0010, noise_pixels=1, warp=0.002, disparity_step=0.0, grazing=82.0,
    missing=0.005,
)  # fmt: skip
SENSORS = {kind.name: kind for kind in (STRUCTURED_LIGHT, STEREO, TIME_OF_FLIGHT)}


def random_sensor(rng: np.random.Generator) -> DepthSensor:
    """A random camera of one of the three kinds, better or worse than its model."""
    typical = list(SENSORS.values())[int(rng.integers(len(SENSORS)))]
    side = float(rng.choice([-1.0, 1.0]))  # of the projector
    worse = float(np.exp(rng.uniform(np.log(0.4), np.log(1.6))))
    window = typical.window + 2 * int(rng.integers(-1, 2)) if typical.window > 1 else 1
    return replace(
        typical,
        baseline=side * typical.baseline * rng.uniform(0.5, 1.5),
        window=window,
        fattening=typical.fattening * rng.uniform(0.0, 2.0),
        flying=typical.flying * rng.uniform(0.0, 1.5),
        noise_floor=typical.noise_floor * worse,
        noise_growth=typical.noise_growth * worse,
        noise_pixels=int(rng.integers(1, 7)) if typical.noise_pixels > 1 else 1,
        warp=rng.uniform(0.0, 0.002),
        disparity_step=typical.disparity_step * rng.uniform(0.5, 1.5),
        grazing=typical.grazing + rng.uniform(-8.0, 4.0),
        missing=typical.missing * rng.uniform(0.0, 3.0),
    )


def _shadow(depth: Float32, disparity_scale: float) -> Bools:
    """Pixels of a depth image (H, W), metres, hidden from a second viewpoint next to the camera.

    `disparity_scale` is the viewpoint's distance along the image's x times the focal length, metres
    times pixels.
    """
    height, width = depth.shape
    if disparity_scale == 0:
        return np.zeros(depth.shape, dtype=bool)
    place = np.arange(width, dtype=np.float32) - np.float32(disparity_scale) / depth
    # Two columns on either side of the image are for points that the second viewpoint sees outside.
    column = np.clip(np.floor(place).astype(np.int32), -2, width) + 2
    cells = column + (width + 4) * np.arange(height, dtype=np.int32)[:, None]
    nearest = np.full(height * (width + 4), np.inf, dtype=np.float32)
    for beside in (0, 1):  # neighbours may lie more than a column apart there
        np.minimum.at(nearest, (cells + beside).ravel(), depth.ravel())
    hidden = depth > nearest[cells] + SAME_SURFACE + 0.01 * depth
    return np.asarray(hidden & (column > 1) & (column < width + 2))


def _smooth(shape: tuple[int, ...], step: int, rng: np.random.Generator) -> Float32:
    """Gaussian noise of standard deviation 1 or a little less, interpolated over `step` pixels."""
    height, width = shape
    if step <= 1:
        return rng.standard_normal((height, width), dtype=np.float32)
    rows, columns = height // step + 2, width // step + 2
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    across = _weights(width, columns, step, rng)
    return _weights(height, rows, step, rng) @ (coarse @ across.T) * np.float32(1.5)


def _weights(size: int, cells: int, step: int, rng: np.random.Generator) -> Float32:
    """Linear interpolation of `cells` values at `size` pixels, with a random phase."""
    place = np.arange(size) / step + rng.random()
    distance = np.abs(place[:, None] - np.arange(cells))
    return np.maximum(1.0 - distance, 0.0).astype(np.float32)
