"""A detector of known service time and made-up grasps, to measure and test the service alone."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.cloud import Float32, validate_cloud
from edgegrasp_model.errors import UnknownModel
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import Detection, Grasp

NAME = "dummy"
TCP_Z = 0.1  # metres along the hand's z
GRASPS = 10  # made at most


class DummyDetector:
    """Puts top-down grasps on points drawn by the seed; they hold nothing."""

    def __init__(self, seconds: float = 0.0) -> None:
        self._seconds = seconds

    def detect(self, cloud: NDArray[Any], options: DetectOptions) -> Detection:
        """Make up grasps, the same ones for the same cloud and options.

        Args:
            cloud: (N, 3), metres.
            options: `num_approach_points`, `min_score`, `top_k` and `seed` have an effect.

        Raises:
            InvalidRequest: The cloud is none, as for a real detector.
        """
        start = time.perf_counter()
        points = validate_cloud(cloud, options.num_approach_points)
        random = np.random.default_rng(options.seed)
        drawn = random.choice(len(points), options.num_approach_points, replace=False)
        scores = np.sort(random.random(len(drawn), dtype=np.float32))[::-1]
        grasps = [
            _top_down(points[row], float(score))
            for row, score in zip(drawn[:GRASPS], scores[:GRASPS], strict=True)
            if score >= options.min_score
        ][: options.top_k]
        time.sleep(self._seconds)
        return Detection(
            grasps=grasps,
            counts={"points": len(points), "scored": len(drawn), "returned": len(grasps)},
            seconds={"total": time.perf_counter() - start},
            model=NAME,
            warnings=["The dummy detector made these grasps up."],
        )


class DummyCatalogue:
    """The dummy detector as the only weights."""

    def __init__(self, seconds: float = 0.0) -> None:
        self._detector = DummyDetector(seconds)

    def get(self, name: str = "") -> DummyDetector:
        """The detector; raises UnknownModel for any name but its own."""
        if name not in ("", NAME):
            raise UnknownModel(name, [NAME])
        return self._detector

    def describe(self) -> Sequence[Mapping[str, Any]]:
        """The facts of the dummy."""
        return [{"name": NAME, "architecture": NAME, "gripper": "panda", "default": True}]

    def warm_up(self) -> None:
        """There is nothing to warm up."""


def _top_down(point: Float32, score: float) -> Grasp:
    T_cloud_hand = np.diag(np.array([1, -1, -1, 1], dtype=np.float32))
    T_cloud_hand[:3, 3] = point + np.array([0.0, 0.0, TCP_Z], dtype=np.float32)
    T_cloud_tcp = T_cloud_hand.copy()
    T_cloud_tcp[:3, 3] = point
    return Grasp(
        score=score,
        T_cloud_hand=T_cloud_hand,
        T_cloud_tcp=T_cloud_tcp,
        width=0.08,
        approach_point=point,
        contact_point=point,
        approach_direction=np.array([0.0, 0.0, -1.0], dtype=np.float32),
        collision_free=True,
    )
