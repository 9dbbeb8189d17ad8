"""A detector of known service time and made-up grasps, to measure and test the service alone."""

import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest, UnknownModel
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import (
    DebugInfo,
    Detection,
    Evaluation,
    Float32,
    Grasp,
    NoGrasp,
    Outcome,
    Scoring,
)
from edgegrasp_model.scene.cloud import CloudInput, check_cloud

NAME = "dummy"
TCP_Z = 0.1  # metres along the hand's z
GRASPS = 10  # made at most
WARNING = "The dummy detector made these grasps up."


@dataclass(frozen=True)
class DummyPrepared:
    """A request between the stages."""

    options: DetectOptions
    points: Float32  # (N, 3)
    drawn: NDArray[np.int64]  # (A,) approach points, rows of `points`
    batch: Float32  # (A,) scores, which the network gives back
    counts: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


class DummyDetector:
    """Puts top-down grasps on points drawn by the seed; they hold nothing.

    Args:
        seconds: What the network takes for one request.
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self._seconds = seconds

    def prepare(self, cloud: CloudInput, options: DetectOptions) -> DummyPrepared:
        """Draw approach points, the same ones for the same cloud and options.

        Args:
            cloud: As for a real detector.
            options: `num_approach_points`, `min_score`, `top_k`, `seed` and `debug` have an effect.

        Raises:
            InvalidRequest: The cloud is none, as for a real detector.
        """
        points = check_cloud(cloud, options.num_approach_points).points
        random = np.random.default_rng(options.seed)
        drawn = random.choice(len(points), options.num_approach_points, replace=False)
        scores = np.sort(random.random(len(drawn), dtype=np.float32))[::-1]
        return DummyPrepared(options, points, drawn, scores)

    def run(self, batch: Float32) -> Float32:
        """Take the time of a network."""
        time.sleep(self._seconds)
        return batch

    def finish(self, prepared: DummyPrepared, logits: NDArray[Any]) -> Detection:
        """Put a grasp on each of the best approach points."""
        options, points, drawn = prepared.options, prepared.points, prepared.drawn
        grasps = [
            _top_down(points[row], float(score))
            for row, score in zip(drawn[:GRASPS], logits[:GRASPS], strict=True)
            if score >= options.min_score
        ][: options.top_k]
        counts = {"points": len(points), "scored": len(drawn), "returned": len(grasps)}
        return Detection(
            grasps=grasps,
            counts=counts | {"crc32": zlib.crc32(points.tobytes())},
            seconds=prepared.seconds | {"total": sum(prepared.seconds.values())},
            model=NAME,
            warnings=[WARNING],
            debug=_debug(points, drawn, logits) if options.debug else None,
        )

    def score(
        self,
        cloud: CloudInput,
        options: DetectOptions,
        *,
        edges: NDArray[Any] | None = None,
        hand_poses: NDArray[Any] | None = None,
    ) -> Scoring:
        """Make up scores; an edge from a point to itself defines no grasp.

        Raises:
            InvalidRequest: The cloud is none, or an edge names a row that it does not have.
        """
        start = time.perf_counter()
        checked = check_cloud(cloud)
        random = np.random.default_rng(options.seed)
        if edges is not None:  # the model's own checks would import torch
            outside = ((edges < 0) | (edges >= checked.rows_sent)).any(axis=1)
            if outside.any():
                fix = f"Send rows of the cloud, 0 to {checked.rows_sent - 1}."
                bad = edges[int(np.argmax(outside))].tolist()
                raise InvalidRequest("edges", str(bad), fix)
            contacts: list[Float32 | None] = [
                None if approach == contact else _row(checked.points, checked.row, contact)
                for approach, contact in edges
            ]
        else:
            assert hand_poses is not None
            contacts = list((hand_poses @ (0.0, 0.0, TCP_Z, 1.0))[:, :3].astype(np.float32))
        scores = random.random(len(contacts), dtype=np.float32)
        evaluations = [
            Evaluation(None, NoGrasp.TOO_SHORT)
            if contact is None
            else Evaluation(_top_down(contact, float(score)), None)
            for contact, score in zip(contacts, scores, strict=True)
        ]
        seconds = {"total": time.perf_counter() - start}
        scored = len(contacts) - sum(contact is None for contact in contacts)
        counts = {"points": len(checked.points), "scored": scored}
        return Scoring(evaluations, counts, seconds, NAME, [WARNING])


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
        facts = {"name": NAME, "architecture": NAME, "gripper": "panda", "default": True}
        return [facts | {"device": "cpu"}]

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
        clearance=0.0,
    )


def _row(points: Float32, rows: NDArray[np.int64], row: int) -> Float32:
    """A point by its row in the cloud as sent; the next one for a hole."""
    point: Float32 = points[min(int(np.searchsorted(rows, row)), len(points) - 1)]
    return point


def _debug(points: Float32, drawn: NDArray[np.int64], scores: Float32) -> DebugInfo:
    outcome = [Outcome.RETURNED] * len(drawn[:GRASPS])
    outcome += [Outcome.NOT_SCORED] * (len(drawn) - len(outcome))
    return DebugInfo(
        points=points,
        normals=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(points), 1)),
        approach_index=drawn,
        contact_index=drawn,
        T_cloud_hand=np.stack([_top_down(points[row], 0.0).T_cloud_hand for row in drawn]),
        score=np.where(np.arange(len(drawn)) < GRASPS, scores, np.float32(np.nan)),
        outcome=outcome,
        support_plane=None,
    )
