"""Correct the scale of a camera's depths by a support plane that is known."""

from dataclasses import replace

import numpy as np

from edgegrasp_camera.arrays import Float64, Floats
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import CheckedCloud

NEAR = 0.01  # metres from the plane within which points belong to it
HIGHEST = 10.0  # metres over the plane, the highest camera
STEP = 0.001  # metres that the plane moves between one factor that is tried and the next
FLAT = 0.35  # of that distance: largest median distance of a plane's points (a wall's is 0.5)
SCALE_REFINEMENTS = 20
LEAST = 5e-4  # smaller corrections are left out
MIN_SHARE, MIN_POINTS = 0.1, 20  # of the points that the plane must hold


def correct_depth_scale(
    sent: CheckedCloud,
    plane: SupportPlane,
    viewpoints: Float64 | None,
    warnings: list[str],
) -> CheckedCloud:
    """Scale every view about its camera so that the support plane it sees lies where it should.

    Args:
        sent: N points, in which the plane is seen.
        plane: Where the support is, and how wrong depths may be (max_depth_error).
        viewpoints: (W, 3) the cameras, metres; the cloud's `view_ids` are their rows.
        warnings: Gets what was done, or why nothing was.

    Raises:
        InvalidRequest: There is no viewpoint to scale about.
    """
    if viewpoints is None:
        fix = "Send the camera's position: depths are corrected along its rays."
        raise InvalidRequest("options.viewpoint", "nothing", fix)
    several = len(viewpoints) > 1 and sent.view_ids is not None
    points = sent.points.copy()
    for number, viewpoint in enumerate(viewpoints):
        rows = np.flatnonzero(sent.view_ids == number) if several else slice(None)
        which = f"the depths of view {number}" if several else "the depths"
        scale = depth_scale(points[rows], viewpoint, plane)
        if scale is None:
            warnings.append(
                f"{which} are taken as they are: no support plane is seen within "
                f"options.support.max_depth_error ({plane.max_depth_error:g}) of its place."
            )
        elif abs(scale - 1.0) > LEAST:
            warnings.append(f"{which} were multiplied by {scale:.3f}, as the support plane shows.")
            points[rows] = viewpoint + scale * (points[rows] - viewpoint)
    return replace(sent, points=points)


def depth_scale(points: Floats, viewpoint: Float64, plane: SupportPlane) -> float | None:
    """The factor on all depths of a view that brings its points of the plane into the plane.

    Where several factors fit (the table, or the flat top of an object), the smallest counts:
    nothing is seen below the table.

    Args:
        points: (N, 3) metres.
        viewpoint: (3,) metres.
        plane: With the greatest depth error that is looked for.

    Returns:
        The factor; None where the camera is not above the plane, or too high, or sees too little.
    """
    height = float(plane.heights(viewpoint))
    falls = height - plane.heights(points.astype(np.float64))
    if not NEAR < height < HIGHEST:
        return None
    # A point lies in the plane once it is as far below the camera as the plane is.
    factors = np.sort(height / falls[falls > 0.5 * height])
    step, reach = STEP / height, NEAR / height
    tried = np.arange(1.0 - plane.max_depth_error, 1.0 + plane.max_depth_error + step / 2, step)
    held = np.searchsorted(factors, tried + reach) - np.searchsorted(factors, tried - reach)
    enough = max(MIN_SHARE * len(points), MIN_POINTS)
    start, width = 0, round(2 * NEAR / STEP) + 1  # tries from a plane's rise to past its peak
    while start < len(tried):
        window = held[start : start + width]
        if window.max() >= enough:
            scale = _middle(factors, float(tried[start + int(window.argmax())]), reach)
            if scale is not None:
                return scale
            start += width - 1
        start += 1
    return None


def _middle(factors: Float64, scale: float, reach: float) -> float | None:
    """The median of the factors around one; None where they are too spread for a plane."""
    for _ in range(SCALE_REFINEMENTS):
        within = factors[np.abs(factors - scale) <= reach]
        scale = float(np.median(within))
    spread = float(np.median(np.abs(within - scale)))
    return scale if spread <= FLAT * reach else None
