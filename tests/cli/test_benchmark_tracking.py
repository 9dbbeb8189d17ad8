"""`edgegrasp benchmark-tracking`: what it reports of scenes that stand still and that move."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.test_benchmark_real import seen_box

from edgegrasp_cli.benchmark_tracking import MOTIONS, follow, simulated
from edgegrasp_cli.detect import OwnDetector


def test_the_grasp_of_a_recorded_scene_stays_where_it_is(run, tmp_path: Path) -> None:
    np.savez(tmp_path / "box.npz", **seen_box())
    shown = run(
        "benchmark-tracking", "--scenes", tmp_path, "--seconds", 0.2, "--output", tmp_path / "out"
    )
    assert "box" in shown
    figures = json.loads((tmp_path / "out" / "results.json").read_text())["box"]
    assert (figures["scenes"], figures["switches"]) == (1, 0)
    assert figures["mm_95"] < 3.0
    assert figures["degrees_95"] < 3.0
    assert (tmp_path / "out" / "jitter.svg").read_text().startswith("<?xml")


def test_the_grasp_of_an_object_on_a_belt_moves_with_it() -> None:
    client = OwnDetector()
    scenes = simulated(None, MOTIONS["belt-10"], 1)
    _, scene = next(scenes)
    done = follow(client, scene, 0.2, clock=lambda: 0.0)
    assert np.linalg.norm(scene.moved(0.2)[:3, 3]) == pytest.approx(0.02)
    assert len(done.off) >= 3
    # The last image was taken one thirtieth of a second before, 3 mm back.
    assert max(millimetres for millimetres, _ in done.off) < 8.0
    assert scene.execute(done).keys() == {"still", "open_loop", "followed"}
    scenes.close()


def test_an_unknown_motion_is_refused_with_the_known_ones(refused) -> None:
    assert "Choose one of still, pushed" in refused("benchmark-tracking", "--motion", "fast")
