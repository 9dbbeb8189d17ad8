"""The arithmetic of the measurements."""

from dataclasses import replace

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
    part = {"wrong": [], "lost": 0, "health": {"refused": 0}}
    memory = [100.0, 180.0, 200.0, 200.0]
    attacks = [{"offset: 400": 9, "header: 413": 9}, {"pages": 540}]
    good = {"alone": part, "attacked": part | {"attacks": attacks, "memory_mb": memory}}
    good |= {"minutes": 10, "exit_code": 0}
    assert soak.faults(good) == []
    for change in (
        {"wrong": [{}]},
        {"lost": 1},
        {"health": {"refused": 1}},
        {"memory_mb": [100.0, 180.0, 200.0, 300.0]},
        {"attacks": [{"offset: 503": 1}, {"pages": 540}]},
        {"attacks": [{"offset: 400": 1}, {"pages": 0}]},
    ):
        assert len(soak.faults(good | {"attacked": good["attacked"] | change})) == 1
    assert len(soak.faults(good | {"exit_code": -9})) == 1


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
