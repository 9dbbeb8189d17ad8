"""The simulation of queues, where theory knows the answer."""

import numpy as np
import pytest
from benchmarks.queueing import at_random, closed


def test_clients_that_wait_for_their_answers_share_the_workers() -> None:
    assert closed([[0.1] * 50], workers=2, clients=2) == pytest.approx([0.1] * 20_000)
    waited = closed([[0.1] * 50], workers=2, clients=8)[100:]
    assert waited == pytest.approx([0.4] * len(waited))


def test_requests_at_random_wait_as_long_as_theory_says() -> None:
    """M/M/1: the mean time of an answer is 1 / (service rate - arrival rate)."""
    times = np.random.default_rng(0).exponential(0.1, 20_000).tolist()
    for rate, mean in ((2.0, 0.125), (5.0, 0.2)):
        assert np.mean(at_random([times], 1, rate)) == pytest.approx(mean, rel=0.15)
