from dataclasses import replace

import numpy as np
import pytest

from edgegrasp_sim.engine import Intrinsics
from edgegrasp_sim.sensor import SENSORS, STRUCTURED_LIGHT

CAMERA = Intrinsics()
FAULTLESS = replace(
    STRUCTURED_LIGHT, baseline=0.0, window=1, fattening=0.0, noise_floor=0.0, noise_growth=0.0,
    warp=0.0, disparity_step=0.0, grazing=180.0, missing=0.0,
)  # fmt: skip


def wall(depth: float) -> np.ndarray:
    return np.full((240, 320), depth)


def box_before_wall() -> np.ndarray:
    depth = wall(1.0)
    depth[80:160, 120:200] = 0.8
    return depth


def seen(sensor, depth: np.ndarray, seed: int = 0) -> np.ndarray:
    return sensor.apply(depth, CAMERA, np.random.default_rng(seed))


def test_a_camera_without_faults_sees_what_is_there_and_nothing_beyond_its_range() -> None:
    depth = box_before_wall()
    depth[:, 300:] = CAMERA.far
    image = seen(FAULTLESS, depth)
    assert np.isnan(image[:, 300:]).all()
    np.testing.assert_allclose(image[:, :300], depth[:, :300], atol=1e-6)


@pytest.mark.parametrize("pixels", [1, 4])
def test_noise_grows_with_the_square_of_the_depth(pixels: int) -> None:
    noisy = replace(FAULTLESS, noise_growth=0.002, noise_pixels=pixels)
    spread = [seen(noisy, wall(depth)).std() for depth in (0.5, 1.0, 1.5)]
    assert spread == pytest.approx([0.0005, 0.002, 0.0045], rel=0.15)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_what_the_projector_does_not_light_is_missing_on_its_other_side(side: float) -> None:
    missing = np.isnan(seen(replace(FAULTLESS, baseline=side * 0.075), box_before_wall()))
    beside = [slice(100, 120), slice(200, 220)]  # to the left of the box, and to the right
    shadow, lit = beside if side > 0 else reversed(beside)
    width = 0.075 * CAMERA.focal_length * (1 / 0.8 - 1)  # pixels
    assert missing[90:150, shadow].sum(axis=1) == pytest.approx(np.full(60, width), abs=2)
    assert not missing[90:150, lit].any()
    assert not missing[:70].any()


@pytest.mark.parametrize("kind", SENSORS)
def test_the_same_seed_gives_the_same_image(kind: str) -> None:
    depth = box_before_wall()
    image = seen(SENSORS[kind], depth)
    np.testing.assert_array_equal(image, seen(SENSORS[kind], depth))
    assert not np.array_equal(image, seen(SENSORS[kind], depth, seed=1), equal_nan=True)
    assert np.nanmedian(np.abs(image - depth)) < 0.005
