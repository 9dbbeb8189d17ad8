"""Compare two benchmarks, paired by scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from edgegrasp_sim.intervals import paired_difference, wilson
from edgegrasp_sim.results import Counts

if TYPE_CHECKING:
    from edgegrasp_sim.results import ResultFolder

PAIRED = ("scene", "protocol", "objects", "constants")  # what has to be the same in both


def compare(first: ResultFolder, second: ResultFolder, seed: int = 0) -> dict[str, Any]:
    """Differences of GSR and DR over the scenes that two benchmarks share.

    Args:
        first: to compare with.
        second: what is compared.
        seed: of the bootstrap.

    Returns:
        Figures ready for JSON: for `grasp_success_rate` and `declutter_rate` the value and
        interval of each and the difference, second minus first, with its paired 95 % interval.

    Raises:
        FileNotFoundError: a folder holds no benchmark.
        ValueError: they were run under different conditions or share no scene.
    """
    runs = [folder.manifest()["run"] for folder in (first, second)]
    if different := [name for name in PAIRED if runs[0][name] != runs[1][name]]:
        raise ValueError(
            f"{first.path} and {second.path} differ in {', '.join(different)}; only benchmarks "
            "with the same scenes can be paired"
        )
    rounds = [{(r.seed, r.index): r for r in folder.rounds()} for folder in (first, second)]
    shared = sorted(rounds[0].keys() & rounds[1].keys())
    if not shared:
        raise ValueError(f"{first.path} and {second.path} share no round; use the same seeds")
    counts = [[Counts.of([run[key]]) for key in shared] for run in rounds]
    successes = np.array([[c.successes for c in run] for run in counts])
    figures: dict[str, Any] = {
        "first": runs[0]["planner"],
        "second": runs[1]["planner"],
        "scenes": len(shared),
        "second_better": int((successes[1] > successes[0]).sum()),
        "second_worse": int((successes[1] < successes[0]).sum()),
    }
    for name, below in (("grasp_success_rate", "attempts"), ("declutter_rate", "objects")):
        trials = np.array([[getattr(c, below) for c in run] for run in counts])
        found = paired_difference(successes, trials, np.random.default_rng(seed))
        figures[name] = {
            "first": _share(successes[0], trials[0]),
            "second": _share(successes[1], trials[1]),
            "difference": found[0] if found else None,
            "difference_95": found[1] if found else None,
        }
    return figures


def _share(successes: Any, trials: Any) -> dict[str, Any]:
    above, below = int(successes.sum()), int(trials.sum())
    return {"value": above / below if below else None, "wilson_95": wilson(above, below)}
