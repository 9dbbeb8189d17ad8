"""Options of a detection; what is left out, or None, takes the server's default."""

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from edgegrasp_client.errors import invalid


class Workspace(TypedDict):
    """An axis-aligned box in the cloud's frame."""

    min: Sequence[float]  # lower corner, metres
    max: Sequence[float]  # upper corner, metres


class SupportPlane(TypedDict):
    """The points p with normal . p = offset."""

    normal: Sequence[float]  # unit, away from the table
    offset: float  # metres


class Suppression(TypedDict, total=False):
    """Drops a grasp near a better one: nearer than both distances."""

    translation: float  # metres between TCPs
    rotation: float  # radians between hands


class DetectOptions(TypedDict, total=False):
    """What `detect` takes besides the cloud."""

    model: str  # weights to use; empty: the server's default
    num_approach_points: int  # approach points sampled
    num_candidates: int  # candidates scored at most
    sampling: str  # of approach points: "farthest" or "uniform"
    seed: int  # same cloud, options and seed, same grasps
    viewpoint: Sequence[float] | None  # camera position, metres, cloud frame; orients the normals
    up: Sequence[float]  # direction away from gravity
    support: SupportPlane | None  # plane the objects rest on; the hand stays above it
    workspace: Workspace | None  # points outside are dropped
    collision: str  # grasps whose hand meets the cloud: "avoid", "penalise" or "ignore"
    min_score: float  # lowest score returned
    top_k: int  # grasps returned at most
    suppression: Suppression | None  # non-maximum suppression; None: none


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options with numpy values turned into plain ones, and those left out that are None.

    `suppression` alone has a None of its own: no suppression.

    Raises:
        InvalidRequestError: An option has no such name.
    """
    for name in options:
        if name not in DetectOptions.__annotations__:
            known = ", ".join(DetectOptions.__annotations__)
            raise invalid(
                f"options.{name}", "an unknown field", f"Remove it; the options are: {known}."
            )
    return {
        name: _plain(value)
        for name, value in options.items()
        if value is not None or name == "suppression"
    }


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value
