import numpy as np
import pytest
from scipy.special import expit

from edgegrasp_training.evaluation import (
    accuracy,
    auroc,
    cross_entropy,
    evaluate_scores,
    fit_temperature,
    reliability,
)


@pytest.mark.parametrize("seed", range(3))
def test_auroc_is_the_share_of_pairs_in_the_right_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    logit, label = rng.integers(0, 5, 30).astype(float), rng.integers(0, 2, 30).astype(float)
    label[:2] = 0, 1
    pairs = np.subtract.outer(logit[label == 1], logit[label == 0])
    expected = ((pairs > 0) + 0.5 * (pairs == 0)).mean()
    assert auroc(logit, label) == pytest.approx(expected)


def test_auroc_of_one_class_is_undefined() -> None:
    assert np.isnan(auroc(np.zeros(3), np.ones(3)))


def test_loss_and_accuracy_of_known_scores() -> None:
    logit, label = np.array([0.0, np.log(3), -np.log(3)]), np.array([1.0, 1.0, 1.0])
    assert cross_entropy(logit, label) == pytest.approx(-np.log([0.5, 0.75, 0.25]).mean())
    assert accuracy(logit, label) == pytest.approx(1 / 3)


def test_the_temperature_undoes_overconfidence() -> None:
    rng = np.random.default_rng(0)
    honest = rng.normal(size=20_000)
    label = (rng.random(20_000) < expit(honest)).astype(float)
    assert fit_temperature(honest * 3, label) == pytest.approx(3, rel=0.1)
    found = evaluate_scores((honest * 3).astype(np.float32), label.astype(np.float32))
    for predicted, observed, _ in reliability(found.logit / found.temperature, found.label):
        assert predicted == pytest.approx(observed, abs=0.05)
    assert sum(count for _, _, count in reliability(found.logit, found.label)) == 20_000
