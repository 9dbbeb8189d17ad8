"""The arithmetic of the measurements."""

from collections import Counter

import numpy as np
import pytest
from benchmarks import curves, load, measuring, soak, speed


def test_variants_take_turns_and_are_compared_round_by_round() -> None:
    order: list[str] = []
    times = measuring.interleaved(
        {name: lambda name=name: order.append(name) for name in ("a", "b")}, runs=2
    )
    assert order == ["a", "b"] * 3
    assert {name: len(seconds) for name, seconds in times.items()} == {"a": 2, "b": 2}
    compared = measuring.compare({"x": [1.0, 2.0, 1.0], "y": [3.0, 4.0, 9.0]}, "x", "y")
    assert compared == {"seconds": {"x": 1.0, "y": 4.0}, "times_faster": 3.0, "rounds": 3}


def test_a_readme_without_markers_is_refused(tmp_path) -> None:
    page = tmp_path / "README.md"
    page.write_text("nothing")
    with pytest.raises(ValueError, match="bench:begin"):
        speed.write_table(page, {})


def test_peak_memory_is_that_of_the_run_alone() -> None:
    large = curves.peak_memory(lambda: np.ones(50_000_000))  # 400 MB, let go again
    small = curves.peak_memory(lambda: np.ones(1_000))
    assert large - small > 300


def test_load_tells_answers_from_refusals_and_the_server_from_the_detector() -> None:
    samples = [load.Sample(0.1 * (row + 1), 0.04, "OK") for row in range(4)]
    samples += [load.Sample(0.01, None, "OverloadedError"), load.Sample(2.0, None, "DeadlineError")]
    found = load.summary(samples)
    assert found["codes"] == {"OK": 4, "OverloadedError": 1, "DeadlineError": 1}
    assert found["answered_ms"]["p50"] == 250.0
    assert found["beyond_the_detector_ms"]["max"] == 360.0
    assert found["refused_ms"]["max"] == 2000.0
    assert load.summary([])["answered_ms"] is None


def test_an_open_loop_does_not_wait_for_answers() -> None:
    task = load.Task("", 1, start=100.0, seconds=50.0, rate=40.0)
    due = list(load.due_moments(task))
    assert due == list(load.due_moments(task))
    assert len(due) == pytest.approx(2000, rel=0.1)
    assert 100.0 < due[0] <= due[-1] < 150.0


def test_what_a_soak_sends() -> None:
    plans = list(soak.plans(4000, seed=0))
    kinds = Counter(plan.kind for plan in plans)
    for kind in ("malformed", "cancelled"):
        assert kinds[kind] == pytest.approx(200, rel=0.25)
    assert min(plan.size for plan in plans) < 50
    assert max(plan.size for plan in plans) > 15_000
    assert not np.array_equal(plans[0].points()[:30], plans[1].points()[:30])


def test_a_soak_finds_faults() -> None:
    memory = [(done, 100.0 + 0.002 * done) for done in range(0, 10_001, 100)]
    assert soak.slope(memory, 10_000) == pytest.approx(2.0)
    warm = [(done, 100.0 + min(done, 1500) / 100) for done in range(0, 10_001, 100)]
    assert soak.slope(warm, 10_000) == pytest.approx(0.0, abs=1e-6)
    good = {"wrong": [], "stuck_clients": 0, "outcomes": {}, "exit_code": 0, "requests": 10_000}
    good["memory_slope_mb_per_1000"] = 0.1
    assert soak.faults(good) == []
    for change in (
        {"memory_slope_mb_per_1000": 2.0},
        {"exit_code": -9},
        {"wrong": [{}]},
        {"stuck_clients": 1},
        {"outcomes": {"rest good: no answer in time": 1}},
    ):
        assert len(soak.faults(good | change)) == 1


def test_an_answer_to_another_cloud_is_noticed() -> None:
    plan = soak.Plan(3, "good", 50, 0.0, seed=0)
    digest = soak.zlib.crc32(plan.points().tobytes())
    assert soak.outcome(plan, "OK", digest) == soak.ANSWERED
    assert soak.outcome(plan, "OK", digest ^ 1) == soak.CROSSED
    assert soak.outcome(plan, "INVALID_ARGUMENT", None) == soak.REFUSED
    assert soak.outcome(plan, "UNAVAILABLE", None) == "UNAVAILABLE"
