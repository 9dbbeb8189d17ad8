"""The factor by which a camera's depths are wrong, read off a plane whose place is known."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.cloud_input import CheckedCloud
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.support import SupportPlane

Float64 = NDArray[np.float64]

NEAR = 0.01  # metres from the plane within which points are taken for it
HIGHEST = 10.0  # metres over the plane, the highest camera
STEP = 0.001  # metres that the plane moves between one factor that is tried and the next
MIN_SHARE, MIN_POINTS = 0.1, 20  # of the points that the plane must hold
FLAT = 0.35  # of that distance, median distance of its points; those of a wall have 0.5
REFINEMENTS = 20
LEAST = 5e-4  # factors nearer to one are none


def depths_corrected(
    sent: CheckedCloud,
    options: DetectOptions,
    viewpoints: Float64 | None,
    warnings: list[str],
) -> CheckedCloud:
    """The cloud with every view scaled about its camera, so that the support plane is in its place.

    Args:
        sent: N points, in which the plane is seen.
        options: Whose support may name a greatest depth error.
        viewpoints: (W, 3) the cameras, metres; the cloud's `view_ids` are their rows.
        warnings: Gets what was done, or why nothing was.

    Raises:
        InvalidRequest: There is no viewpoint to scale about.
    """
    plane = options.support
    if not isinstance(plane, SupportPlane) or plane.max_depth_error == 0.0:
        return sent
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


def depth_scale(
    points: NDArray[np.floating], viewpoint: Float64, plane: SupportPlane
) -> float | None:
    """The factor on all depths of a view that brings what it saw of a plane into the plane.

    Where several factors bring a level of points there, the table's or that of a lid, the least
    counts: nothing is seen below the table.

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
    # A point is in the plane once its fall below the camera is the camera's height.
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
    for _ in range(REFINEMENTS):
        within = factors[np.abs(factors - scale) <= reach]
        scale = float(np.median(within))
    spread = float(np.median(np.abs(within - scale)))
    return scale if spread <= FLAT * reach else None
