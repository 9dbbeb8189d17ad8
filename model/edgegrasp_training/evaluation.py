"""How well scores separate grasps that hold from those that do not, and the model card."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import expit
from scipy.stats import rankdata

from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_training.views import table

FloatArray = NDArray[np.floating]
CURVE_ROWS = 20  # of the learning curve in the card, about


@dataclass(frozen=True)
class Evaluation:
    """A network on the validation views."""

    loss: float  # cross entropy, nats
    accuracy: float
    auroc: float
    average_precision: float
    temperature: float  # that calibrates the logits
    logit: NDArray[np.float32]  # (E,)
    label: NDArray[np.float32]  # (E,)


def evaluate_scores(logit: NDArray[np.float32], label: NDArray[np.float32]) -> Evaluation:
    """All figures of some scores.  # (E,), (E,)."""
    return Evaluation(
        cross_entropy(logit, label),
        accuracy(logit, label),
        auroc(logit, label),
        average_precision(logit, label),
        fit_temperature(logit, label),
        logit,
        label,
    )


def cross_entropy(logit: FloatArray, label: FloatArray) -> float:
    """Mean binary cross entropy, nats.  # (E,), (E,)."""
    return float(np.mean(np.logaddexp(0.0, logit) - label * logit))


def accuracy(logit: FloatArray, label: FloatArray) -> float:
    """Share of labels that `logit > 0` predicts.  # (E,), (E,)."""
    return float(np.mean((logit > 0) == (label > 0.5)))


def auroc(logit: FloatArray, label: FloatArray) -> float:
    """Chance that a success outscores a failure, ties counting half; nan with one class."""
    positive = label > 0.5
    successes, failures = int(positive.sum()), int((~positive).sum())
    if successes == 0 or failures == 0:
        return float("nan")
    ranks = rankdata(logit)
    excess = ranks[positive].sum() - successes * (successes + 1) / 2
    return float(excess / (successes * failures))


def average_precision(logit: FloatArray, label: FloatArray) -> float:
    """Area under the precision-recall curve, ties counted together; nan without a success."""
    threshold, place = np.unique(-logit, return_inverse=True)  # best first
    taken = np.cumsum(np.bincount(place, minlength=len(threshold)))
    held = np.bincount(place, weights=label, minlength=len(threshold))
    if held.sum() == 0:
        return float("nan")
    return float((held * np.cumsum(held) / taken).sum() / held.sum())


def fit_temperature(logit: FloatArray, label: FloatArray) -> float:
    """The t for which sigmoid(logit / t) has the least cross entropy."""
    logit, label = logit.astype(np.float64), label.astype(np.float64)
    best = minimize_scalar(
        lambda log_t: cross_entropy(logit / np.exp(log_t), label),
        bounds=(-2.0, 2.0),
        method="bounded",
    )
    return float(np.exp(best.x))


def reliability(
    logit: FloatArray, label: FloatArray, bins: int = 10
) -> list[tuple[float, float, int]]:
    """Mean predicted probability, observed success rate and count of each occupied bin."""
    probability = expit(logit)
    which = np.minimum((probability * bins).astype(int), bins - 1)
    inside = [which == number for number in range(bins) if (which == number).any()]
    return [(float(probability[b].mean()), float(label[b].mean()), int(b.sum())) for b in inside]


def write_model_card(
    path: Path,
    metadata: CheckpointMetadata,
    training: Mapping[str, Any],
    evaluation: Evaluation,
    log: Path,
    command: str,
) -> None:
    """Write a card in Markdown.

    The evaluation is that before calibration.
    """
    network = metadata.network
    rows = [
        ("architecture", network.architecture),
        ("crop radius", f"{network.crop_radius * 1000:g} mm"),
        *_layers(network),
        ("classifier", network.classifier_widths),
        ("voxel size", f"{metadata.voxel_size * 1000:g} mm"),
        ("gripper", metadata.gripper),
        *((name.replace("_", " "), value) for name, value in training.items()),
        ("validation loss", f"{evaluation.loss:.4f} nats"),
        ("validation accuracy", f"{100 * evaluation.accuracy:.1f} %"),
        ("validation AUROC", f"{evaluation.auroc:.4f}"),
        ("validation average precision", f"{evaluation.average_precision:.4f}"),
        ("temperature", f"{metadata.temperature:.3f}"),
    ]
    calibrated = evaluation.logit / metadata.temperature
    bins = [
        (f"{predicted:.3f}", f"{observed:.3f}", count)
        for predicted, observed, count in reliability(calibrated, evaluation.label)
    ]
    plain = [(n, ", ".join(map(str, v)) if isinstance(v, tuple | list) else v) for n, v in rows]
    lines = [f"# {metadata.name}", "", *table(("", ""), plain)]
    lines += ["", "Trained by:", "", "```", command, "```", ""]
    lines += ["Reliability of the score on the validation views:", ""]
    lines += [*table(("score", "held", "grasps"), bins), "", "During training:", "", *_curve(log)]
    path.write_text("\n".join(lines) + "\n")


def _layers(network: NetworkConfig) -> list[tuple[str, object]]:
    """What comes before the classifier."""
    if network.architecture == "hand":
        return [
            ("hand description", f"{network.description_size} numbers per edge grasp"),
            ("point encoder", f"{network.hand_widths}, {network.hand_points} points of each hand"),
        ]
    return [
        ("neighbours", network.k),
        ("convolutions", network.conv_widths),
        ("global MLPs", f"{network.global_widths_1}, {network.global_widths_2}"),
    ]


def _curve(log: Path) -> list[str]:
    """Some twenty rows of the log as a table, the last among them."""
    with log.open(newline="") as file:
        rows = list(csv.reader(file))
    head, body = [name.replace("_", " ") for name in rows[0]], rows[1:]
    every = max(1, len(body) // CURVE_ROWS)
    some = body[(len(body) - 1) % every :: every]
    return table(head, some)
