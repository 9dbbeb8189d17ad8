"""The results of a benchmark: its folder, figures with intervals, comparison and gate."""

import csv
import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from scipy.stats import binomtest

from edgegrasp_camera.arrays import Int64
from edgegrasp_sim.hand import FailureCause
from edgegrasp_sim.trial import Attempt, Round

PAIRED = ("scene", "engine", "protocol", "objects", "constants")  # must be equal in paired runs
COUNTS = ("successes", "attempts", "objects")
# Fields of an attempt that its digest leaves out: times, and fields of arms.
UNDIGESTED = ("planning_seconds", "motion_seconds", "touched_on_the_way", "touched_seen")
RATE_LABELS = {"grasp_success_rate": "GSR", "declutter_rate": "DR"}
GATED = ("scene", "engine", "protocol", "protocol_version")
RESAMPLES = 10_000
ROUND = TypeAdapter(Round)


@dataclass(frozen=True)
class ResultFolder:
    """A folder with a benchmark's manifest, its rounds, and at the end attempts and summary."""

    path: Path

    def open(self, manifest: dict[str, Any]) -> None:
        """Start or resume a benchmark in this folder; raises ValueError if it contains another."""
        known = self.path / "manifest.json"
        manifest = json.loads(json.dumps(manifest))  # tuples become lists, as in the file
        if known.is_file():
            held = self.manifest()
            before, now = held["run"], manifest["run"]
            changed = [key for key in before | now if before.get(key) != now.get(key)]
            changed += ["seeds"] if {*held["seeds"]} - {*manifest["seeds"]} else []
            changed += ["rounds"] if held["rounds"] > manifest["rounds"] else []
            if changed:
                raise ValueError(
                    f"{self.path} holds another benchmark (different {', '.join(changed)}), which "
                    "can get more rounds and seeds; choose another folder"
                )
        (self.path / "rounds").mkdir(parents=True, exist_ok=True)
        _write(known, json.dumps(manifest, indent=1) + "\n")

    def add(self, done: Round) -> None:
        """Keep a finished round."""
        file = self.path / "rounds" / f"{done.seed}-{done.index}.json"
        _write(file, json.dumps(asdict(done)) + "\n")

    def rounds(self) -> list[Round]:
        """The finished rounds, by seed and index; raises FileNotFoundError without a benchmark."""
        self.manifest()
        files = (self.path / "rounds").glob("*.json")
        rounds = [ROUND.validate_json(file.read_bytes()) for file in files]
        return sorted(rounds, key=lambda item: (item.seed, item.index))

    def manifest(self) -> dict[str, Any]:
        """The manifest of the benchmark in this folder; raises FileNotFoundError without one."""
        file = self.path / "manifest.json"
        if not file.is_file():
            raise FileNotFoundError(f"{self.path} contains no benchmark: manifest.json is missing")
        try:
            table: dict[str, Any] = json.loads(file.read_text())
            table["run"]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file} is not a manifest ({error}); choose another folder") from None
        return table

    def finish(self) -> dict[str, Any]:
        """Write `attempts.csv` and `summary.json`; returns the summary."""
        rounds = self.rounds()
        summary = summary_of(self.manifest()["run"], rounds)
        _write(self.path / "summary.json", json.dumps(summary, indent=1) + "\n")
        with (self.path / "attempts.csv").open("w", newline="") as file:
            columns = ("seed", "round", "attempt", *Attempt.__dataclass_fields__)
            table = csv.DictWriter(file, columns)
            table.writeheader()
            for item in rounds:
                for number, attempt in enumerate(item.attempts):
                    where = {"seed": item.seed, "round": item.index, "attempt": number}
                    table.writerow(where | asdict(attempt))
        return summary


def summary_of(run: dict[str, Any], rounds: Sequence[Round]) -> dict[str, Any]:
    """The scene, engine and protocol of a manifest's run, and the figures of its rounds."""
    protocol = run["protocol"]
    named = {"protocol": protocol["name"], "protocol_version": protocol["version"]}
    return {"scene": run["scene"], "engine": run["engine"], **named, **summarise(rounds)}


def summarise(rounds: Sequence[Round]) -> dict[str, Any]:
    """The figures of a benchmark, ready for JSON; shares are 0 to 1."""
    attempts = [attempt for item in rounds for attempt in item.attempts]
    planning = sorted(attempt.planning_seconds for attempt in attempts)
    seeds = np.array([item.seed for item in rounds])
    counts = dict(zip(COUNTS, count_outcomes(rounds), strict=True))
    fitting = dict(zip(COUNTS, count_outcomes(map(without_too_wide, rounds)), strict=True))
    return {
        "rounds": len(rounds),
        **{name: int(numbers.sum()) for name, numbers in counts.items()},
        "grasp_success_rate": _rate(counts["successes"], counts["attempts"], seeds),
        "declutter_rate": _rate(counts["successes"], counts["objects"], seeds),
        "too_wide": {
            "objects": sum(len(item.too_wide) for item in rounds),
            "grasp_success_rate_of_others": _share(fitting["successes"], fitting["attempts"]),
            "declutter_rate_of_others": _share(fitting["successes"], fitting["objects"]),
        },
        "failures": {
            **{cause.value: sum(a.cause is cause for a in attempts) for cause in FailureCause},
            "start in collision": sum(item.start_collisions for item in rounds),
            "no candidate": sum(item.no_grasp - item.start_collisions for item in rounds),
        },
        "wrong_object_successes": sum(attempt.wrong_object for attempt in attempts),
        "start_contacts": sum(attempt.start_contact for attempt in attempts),
        "arm": _arm_figures(rounds),
        "round_ends": dict(Counter(item.end.value for item in rounds)),
        "planning_seconds": {
            "mean": fmean(planning),
            "median": median(planning),
            "p95": planning[int(0.95 * (len(planning) - 1))],
        }
        if planning
        else None,
        "objects_by_name": counts_by_object(rounds),
        "attempts_digest": attempts_digest(rounds),
    }


def _arm_figures(rounds: Sequence[Round]) -> dict[str, Any] | None:
    """Figures of an arm, None for a floating hand; times are simulated motion and planning."""
    attempts = [attempt for item in rounds for attempt in item.attempts]
    if not any(attempt.motion_seconds for attempt in attempts):
        return None
    seconds = sum(a.motion_seconds + a.planning_seconds for a in attempts)
    return {
        "picks_per_hour": 3600 * sum(a.success for a in attempts) / seconds,
        "motion_seconds": median(a.motion_seconds for a in attempts),
        "touched_on_the_way": sum(a.touched_on_the_way for a in attempts),
        "touched_seen": sum(a.touched_seen for a in attempts),
        "scenes_with_a_reachable_grasp": sum(bool(item.attempts) for item in rounds),
    }


def count_outcomes(rounds: Iterable[Round]) -> Int64:
    """Successes, attempts and objects of each round, in the order of `COUNTS`: (3, R)."""
    rows = [(item.successes, len(item.attempts), len(item.objects)) for item in rounds]
    return np.array(rows, np.int64).reshape(-1, len(COUNTS)).T


def without_too_wide(item: Round) -> Round:
    """A round without the objects that are too wide for the hand, and without their grasps."""
    left = tuple(name for name in item.objects if name not in item.too_wide)
    attempts = tuple(a for a in item.attempts if not {a.object, a.target} & {*item.too_wide})
    return replace(item, objects=left, attempts=attempts)


def counts_by_object(rounds: Sequence[Round]) -> dict[str, dict[str, int]]:
    """For each object: how often it was present, removed, aimed at, and held when aimed at."""
    attempts = [attempt for item in rounds for attempt in item.attempts]
    counts: dict[str, Counter[Any]] = {
        "present": Counter(name for item in rounds for name in item.objects),
        "removed": Counter(attempt.object for attempt in attempts),
        "attempts": Counter(attempt.target for attempt in attempts),
        "successes": Counter(a.target for a in attempts if a.success and not a.wrong_object),
    }
    names = sorted(counts["present"])
    return {name: {key: each[name] for key, each in counts.items()} for name in names}


def attempts_digest(rounds: Sequence[Round]) -> str:
    """SHA-256 of rounds without times, `too_wide` and fields of arms; equal for equal attempts."""
    tables = [asdict(item) for item in sorted(rounds, key=lambda r: (r.seed, r.index))]
    for table in tables:
        del table["too_wide"], table["start_collisions"]
        for attempt in table["attempts"]:
            for name in UNDIGESTED:
                del attempt[name]
    return hashlib.sha256(json.dumps(tables, sort_keys=True).encode()).hexdigest()


def planner_title(planner: dict[str, Any]) -> str:
    """The weights of a manifest's planner, or its name if it has none."""
    return str(planner.get("model") or planner["name"])


def compare(first: ResultFolder, second: ResultFolder) -> dict[str, Any]:
    """Values, intervals and paired difference of the rates of two benchmarks of the same scenes."""
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
    counts = [count_outcomes([run[key] for key in shared]) for run in rounds]
    successes, attempts, objects = np.stack(counts, axis=1)  # (2, S) each
    figures: dict[str, Any] = {
        "first": runs[0]["planner"],
        "second": runs[1]["planner"],
        "scenes": len(shared),
        "second_better": int((successes[1] > successes[0]).sum()),
        "second_worse": int((successes[1] < successes[0]).sum()),
    }
    for name, trials in (("grasp_success_rate", attempts), ("declutter_rate", objects)):
        figures[name] = {
            "first": _share(successes[0], trials[0]),
            "second": _share(successes[1], trials[1]),
            **paired_difference(successes, trials),
        }
    return figures


def gate_failures(summary: dict[str, Any], gate: Path) -> list[str]:
    """Sentences about rates that fall below the interval of a committed result."""
    try:
        committed = json.loads(gate.read_text())
        limits = {name: committed[name]["wilson_95"] for name in RATE_LABELS}
        differing = [name for name in GATED if committed[name] != summary[name]]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{gate} is not a summary.json of a benchmark: {error!r}") from error
    if differing:
        raise ValueError(
            f"{gate} is of another benchmark: "
            + ", ".join(f"{name} {committed[name]!r}, not {summary[name]!r}" for name in differing)
        )
    return [
        f"{label} {100 * value:.1f} % is below {100 * limits[name][0]:.1f} %, the lower end of the "
        f"committed {100 * committed[name]['value']:.1f} %"
        for name, label in RATE_LABELS.items()
        if limits[name] is not None and (value := summary[name]["value"] or 0.0) < limits[name][0]
    ]


def wilson(successes: int, trials: int) -> tuple[float, float] | None:
    """Wilson's 95 % interval of a share; None without trials."""
    return binomtest(successes, trials).proportion_ci(method="wilson") if trials else None


def paired_difference(above: Int64, below: Int64) -> dict[str, Any]:
    """Second ratio of sums minus the first, and its 95 % interval; None if a run has no counts.

    Scenes are resampled, so that differences between them cancel out. Counts are (2, S), by run and
    scene.
    """
    if (below.sum(axis=1) == 0).any():
        return {"difference": None, "difference_95": None}
    picks = np.random.default_rng(0).integers(above.shape[1], size=(RESAMPLES, above.shape[1]))
    with np.errstate(invalid="ignore"):
        ratios = above[:, picks].sum(axis=-1) / below[:, picks].sum(axis=-1)  # (2, resamples)
    low, high = np.nanpercentile(ratios[1] - ratios[0], [2.5, 97.5]).tolist()
    first, second = (above.sum(axis=1) / below.sum(axis=1)).tolist()
    return {"difference": second - first, "difference_95": (low, high)}


def rate_text(rate: dict[str, Any]) -> str:
    """A rate with its 95 % interval, in per cent."""
    if rate["value"] is None:
        return "none"
    low, high = rate["wilson_95"]
    return f"{100 * rate['value']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def seed_spread(rate: dict[str, Any]) -> str:
    """Mean of the seeds' rates, and the standard deviation of several seeds, in per cent."""
    numbers = (rate["mean_over_seeds"], rate["std_over_seeds"])
    return " ± ".join(f"{100 * number:.1f}" for number in numbers if number is not None) or "none"


def _rate(successes: Int64, trials: Int64, seeds: Int64) -> dict[str, Any]:
    by_seed = {
        str(seed): _share(successes[seeds == seed], trials[seeds == seed])["value"]
        for seed in np.unique(seeds)
    }
    values = [value for value in by_seed.values() if value is not None]
    return _share(successes, trials) | {
        "mean_over_seeds": fmean(values) if values else None,
        "std_over_seeds": stdev(values) if len(values) > 1 else None,
        "by_seed": by_seed,
    }


def _share(successes: Any, trials: Any) -> dict[str, Any]:
    above, below = int(successes.sum()), int(trials.sum())
    return {"value": above / below if below else None, "wilson_95": wilson(above, below)}


def _write(path: Path, text: str) -> None:
    # A killed process must not leave a partial file.
    unfinished = path.with_suffix(f".{os.getpid()}.tmp")
    unfinished.write_text(text)
    unfinished.replace(path)
