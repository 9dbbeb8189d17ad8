"""How well scores separate grasps that hold from grasps that do not."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import expit
from scipy.stats import rankdata

FloatArray = NDArray[np.floating]


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
    """Mean, over the successes, of the share of successes among what scores no less; ties together.

    nan where nothing succeeded.
    """
    threshold, place = np.unique(-logit, return_inverse=True)  # best first
    taken = np.cumsum(np.bincount(place, minlength=len(threshold)))
    held = np.bincount(place, weights=label, minlength=len(threshold))
    if held.sum() == 0:
        return float("nan")
    return float((held * np.cumsum(held) / taken).sum() / held.sum())


def fit_temperature(logit: FloatArray, label: FloatArray) -> float:
    """The t for which sigmoid(logit / t) is best calibrated: least cross entropy."""
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
    return [
        (
            float(probability[which == b].mean()),
            float(label[which == b].mean()),
            int((which == b).sum()),
        )
        for b in range(bins)
        if (which == b).any()
    ]
