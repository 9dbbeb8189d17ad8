"""The arithmetic of the measurements."""

from dataclasses import replace

import pytest
from benchmarks import load, soak

from edgegrasp_client import DeadlineError, Detection, GripperOutline, InvalidRequestError


def test_load_tells_answers_from_refusals_and_the_server_from_the_detector() -> None:
    samples = [load.Sample(0.1 * (row + 1), 0.04, "OK") for row in range(4)]
    samples += [load.Sample(0.01, None, "OverloadedError"), load.Sample(2.0, None, "DeadlineError")]
    found = load.summary(samples)
    assert found["codes"] == {"OK": 4, "OverloadedError": 1, "DeadlineError": 1}
    assert found["answered_ms"]["p50"] == 250.0
    assert found["beyond_the_detector_ms"]["max"] == 360.0
    assert load.summary([])["answered_ms"] is None


def test_a_soak_finds_faults() -> None:
    memory = [(done, 100.0 + 0.002 * done) for done in range(0, 10_001, 100)]
    assert soak.slope(memory, 10_000) == pytest.approx(2.0)
    warm = [(done, 100.0 + min(done, 1500) / 100) for done in range(0, 10_001, 100)]
    assert soak.slope(warm, 10_000) == pytest.approx(0.0, abs=1e-6)
    good = {"wrong": [], "outcomes": {"": 10_000}, "exit_code": 0, "requests": 10_000}
    good["memory_slope_mb_per_1000"] = 0.1
    assert soak.faults(good) == []
    for change in (
        {"memory_slope_mb_per_1000": 2.0},
        {"exit_code": -9},
        {"wrong": [{}]},
        {"outcomes": {"": 9_999}},
    ):
        assert len(soak.faults(good | change)) == 1


def test_an_answer_to_another_cloud_is_noticed() -> None:
    plan = soak.Plan(3, "good", 50, 0.0, seed=0)
    digest = soak.zlib.crc32(plan.points().tobytes())
    hand = GripperOutline("panda", 0.0658, 0.1122)
    up = plan.points()[0]
    answer = Detection([], {"crc32": digest}, {}, "", hand, [], None, None, up, [])
    assert soak.outcome(plan, answer) == soak.ANSWERED
    assert soak.outcome(plan, replace(answer, counts={"crc32": digest ^ 1})) == soak.CROSSED
    assert soak.outcome(plan, InvalidRequestError("")) == soak.REFUSED
    assert soak.outcome(plan, DeadlineError("")) == "DeadlineError"
