"""Which scored candidates come back, and in which order."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.collision import UP, clearances
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.options import DetectOptions, Suppression
from edgegrasp_model.preparation import CODE, Sample
from edgegrasp_model.ranking import ranked, suppress
from edgegrasp_model.results import Outcome
from edgegrasp_model.scene import Scene

Int64 = NDArray[np.int64]


def select(
    scene: Scene,
    sample: Sample,
    score: NDArray[np.floating],
    gripper: Gripper,
    options: DetectOptions,
    counts: dict[str, int],
) -> tuple[Int64, NDArray[np.int8]]:
    """Order the scored candidates, drop the bad ones and the near duplicates, keep the first.

    Args:
        scene: The scene.
        sample: E scored candidates.
        score: (E,) probabilities.
        gripper: The hand.
        options: min_score, order, suppression and top_k.
        counts: Gets the number of candidates left after each step.

    Returns:
        The rows to return, best first, and what became of each candidate: (E,) codes.
    """
    hands = sample.candidates.T_cloud_hand
    T_cloud_tcp = hands @ gripper.T_hand_tcp
    clearance = clearances(scene, hands, gripper) if options.order == "clearance" else None
    free = sample.collision_free | (options.collision.mode == "ignore")
    order = ranked(score, free, options.order, T_cloud_tcp[:, :3, 3] @ UP, clearance)

    def thinned(order: Int64, suppression: Suppression) -> tuple[Int64, Int64]:
        return suppress(T_cloud_tcp, order, suppression, options.top_k)

    return kept_of(order, score, options, thinned, counts)


def kept_of(
    order: Int64,
    score: NDArray[np.floating],
    options: DetectOptions,
    thinned: Callable[[Int64, Suppression], tuple[Int64, Int64]],
    counts: dict[str, int],
) -> tuple[Int64, NDArray[np.int8]]:
    """What is left of ordered candidates without low scores, near duplicates and all after top_k.

    Args:
        order: (E,) rows, best first.
        score: (E,) probabilities.
        options: min_score, suppression and top_k.
        thinned: Tells rows in their order, of which near duplicates are dropped, and the dropped.
        counts: Gets the number of candidates left after each step.

    Returns:
        As `select`.
    """
    outcome = np.full(len(score), CODE[Outcome.BEYOND_TOP_K])
    good = score[order] >= options.min_score
    outcome[order[~good]] = CODE[Outcome.LOW_SCORE]
    order, dropped = order[good], order[:0]
    counts["above_min_score"] = len(order)
    if options.suppression is not None:
        order, dropped = thinned(order, options.suppression)
    order = order[: options.top_k]
    outcome[dropped], outcome[order] = CODE[Outcome.SUPPRESSED], CODE[Outcome.RETURNED]
    counts["suppressed"], counts["returned"] = len(dropped), len(order)
    return order, outcome
