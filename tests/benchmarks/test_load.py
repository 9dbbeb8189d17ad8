"""The arithmetic of the load and soak measurements."""

import importlib
import time
from collections import Counter
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(ROOT)

    def load(name: str) -> ModuleType:
        return importlib.import_module(f"benchmarks.{name}")

    return load


def test_a_summary_tells_accepted_from_refused(module) -> None:
    samples = [(0.0, 0.1 * (row + 1), "OK") for row in range(4)]
    samples += [(0.0, 0.01, "RESOURCE_EXHAUSTED"), (0.0, 2.0, "DEADLINE_EXCEEDED")]
    found = module("load").summary(samples, start=0.0, seconds=2.0)
    assert found["requests"] == 6
    assert found["codes"] == {"DEADLINE_EXCEEDED": 1, "OK": 4, "RESOURCE_EXHAUSTED": 1}
    assert found["accepted_per_second"] == 2.0
    assert found["accepted_ms"]["p50"] == 250.0
    assert found["accepted_ms"]["max"] == 400.0
    assert found["refused_ms"]["p99"] == 10.0


def test_answers_that_come_late_do_not_count_for_more_than_their_time(module) -> None:
    samples = [(0.0, 4.0, "OK"), (0.0, 4.0, "OK")]
    assert module("load").summary(samples, start=0.0, seconds=1.0)["accepted_per_second"] == 0.5


def test_overhead_while_the_machine_does_little_else(module) -> None:
    load = module("load")
    alone = [0.020] * (2 * load.BLOCK) + [0.049] * load.BLOCK
    answers = [0.030] * load.BLOCK + [0.023] * load.BLOCK + [0.050] * load.BLOCK
    assert load.quietest_blocks(alone, answers) == pytest.approx(3.0)
    assert load.quietest_blocks(alone[:5], answers[:5]) is None


def test_a_process_apart_measures_when_asked_and_says_when_it_ended(module) -> None:
    with module("apart").Apart("benchmarks.in_process", "0") as apart:
        wall, processors = apart.seconds()
        assert 0.0 < processors < 10.0
        assert wall > 0.0
    with pytest.raises(RuntimeError, match="nothing_of_the_kind"):
        module("apart").Apart("benchmarks.nothing_of_the_kind")


def test_percentiles_of_nothing(module) -> None:
    assert module("load").percentiles([]) is None


def test_an_open_loop_does_not_wait_for_answers(module) -> None:
    client = module("load_client")
    task = client.Task("grpc", "", 1, {}, seconds=50.0, seed=0, start=100.0, rate=40.0)
    due = list(client._schedule(task))
    assert due == list(client._schedule(task))
    assert len(due) == pytest.approx(2000, rel=0.1)
    assert due == sorted(due)
    assert due[0] > 100.0
    assert due[-1] < 150.0


def test_a_closed_loop_goes_on_to_its_end(module) -> None:
    client = module("load_client")
    now = time.monotonic()
    ended = client.Task("grpc", "", 1, {}, seconds=1.0, seed=0, start=now - 2.0)
    assert list(client._schedule(ended)) == []
    later = client.Task("grpc", "", 1, {}, seconds=1.0, seed=0, start=now + 60.0)
    assert next(client._schedule(later)) == now + 60.0


def test_clouds_have_the_points_asked_for(module) -> None:
    cloud = module("senders").cloud
    for points in (200, 3000, 20_000):
        assert cloud(points, seed=0).shape == (points, 3)
    assert np.array_equal(cloud(500, seed=1), cloud(500, seed=1))


def test_what_a_soak_sends(module) -> None:
    plans = list(module("soak").plans(4000, seed=0))
    kinds = Counter(plan.kind for plan in plans)
    assert [plan.number for plan in plans] == list(range(4000))
    for kind in ("malformed", "cancelled"):
        assert kinds[kind] == pytest.approx(200, rel=0.25)
    assert min(plan.size for plan in plans) < 50
    assert max(plan.size for plan in plans) > 15_000
    assert not np.array_equal(plans[0].points()[:30], plans[1].points()[:30])


def test_memory_that_grows_is_a_fault(module) -> None:
    soak = module("soak")
    memory = [(done, 100.0 + 0.002 * done) for done in range(0, 10_001, 100)]
    assert soak.slope(memory, 10_000) == pytest.approx(2.0)
    # A rise while it warms up is none.
    warm = [(done, 100.0 + min(done, 1500) / 100) for done in range(0, 10_001, 100)]
    assert soak.slope(warm, 10_000) == pytest.approx(0.0, abs=1e-6)
    good = {"wrong": [], "stuck_clients": 0, "outcomes": {}, "exit_code": 0, "requests": 10_000,
            "memory_slope_mb_per_1000": 0.1}  # fmt: skip
    assert soak.faults(good) == []
    for change in (
        {"memory_slope_mb_per_1000": 2.0},
        {"exit_code": -9},
        {"wrong": [{}]},
        {"stuck_clients": 1},
        {"outcomes": {"rest good: no answer in time": 1}},
    ):
        assert len(soak.faults(good | change)) == 1


def test_an_answer_to_another_cloud_is_noticed(module) -> None:
    clients = module("soak_clients")
    plan = clients.Plan(3, "good", 50, 0.0, seed=0)
    digest = clients.zlib.crc32(plan.points().tobytes())
    assert clients.outcome(plan, "OK", digest) == clients.ANSWERED
    assert clients.outcome(plan, "OK", digest ^ 1) == clients.CROSSED
    assert clients.outcome(plan, "INVALID_ARGUMENT", None) == clients.REFUSED
    assert clients.outcome(plan, "UNAVAILABLE", None) == "UNAVAILABLE"
