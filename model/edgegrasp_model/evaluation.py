"""Score the edges and hand poses that a caller gives."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.assembly import grasps_in_cloud
from edgegrasp_model.ball_batch import BallBatch, BallCrop, crop_balls
from edgegrasp_model.candidates import Candidates
from edgegrasp_model.collision import UP, clearances, collides, widths_needed
from edgegrasp_model.given_grasps import Given
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.hand_view import HandView, hand_views, reach_of
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.options import Collision
from edgegrasp_model.results import Evaluation
from edgegrasp_model.scene import Scene

BALLS_AT_A_TIME = 64

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Scorer:
    """A network as the evaluation sees it."""

    probability: Callable[[BallBatch | HandBatch], NDArray[np.floating]]
    crop_radius: float  # metres
    network: NetworkConfig


def evaluate(
    scene: Scene, given: Given, gripper: Gripper, request: Collision, scorer: Scorer
) -> list[Evaluation]:
    """Evaluate what a caller gives, in order.

    Args:
        scene: The scene.
        given: Edges or hand poses as candidates.
        gripper: The hand.
        request: What collides.
        scorer: The network.
    """
    candidates = given.candidates
    view = hand_views(scene.cloud, candidates.T_cloud_hand, reach_of(gripper))
    if scorer.network.architecture == "hand":
        score = scorer.probability(hand_batch(scene, candidates, gripper, scorer.network, view))
    else:
        score = _score_balls(scene, candidates, scorer)
    if given.T_cloud_hand is not None:
        candidates = replace(candidates, T_cloud_hand=given.T_cloud_hand)
    hands = candidates.T_cloud_hand
    grasps = grasps_in_cloud(
        scene,
        candidates,
        gripper,
        score,
        widths_needed(view, gripper),
        ~collides(scene, given.candidates.T_cloud_hand, gripper, request),
        clearances(scene, hands, gripper),
    )
    evaluations = [Evaluation(None, reason) for reason in given.reason]
    for number, grasp in zip(candidates.pair.tolist(), grasps, strict=True):
        evaluations[number] = Evaluation(grasp, None)
    return evaluations


def hand_batch(
    scene: Scene, candidates: Candidates, gripper: Gripper, network: NetworkConfig, view: HandView
) -> HandBatch:
    """What the hand network is told of some candidates of a scene."""
    return HandBatch.from_cloud(
        scene.cloud,
        candidates,
        gripper,
        UP,
        scene.support,
        scene.viewpoint,
        scene.at_side,
        network.hand_points,
        view,
    )


def _score_balls(scene: Scene, candidates: Candidates, scorer: Scorer) -> NDArray[np.floating]:
    """Scores (E,), ball by ball: there are as many balls as the caller has approach points."""
    score = np.empty(len(candidates))
    points, normals = scene.cloud.points, scene.cloud.normals
    balls = np.unique(candidates.approach_index)
    for start in range(0, len(balls), BALLS_AT_A_TIME):
        some = balls[start : start + BALLS_AT_A_TIME]
        crop = crop_balls(points, some, scorer.crop_radius)
        rows = np.flatnonzero(np.isin(candidates.approach_index, some))
        here = candidates.take(rows)
        contact = _contact_rows(here, some, crop, len(points))
        score[rows] = scorer.probability(
            BallBatch.from_cloud(
                points, normals, some, crop, contact, here.approach, here.depth, scorer.network.k
            )
        )
    return score


def _contact_rows(
    candidates: Candidates, balls: NDArray[np.int64], crop: BallCrop, size: int
) -> NDArray[np.int64]:
    """Rows (E,) of the crop that hold the candidates' contacts, each in its own ball."""
    keys = crop.ball_of_point * size + crop.ball_rows  # ascending
    ball = np.searchsorted(balls, candidates.approach_index)
    return np.searchsorted(keys, ball * size + candidates.contact_index).astype(np.int64)
