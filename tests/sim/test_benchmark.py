import importlib
import json
import multiprocessing
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from examples.your_planner import plan

from edgegrasp_sim.benchmark import BenchmarkConfig, RoundRunner, manifest, run_benchmark
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.results import ResultFolder, attempts_digest

PAPER = load_protocol("edgegrasp")
TWO_OBJECTS = replace(PAPER, scene=replace(PAPER.scene, num_objects=(2,)))

# Called, it gives the planner; spawned workers can import it.
make_planner = partial(partial, plan)


DIES_ONCE = """
import os, signal
from pathlib import Path
from examples import your_planner

MARK = Path(__file__).with_suffix(".died")

def plan(observation, seed):
    if not MARK.exists():
        MARK.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return your_planner.plan(observation, seed)
"""


@pytest.fixture(scope="module")
def alone() -> tuple[BenchmarkConfig, str]:
    config = BenchmarkConfig(SceneKind.PACKED, 2, (0, 3), TWO_OBJECTS)
    rounds = run_benchmark(config, make_planner)
    assert [(done.seed, done.index) for done in rounds] == [(0, 0), (0, 1), (3, 0), (3, 1)]
    return config, attempts_digest(rounds)


def test_rounds_of_a_crashed_worker_are_run_again_and_workers_change_nothing(
    alone: tuple[BenchmarkConfig, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, digest = alone
    (tmp_path / "dies_once.py").write_text(DIES_ONCE)
    monkeypatch.syspath_prepend(tmp_path)  # workers get it, too
    planner = importlib.import_module("dies_once").plan
    rounds = run_benchmark(config, partial(partial, planner), workers=2)
    assert (tmp_path / "dies_once.died").exists()
    assert attempts_digest(rounds) == digest


def test_the_manifest_holds_what_decides_the_figures(engine: str) -> None:
    config = BenchmarkConfig(SceneKind.PACKED, 2, protocol=TWO_OBJECTS, engine=engine)
    facts = json.loads(json.dumps(manifest(config, {"name": "top-down"})))
    run = facts["run"]
    assert run["protocol"]["camera"]["polar_degrees"] == [45.0, 60.0]
    assert run["protocol"]["version"] == 3
    assert run["engine"] == engine
    assert run["constants"]["gravity"] == 9.81
    assert len(run["objects"]["digest"]) == 64
    assert facts["versions"][engine]
    assert facts["host"]["platform"]


def test_wrong_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rounds is 0"):
        BenchmarkConfig(SceneKind.PILE, rounds=0)
    with pytest.raises(ValueError, match=r"seeds is \(-1,\)"):
        BenchmarkConfig(SceneKind.PILE, rounds=1, seeds=(-1,))
    with pytest.raises(ValueError, match="each seed once"):
        BenchmarkConfig(SceneKind.PILE, rounds=1, seeds=(1, 1))
    config = BenchmarkConfig(SceneKind.PILE, rounds=1, objects=tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no \*\.urdf, \*\.obj"):
        run_benchmark(config, make_planner, workers=2)
    with pytest.raises(ValueError, match="workers is 0"):
        run_benchmark(replace(config, objects=None), make_planner, workers=0)


def test_a_killed_run_goes_on_and_changes_nothing(alone, tmp_path) -> None:
    config, digest = alone
    folder = ResultFolder(tmp_path)
    folder.open(manifest(config, {"name": "top-down"}))
    process = multiprocessing.get_context("spawn").Process(
        target=run_benchmark, args=(config, make_planner), kwargs={"folder": folder}
    )
    process.start()
    while not list(folder.path.glob("rounds/*.json")):
        assert process.is_alive() or process.exitcode == 0
        time.sleep(0.005)
    process.kill()
    process.join()
    kept = len(folder.rounds())
    assert 1 <= kept <= 4
    again: list[object] = []
    rounds = run_benchmark(config, make_planner, folder=folder, on_round=again.append)
    assert len(again) == 4 - kept
    assert attempts_digest(rounds) == attempts_digest(folder.rounds()) == digest
    with pytest.raises(ValueError, match="different planner"):
        folder.open(manifest(config, {"name": "other"}))


def test_a_missing_ray_or_cluster_is_named(alone, monkeypatch) -> None:
    config, _ = alone
    with pytest.raises(ValueError, match="differ between the machines"):
        RoundRunner(config, make_planner, "another digest")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match=r"ray is not .*edgegrasp\[ray\]"):
        run_benchmark(config, make_planner, ray="local")

    class Ray:
        @staticmethod
        def init(**_: object) -> None:
            raise ConnectionError("nobody answers")

    monkeypatch.setitem(sys.modules, "ray", Ray)
    with pytest.raises(RuntimeError, match=r"no Ray cluster at '127\.0\.0\.1:1': nobody"):
        run_benchmark(config, make_planner, ray="127.0.0.1:1")
