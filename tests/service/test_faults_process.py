"""What can happen to a process: clocks that jump, a soak."""

import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


async def test_clocks_that_jump(serve, cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall clock goes back a day, and on by thirty years, each time it is read."""
    running = await serve()
    real, jumps = time.time, itertools.cycle([-86400.0, 3600.0, 1e9, -1e9])
    monkeypatch.setattr(time, "time", lambda: real() + next(jumps))
    monkeypatch.setattr(time, "time_ns", lambda: int(time.time() * 1e9))
    for transport in ("grpc", "rest"):
        client = running.connect(transport)
        for _ in range(5):
            # Without a deadline: gRPC works one out from two clocks, of which one jumps here.
            assert (await client.detect(cloud)).fine
    await running.until(lambda: len(running.calls) == 10)
    for call in running.calls:
        assert all(0.0 <= seconds < 20.0 for seconds in (call.seconds, *call.stages.values()))


def test_a_short_soak(tmp_path: Path) -> None:
    """Beside attacks each request comes to something, none to another's; health is answered."""
    command = [sys.executable, "-m", "benchmarks.soak", "--minutes", "0.2", "--clients", "3"]
    done = subprocess.run(
        [*command, "--output", tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | {"SOAK_PATIENCE": "10"},  # on a busy machine
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "soak.json").read_text())
    assert found["faults"] == []
    assert {"grpc good: answered", "stream good: answered", "rest good: answered"} <= {
        *found["alone"]["outcomes"],
        *found["attacked"]["outcomes"],
    }
    assert found["attacked"]["attacks"][0].keys() == {"json: 400", "x-npy: 400", "x-npz: 400"}
