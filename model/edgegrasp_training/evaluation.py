"""Scores against outcomes: evaluation, the model card, and recalibration on a robot's outcomes.

`python -m edgegrasp_training.evaluation data/held-out --weights A.safetensors B.safetensors`
compares weights of hand networks on labelled views that none of them was trained on: by kind of
scene, depth camera and object, and by whether the camera saw the far side.
"""

import argparse
import json
import re
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit
from scipy.special import logit as logit_of
from scipy.stats import mannwhitneyu

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats
from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_model.networks.checkpoint import load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.networks.hand import UNSEEN_NUMBERS, HandBatch
from edgegrasp_model.ranking import MAX_HIDDEN_DEPTH
from edgegrasp_training.examples import pack_hands, tried_grasps
from edgegrasp_training.views import find_views, load_view, scene_of, table

TENTHS = tuple(round(0.1 * number, 1) for number in range(11))
BIN_EDGES = (0.0, 0.1, 0.3, 0.5, 0.8, 0.9, 0.95, 1.0)  # edges of the score ranges in a comparison
SCORES = (1e-4, 1.0 - 1e-4)  # scores are clipped to this range
# Standard deviations of the prior of log(scale) and of shift: few outcomes change little.
PRIOR_SCALE, PRIOR_SHIFT = 0.5, 1.5
FEW = 25


@dataclass(frozen=True)
class ScoreMetrics:
    """A network on the validation views."""

    loss: float  # cross entropy, nats
    accuracy: float
    auroc: float
    temperature: float  # calibrates the logits
    logit: Float32  # (E,)
    label: Float32  # (E,)


def evaluate_scores(logit: Float32, label: Float32) -> ScoreMetrics:
    """All figures for scores (E,) and outcomes (E,)."""
    accuracy = float(np.mean((logit > 0) == (label > 0.5)))
    loss, rank = cross_entropy(logit, label), auroc(logit, label)
    return ScoreMetrics(loss, accuracy, rank, fit_temperature(logit, label), logit, label)


def cross_entropy(logit: Floats, label: Floats) -> float:
    """Mean binary cross entropy of logits (E,) and labels (E,), nats."""
    return float(np.mean(np.logaddexp(0.0, logit) - label * logit))


def auroc(logit: Floats, label: Floats) -> float:
    """Probability that a success outscores a failure, ties counting half; nan for one class."""
    held = label > 0.5
    if held.all() or not held.any():
        return float("nan")
    pairs = mannwhitneyu(logit[held], logit[~held], method="asymptotic").statistic
    return float(pairs / (held.sum() * (~held).sum()))


def fit_temperature(logit: Floats, label: Floats) -> float:
    """The t that minimises the cross entropy of sigmoid(logit / t); near 1 for few labels."""
    logit, label = logit.astype(np.float64), label.astype(np.float64)

    def cost(log_t: float) -> float:
        prior = (log_t / PRIOR_SCALE) ** 2 / 2
        return cross_entropy(logit / np.exp(log_t), label) + prior / len(label)

    return float(np.exp(minimize_scalar(cost, bounds=(-2.0, 2.0)).x))


class ReliabilityBin(NamedTuple):
    """Grasps whose scores lie between two edges."""

    score: float  # mean
    held: float  # share that held
    number: int


def reliability(
    score: Floats, held: NDArray[np.generic], edges: tuple[float, ...] = TENTHS
) -> dict[float, ReliabilityBin]:
    """Outcomes (E,) in each non-empty range of scores (E,), by its lower edge."""
    place = np.digitize(score, edges[1:-1])
    ranges = {edges[k]: place == k for k in np.unique(place)}
    return {
        low: ReliabilityBin(float(score[mine].mean()), float(held[mine].mean()), int(mine.sum()))
        for low, mine in ranges.items()
    }


def calibration_error(score: Floats, held: NDArray[np.generic]) -> float:
    """Expected calibration error (ECE) over ten ranges of equal width."""
    ranges = reliability(score, held).values()
    return sum(each.number * abs(each.score - each.held) for each in ranges) / len(score)


def write_model_card(
    path: Path, metadata: CheckpointMetadata, evaluation: ScoreMetrics, command: str
) -> None:
    """Write a card in Markdown, with the evaluation before calibration."""
    network = {name: value for name, value in asdict(metadata.network).items() if value != ()}
    facts = network | {"voxel_size": metadata.voxel_size, "gripper": metadata.gripper}
    facts |= metadata.training | {
        "validation_loss": f"{evaluation.loss:.4f} nats",
        "validation_accuracy": f"{100 * evaluation.accuracy:.1f} %",
        "validation_AUROC": f"{evaluation.auroc:.4f}",
        "temperature": f"{metadata.temperature:.3f}",
    }
    rows = [
        (name.replace("_", " "), ", ".join(map(str, v)) if isinstance(v, tuple | list) else v)
        for name, v in facts.items()
    ]
    ranges = reliability(expit(evaluation.logit / metadata.temperature), evaluation.label)
    bins = [(f"{score:.3f}", f"{held:.3f}", count) for score, held, count in ranges.values()]
    lines = [f"# {metadata.name}", "", *table(("", ""), rows)]
    lines += ["", "Trained by:", "", "```", command, "```", ""]
    lines += ["Reliability of the score on the validation views:", ""]
    lines += table(("score", "held", "grasps"), bins)
    path.write_text("\n".join(lines) + "\n")


# Learning from the robot: fit p = sigmoid(scale * logit + shift) (Platt scaling). A hundred or so
# outcomes determine no more than these two numbers. The order of grasps does not change.


def read_outcomes(path: Path, digest: str) -> tuple[Float64, Float64]:
    """Logits (N,) of executed grasps, and 1 or 0 (N,) whether they held, from a JSON lines file.

    Only outcomes of the weights with this digest are read.

    Raises:
        ValueError: The file has no such outcome, or a line that is not an outcome.
    """
    scores, held = [], []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        try:
            outcome = json.loads(line)
            score, success = float(outcome["score"]), float(outcome["held"])
            if not 0.0 <= score <= 1.0 or success not in (0.0, 1.0):
                raise ValueError(f"score {score}, held {success}")
            if outcome["digest"] == digest:
                scores.append(score)
                held.append(success)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}, line {number}: {error!r}. It is not an outcome.") from None
    if not scores:
        weights = digest[:12]
        raise ValueError(f"{path}: no outcome of the weights {weights}. Name those that scored.")
    return logit_of(np.clip(scores, *SCORES)), np.array(held)


def fit_scale_and_shift(logit: Float64, held: Float64) -> tuple[float, float]:
    """The most probable scale and shift of the logits, given the outcomes."""

    def cost(parameters: Float64) -> float:
        log_scale, shift = parameters
        prior = (log_scale / PRIOR_SCALE) ** 2 / 2 + (shift / PRIOR_SHIFT) ** 2 / 2
        fitted = np.exp(log_scale) * logit + shift
        return len(logit) * cross_entropy(fitted, held) + float(prior)

    log_scale, shift = minimize(cost, np.zeros(2)).x
    return float(np.exp(log_scale)), float(shift)


def recalibrate(weights: Path, outcomes_file: Path, folder: Path) -> str:
    """Write NAME-robot.safetensors, calibrated on outcomes; returns a sentence about the result."""
    network, metadata = load_checkpoint(weights)
    logit, held = read_outcomes(outcomes_file, metadata.digest)
    scale, shift = fit_scale_and_shift(logit, held)
    share = float(held.mean())
    old_scale, old_shift = metadata.training.get("rescaled_by_outcomes", (1.0, 0.0))
    training = metadata.training | {
        "outcomes": len(held),
        "outcomes_held": round(share, 3),
        "rescaled_by_outcomes": [scale * old_scale, scale * old_shift + shift],
        "recalibrated_from_digest": metadata.digest,
    }
    name = f"{metadata.name}-robot"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.safetensors"
    save_checkpoint(path, network, replace(metadata, name=name, training=training))
    before, after = cross_entropy(logit, held), cross_entropy(scale * logit + shift, held)
    few = f" Warning: fewer than {FEW} outcomes are not reliable." if len(held) < FEW else ""
    return (
        f"{len(held)} outcomes, {share:.2f} held: scores' cross entropy {before:.3f} -> "
        f"{after:.3f} (scale {scale:.2f}, shift {shift:+.2f}): {path}.{few}"
    )


# Comparing weights


class Scored(NamedTuple):
    """Labelled grasps of some views, and the scores of several networks."""

    groups: NDArray[np.str_]  # (3, E) kinds of scene, depth camera and object
    far_side_hidden: Bools  # (E,)
    held: Bools  # (E,)
    logit: Float64  # (W, E) calibrated, of each network


def score_views(paths: list[Path], weights: list[Path]) -> Scored:
    """Score the labelled grasps of views; ValueError without grasps or for other networks."""
    networks = [load_checkpoint(path) for path in weights]
    if any(metadata.network.architecture != "hand" for _, metadata in networks):
        raise ValueError("weights: got another network. Name hand networks, e.g. edgegrasp-plus.")
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
            scale, shift = metadata.training.get("rescaled_by_outcomes", (1.0, 0.0))
            logits.append(scale * logit / metadata.temperature + shift)
        hidden = (description[:, UNSEEN_NUMBERS] > MAX_HIDDEN_DEPTH).any(dim=1).numpy()
        scene = f"{scene_of(path).split('_')[0]} scenes"
        sensor = f"{view.sensor or 'unknown'} camera"
        unknown = np.full(len(view.success), "unknown-0")
        names = unknown if view.targets is None else view.targets
        families = map(family_of, names[view.tried()[grasps.candidates.pair]])
        groups = np.array([(scene, sensor, family) for family in families]).T
        parts.append(Scored(groups, hidden, packed.label.numpy() > 0.5, np.stack(logits)))
    if not parts:
        raise ValueError("data: no grasp of these views was tried. Send others.")
    return Scored(*(np.concatenate(column, axis=-1) for column in zip(*parts, strict=True)))


def family_of(name: str) -> str:
    """Kind of the object with this name; "" means that no object was between the fingers."""
    household = re.fullmatch(r"([a-z]+)-\d+", name)
    kind = "computed" if name.startswith(("made-", "blob_")) else "scanned"
    return household[1] if household else f"{kind} object" if name else "no object"


def reliability_tables(scored: Scored, names: list[str]) -> str:
    """Markdown tables: figures for each group of grasps, and the share that held, by score."""
    groups = {"all": np.ones(len(scored.held), dtype=bool)}
    groups |= {name: row == name for row in scored.groups for name in np.unique(row)}
    groups |= {"far side hidden": scored.far_side_hidden, "far side seen": ~scored.far_side_hidden}
    rows = []
    for group, mine in groups.items():
        held = scored.held[mine]
        for name, logit in zip(names, scored.logit[:, mine], strict=True):
            if not mine.any():
                continue
            score = expit(logit)
            shares = (f"{100 * v.mean():.1f} %" for v in (score, held))
            loss, brier = cross_entropy(logit, held.astype(float)), np.square(score - held).mean()
            figures = (f"{v:.3f}" for v in (loss, brier, calibration_error(score, held)))
            rows.append((group, name, len(held), *shares, *figures))
    head = ("grasps", "weights", "number", "mean score", "held", "loss", "Brier", "ECE")
    found = [reliability(expit(logit), scored.held, BIN_EDGES) for logit in scored.logit]
    cells = [
        {low: f"{100 * each.held:.1f} % of {each.number}" for low, each in one.items()}
        for one in found
    ]
    ranges = [(f"from {low:g}", *(one.get(low, "-") for one in cells)) for low in BIN_EDGES[:-1]]
    by_range = table(("score", *(f"{name}: held" for name in names)), ranges)
    return "\n".join([*table(head, rows), "", *by_range])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m edgegrasp_training.evaluation")
    parser.add_argument("data", type=Path, nargs="+", help="folders of views")
    parser.add_argument("--weights", type=Path, nargs="+", required=True)
    given = parser.parse_args()
    try:
        scored = score_views(find_views(given.data), given.weights)
    except (EdgeGraspError, ValueError, OSError) as error:
        sys.exit(f"{parser.prog}: {error}")
    sys.stdout.write(reliability_tables(scored, list(map(str, given.weights))) + "\n")


if __name__ == "__main__":
    main()
