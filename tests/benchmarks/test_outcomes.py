import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks import outcomes


@pytest.mark.parametrize(("friction", "most"), [(0.75, 1.0), (0.01, 0.3)])
def test_slippery_fingers_hold_less(friction: float, most: float, tmp_path: Path) -> None:
    file = tmp_path / "outcomes.jsonl"
    outcomes.try_grasps(1, 0, file, friction, 0.001)
    held = [json.loads(line)["held"] for line in file.read_text().splitlines()]
    assert len(held) > 3
    assert most - 0.3 <= np.mean(held) <= most


def test_outcomes_mend_scores_that_promise_too_much(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(outcomes, "DRAWS", 10)
    rng = np.random.default_rng(0)
    file = tmp_path / "outcomes.jsonl"
    lines = [
        {"scene": number // 5, "score": score, "held": bool(rng.random() < score - 0.3)}
        for number, score in enumerate(rng.uniform(0.7, 1.0, 600).tolist())
    ]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    before, *_, after = outcomes.table(file)
    assert (before["outcomes"], after["outcomes"]) == (0, 200)
    assert before["predicted_minus_held"][0] == pytest.approx(0.3, abs=0.05)
    assert abs(after["predicted_minus_held"][0]) < 0.1
    assert after["cross_entropy"][0] < before["cross_entropy"][0] - 0.1
