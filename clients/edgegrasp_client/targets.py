"""What grasps are wanted for: pixels that a segmenter marked, or an object cut from its scene."""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgegrasp_client.options import DetectOptions

SAME_POINT = 0.005  # metres: the side of a cell in which the scene repeats the object


def on_mask(mask: NDArray[Any], options: Mapping[str, Any] | None = None) -> DetectOptions:
    """Options that allow approach and contact points only where a mask is not 0.

    Args:
        mask: (H, W) or (H, W, C), a value for each pixel of the depth image or row of the cloud,
            as a segmentation network gives it; any channel but a fourth, which is transparency.
        options: What else is asked; regions in it are narrowed.

    Returns:
        The options with both regions. What lies outside of the mask stays an obstacle.
    """
    kept = mask[..., :3].any(axis=2) if mask.ndim == 3 else mask != 0
    asked = dict(options or {})
    for name in ("approach_region", "contact_region"):
        region = asked.get(name) or {}
        outside = {"kind": "mask", "mask": ~kept}
        asked[name] = {**region, "exclude": [*region.get("exclude", ()), outside]}
    return cast("DetectOptions", asked)


def object_in_scene(
    object_points: ArrayLike, scene_points: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """One cloud of an object and of the scene around it, which are sent apart.

    Args:
        object_points: (N, 3) metres, what is to be grasped.
        scene_points: (M, 3) metres, the same frame; with the object or without it.

    Returns:
        `cloud` (K, 3) and `segment_ids` (K,) for `GraspClient.detect`: 1 the object, 0 the rest,
        without the points of the scene that repeat the object.
    """
    clouds = [np.asarray(each, np.float32).reshape(-1, 3) for each in (object_points, scene_points)]
    wanted, scene = (each[np.isfinite(each).all(axis=1)] for each in clouds)
    digits = np.array([2**42, 2**21, 1])  # one number of three, each below 5 km
    cells = [np.floor(each / SAME_POINT).astype(np.int64) @ digits for each in (wanted, scene)]
    rest = scene[~np.isin(cells[1], cells[0])]
    segment_ids = np.repeat(np.array([1, 0], np.int32), [len(wanted), len(rest)])
    return np.concatenate([wanted, rest]), segment_ids
