"""Label a view: choose some of its edge grasps, try each in the simulator, keep what happened."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.candidates.sample import Sample, sample_candidates
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.scene.cloud import check_cloud
from edgegrasp_model.scene.scene import Scene, build_scene
from edgegrasp_sim.observation import Observation
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_training.views import LabelledView

VOXEL_SIZE = 0.0045  # metres
SAMPLED_RADIUS = 0.04  # metres; balls that candidates are drawn from
BEST_SHARE = 0.1  # of the candidates, by score: what a network would have executed
UNSURE = 0.1, 0.8  # scores that leave the outcome open
SURE = 0.99  # score of a best grasp above which a view has little to teach, if it holds
EASY_SHARE = 0.4  # of the grasps that are tried in a view whose best grasp is sure
FREE_SHARE = 0.75  # of the grasps chosen at random, hands the cloud says are free
GUIDED_SHARE = 0.5  # of the tried grasps, where weights are given: best and unsure ones


class Question(NamedTuple):
    """A view of a scene and what is asked of it."""

    observation: Observation
    request: DetectOptions


@dataclass(frozen=True)
class Choice:
    """What to try in a view.

    Attributes:
        grasps: Tried at most.
        weights: Of the network that guides the choice; None: by chance.
        hard: Whether the scene is known to be hard, so that a sure best grasp says little.
    """

    grasps: int
    weights: Path | None
    hard: bool


@lru_cache(maxsize=1)
def detector(weights: Path) -> GraspDetector:
    """The detector with these weights, loaded once in a process."""
    return GraspDetector.load(weights)


def label(
    simulation: ClutterSimulation,
    question: Question,
    choice: Choice,
    rng: np.random.Generator,
) -> LabelledView:
    """Sample candidates as the detector does and try some of them.

    Args:
        simulation: Holds the scene.
        question: A view of it and the request.
        choice: What to try.
        rng: Chooses among the candidates.
    """
    observation, request = question
    if len(observation.cloud) == 0:
        return _empty(observation)
    guide = None if choice.weights is None else detector(choice.weights)
    if guide is None:
        scene, sample, score = *_sampled(observation, request), None
    else:
        prepared = guide.prepare(observation.cloud, request)
        scene, sample = prepared.scene, prepared.sample
        score = None if prepared.batch is None else guide.run(prepared.batch)
    if scene is None or sample is None:
        return _empty(observation)
    candidates = sample.candidates.take(_chosen(sample, score, choice, rng))
    T_world_hand = scene.frame.poses_in_cloud(candidates.T_cloud_hand)
    results = [simulation.try_grasp(pose, shake=True) for pose in T_world_hand]
    return LabelledView(
        points=scene.points_in_cloud,
        normals=scene.frame.directions_in_cloud(scene.cloud.normals),
        camera_position=observation.camera_position,
        approach_index=candidates.approach_index,
        contact_index=candidates.contact_index,
        T_world_hand=T_world_hand,
        success=np.asarray([result.success for result in results], dtype=np.int8),
        firm=np.asarray([bool(result.held_after_shaking) for result in results], dtype=np.int8),
    )


def _sampled(
    observation: Observation, request: DetectOptions
) -> tuple[Scene | None, Sample | None]:
    """The scene and its candidates, as the detector makes them, without a network."""
    scene = build_scene(check_cloud(observation.cloud), request, VOXEL_SIZE, {}, [])
    if scene is None:
        return None, None
    return scene, sample_candidates(scene, request, load_gripper(), SAMPLED_RADIUS, {})


def _chosen(
    sample: Sample,
    logit: NDArray[np.floating] | None,
    choice: Choice,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Ascending rows of the candidates to try.

    Some that a network would execute, as many whose outcome it leaves open, and the rest at
    random: mostly hands that are free of collision. Fewer where the best one is sure to hold,
    unless the scene is known to be hard.
    """
    left = np.ones(len(sample.candidates), dtype=bool)
    total, guided = choice.grasps, 0
    if logit is not None:
        score = 1.0 / (1.0 + np.exp(-logit))
        free = np.flatnonzero(sample.collision_free)
        ranked = free[np.argsort(-logit[free])][: round(BEST_SHARE * len(logit)) + 1]
        if not choice.hard and len(ranked) > 0 and score[ranked[0]] >= SURE:
            total = round(EASY_SHARE * total)
        each = round(GUIDED_SHARE * total / 2)
        first, others = ranked[: each // 2], ranked[each // 2 :]
        left[first] = False
        left[rng.permutation(others)[: each - len(first)]] = False
        unsure = np.flatnonzero(left & (score > UNSURE[0]) & (score < UNSURE[1]))
        left[rng.permutation(unsure)[:each]] = False
        guided = int((~left).sum())
    count = total - guided
    free = rng.permutation(np.flatnonzero(left & sample.collision_free))
    hit = rng.permutation(np.flatnonzero(left & ~sample.collision_free))
    free = free[: max(round(FREE_SHARE * count), count - len(hit))]
    left[free] = False
    left[hit[: count - len(free)]] = False
    return np.flatnonzero(~left)


def _empty(observation: Observation) -> LabelledView:
    nothing = np.empty((0, 3), dtype=np.float32)
    rows = np.empty(0, dtype=np.int64)
    return LabelledView(
        nothing,
        nothing,
        observation.camera_position,
        rows,
        rows,
        None,
        rows.astype(np.int8),
    )
