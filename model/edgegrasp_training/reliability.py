"""How reliable scores are: by kind of scene, and by whether the camera saw the far side.

`python -m edgegrasp_training.reliability data/held-out --weights A.safetensors B.safetensors`
compares weights of hand networks on labelled views that none of them has learned from.
"""

import argparse
import sys
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit

from edgegrasp_model.hand_description import BEYOND
from edgegrasp_model.networks.checkpoint import load_checkpoint
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.ranking import HIDDEN
from edgegrasp_training.evaluation import cross_entropy
from edgegrasp_training.examples import pack_hands, tried_grasps
from edgegrasp_training.views import find_views, load_view, scene_of, split_by_scene, table

EDGES = (0.0, 0.1, 0.3, 0.5, 0.8, 0.9, 0.95, 1.0)  # of the ranges of scores
BINS = 10  # of equal width, for the calibration error


class Scored(NamedTuple):
    """Labelled grasps of some views, and the scores of several networks."""

    kind: NDArray[np.str_]  # (E,) of scene
    far_side_hidden: NDArray[np.bool_]  # (E,)
    held: NDArray[np.bool_]  # (E,)
    logit: NDArray[np.float64]  # (W, E) calibrated, of each network


def score_views(paths: list[Path], weights: list[Path]) -> Scored:
    """Score the labelled grasps of views.

    Raises:
        InvalidCheckpoint: Weights cannot be read.
        ValueError: They are not of hand networks.
    """
    networks = [load_checkpoint(path) for path in weights]
    if any(metadata.network.architecture != "hand" for _, metadata in networks):
        raise ValueError("weights: hand networks are compared, such as edgegrasp-plus. Name those.")
    parts = []
    for path in paths:
        view, logits = load_view(path), []
        if len(view.tried()) == 0:
            continue
        for network, metadata in networks:
            grasps = tried_grasps(view, metadata.network)
            packed = pack_hands(grasps, grasps.balls(), metadata.network)
            assert isinstance(packed.batch, HandBatch)
            description = packed.batch.description
            with torch.inference_mode():
                logit = network(packed.batch).double().numpy()
            logits.append(logit / metadata.temperature)
        hidden = (description[:, BEYOND] > HIDDEN).any(dim=1).numpy()
        kind = np.full(len(hidden), scene_of(path).split("_")[0])
        parts.append(Scored(kind, hidden, packed.label.numpy() > 0.5, np.stack(logits)))
    return Scored(*(np.concatenate(column, axis=-1) for column in zip(*parts, strict=True)))


def calibration_error(score: NDArray[np.float64], held: NDArray[np.bool_]) -> float:
    """Mean distance of score and share that held over BINS of equal width.  # (E,), (E,)."""
    number = np.minimum((score * BINS).astype(int), BINS - 1)
    total = np.bincount(number, minlength=BINS)
    apart = np.bincount(number, score, BINS) - np.bincount(number, held, BINS)
    return float(np.abs(apart).sum() / total.sum())


def reliability_tables(scored: Scored, names: list[str]) -> str:
    """Markdown: figures of each group of grasps, and how many of each range of scores held."""
    groups = {"all": np.ones(len(scored.held), dtype=bool)}
    groups |= {f"{kind} scenes": scored.kind == kind for kind in np.unique(scored.kind)}
    groups |= {"far side hidden": scored.far_side_hidden, "far side seen": ~scored.far_side_hidden}
    score = expit(scored.logit)
    rows = []
    for group, mine in groups.items():
        if not mine.any():
            continue
        held = scored.held[mine]
        for row, name in enumerate(names):
            loss = cross_entropy(scored.logit[row, mine], held.astype(np.float64))
            brier = np.square(score[row, mine] - held).mean()
            error = calibration_error(score[row, mine], held)
            shares = (f"{100 * v.mean():.1f} %" for v in (score[row, mine], held))
            figures = (f"{v:.3f}" for v in (loss, brier, error))
            rows.append((group, name, len(held), *shares, *figures))
    head = ("grasps", "weights", "number", "mean score", "held", "loss", "Brier", "ECE")
    lines = table(head, rows)
    ranges = [
        (f"{low:g} to {high:g}", *(_held_of(each, scored.held, low, high) for each in score))
        for low, high in pairwise(EDGES)
    ]
    return "\n".join([*lines, "", *table(("score", *(f"{n}: held" for n in names)), ranges)])


def _held_of(score: NDArray[np.float64], held: NDArray[np.bool_], low: float, high: float) -> str:
    mine = held[(score >= low) & ((score < high) | (high == EDGES[-1]))]
    return f"{100 * mine.mean():.1f} % of {len(mine)}" if len(mine) else "-"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m edgegrasp_training.reliability")
    parser.add_argument("data", type=Path, nargs="+", help="folders of views")
    parser.add_argument("--weights", type=Path, nargs="+", required=True)
    parser.add_argument("--validation-share", type=float, help="only what `train` kept apart")
    given = parser.parse_args()
    paths = find_views(given.data)
    if given.validation_share is not None:
        paths = split_by_scene(paths, given.validation_share, seed=0)[1]
    names = list(map(str, given.weights))
    sys.stdout.write(reliability_tables(score_views(paths, given.weights), names) + "\n")


if __name__ == "__main__":
    main()
