"""What comes of a benchmark: its figures, and the folder it is kept in."""

from __future__ import annotations

import csv
import hashlib
import json
import os
from collections import Counter
from dataclasses import asdict, dataclass
from statistics import fmean, median, stdev
from typing import TYPE_CHECKING, Any

from edgegrasp_sim.grasping import FailureCause, GraspOutcome
from edgegrasp_sim.intervals import wilson
from edgegrasp_sim.trials import Attempt, Round, RoundEnd

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

CSV_COLUMNS = (
    "seed",
    "round",
    "attempt",
    *(name for name in Attempt.__dataclass_fields__ if name != "T_world_hand"),
    "T_world_hand",
)


@dataclass(frozen=True, slots=True)
class Counts:
    """What GSR and DR are made of."""

    successes: int
    attempts: int
    objects: int

    @classmethod
    def of(cls, rounds: Iterable[Round]) -> Counts:
        """Count over rounds."""
        rounds = tuple(rounds)
        return cls(
            sum(item.successes for item in rounds),
            sum(len(item.attempts) for item in rounds),
            sum(len(item.objects) for item in rounds),
        )

    @property
    def grasp_success_rate(self) -> float | None:
        """GSR: successes / attempts; None without attempts."""
        return self.successes / self.attempts if self.attempts else None

    @property
    def declutter_rate(self) -> float | None:
        """DR: successes / objects present after the resets; None without objects."""
        return self.successes / self.objects if self.objects else None


def summarise(rounds: Sequence[Round]) -> dict[str, Any]:
    """The figures of a benchmark, ready for JSON; shares are 0 to 1."""
    counts = Counts.of(rounds)
    seeds = sorted({item.seed for item in rounds})
    by_seed = {seed: Counts.of(r for r in rounds if r.seed == seed) for seed in seeds}
    attempts = [attempt for item in rounds for attempt in item.attempts]
    planning = sorted(attempt.planning_seconds for attempt in attempts)
    return {
        "rounds": len(rounds),
        "successes": counts.successes,
        "attempts": counts.attempts,
        "objects": counts.objects,
        "grasp_success_rate": _rate(
            counts.successes,
            counts.attempts,
            {seed: c.grasp_success_rate for seed, c in by_seed.items()},
        ),
        "declutter_rate": _rate(
            counts.successes,
            counts.objects,
            {seed: c.declutter_rate for seed, c in by_seed.items()},
        ),
        "failures": {
            **{cause.value: sum(a.cause is cause for a in attempts) for cause in FailureCause},
            "no candidate": sum(item.no_grasp for item in rounds),
        },
        "wrong_object_successes": sum(attempt.wrong_object for attempt in attempts),
        "start_contacts": sum(attempt.start_contact for attempt in attempts),
        "round_ends": dict(Counter(item.end.value for item in rounds)),
        "planning_seconds": {
            "mean": fmean(planning),
            "median": median(planning),
            "p95": planning[int(0.95 * (len(planning) - 1))],
        }
        if planning
        else None,
        "planner_retries": sum(item.retries for item in rounds),
        "planner_waited_seconds": sum(item.waited_seconds for item in rounds),
        "objects_by_name": by_object(rounds),
        "attempts_digest": attempts_digest(rounds),
    }


def by_object(rounds: Sequence[Round]) -> dict[str, dict[str, int]]:
    """For each object: how often present, removed, aimed at, and aimed at with success."""
    attempts = [attempt for item in rounds for attempt in item.attempts]
    present = Counter(name for item in rounds for name in item.objects)
    removed = Counter(attempt.object for attempt in attempts if attempt.object is not None)
    aimed = Counter(attempt.target for attempt in attempts)
    held = Counter(a.target for a in attempts if a.success and not a.wrong_object)
    return {
        name: {
            "present": present[name],
            "removed": removed[name],
            "attempts": aimed[name],
            "successes": held[name],
        }
        for name in sorted(present)
    }


def attempts_digest(rounds: Sequence[Round]) -> str:
    """SHA-256 of everything but wall-clock times: equal for equal attempts."""
    plain = [_without_times(item) for item in sorted(rounds, key=lambda r: (r.seed, r.index))]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def round_from_json(table: dict[str, Any]) -> Round:
    """Rebuild a round from the JSON of its dataclass."""
    attempts = tuple(
        Attempt(
            **item
            | {
                "outcome": GraspOutcome(item["outcome"]),
                "cause": FailureCause(item["cause"]) if item["cause"] is not None else None,
            }
        )
        for item in table["attempts"]
    )
    changed = {
        "objects": tuple(table["objects"]),
        "attempts": attempts,
        "end": RoundEnd(table["end"]),
    }
    return Round(**table | changed)


class ResultFolder:
    """A folder with a benchmark's manifest, rounds and figures.

    `manifest.json`, `rounds/<seed>-<index>.json` written as rounds finish, and at the end
    `attempts.csv` and `summary.json`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def open(self, manifest: dict[str, Any]) -> None:
        """Start a benchmark in this folder, or go on with one that was interrupted.

        Args:
            manifest: its entry `run` must be that of the benchmark begun here before.

        Raises:
            ValueError: the folder holds another benchmark.
        """
        known = self.path / "manifest.json"
        manifest = json.loads(json.dumps(manifest))  # tuples become lists, as in the file
        if known.is_file():
            before = json.loads(known.read_text())["run"]
            changed = [key for key in manifest["run"] if before.get(key) != manifest["run"][key]]
            if changed:
                raise ValueError(
                    f"{self.path} holds another benchmark (different {', '.join(changed)}); "
                    "choose another folder, or repeat the command that began it"
                )
        (self.path / "rounds").mkdir(parents=True, exist_ok=True)
        _write(known, json.dumps(manifest, indent=1) + "\n")

    def add(self, done: Round) -> None:
        """Keep a finished round."""
        _write(self._file(done.seed, done.index), json.dumps(asdict(done)) + "\n")

    def has(self, seed: int, index: int) -> bool:
        """Whether a round is finished."""
        return self._file(seed, index).is_file()

    def rounds(self) -> list[Round]:
        """The finished rounds, by seed and index.

        Raises:
            FileNotFoundError: this folder holds no benchmark.
        """
        self.manifest()
        files = (self.path / "rounds").glob("*.json")
        rounds = [round_from_json(json.loads(file.read_text())) for file in files]
        return sorted(rounds, key=lambda item: (item.seed, item.index))

    def manifest(self) -> dict[str, Any]:
        """What was run.

        Raises:
            FileNotFoundError: this folder holds no benchmark.
        """
        file = self.path / "manifest.json"
        if not file.is_file():
            raise FileNotFoundError(f"{self.path} holds no benchmark: manifest.json is missing")
        table: dict[str, Any] = json.loads(file.read_text())
        return table

    def finish(self, rounds: Sequence[Round]) -> dict[str, Any]:
        """Write `attempts.csv` and `summary.json`; returns the summary."""
        manifest = self.manifest()
        summary = {
            "scene": manifest["run"]["scene"],
            "protocol": manifest["run"]["protocol"]["name"],
            "protocol_version": manifest["run"]["protocol"]["version"],
            **summarise(rounds),
        }
        _write(self.path / "summary.json", json.dumps(summary, indent=1) + "\n")
        with (self.path / "attempts.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, CSV_COLUMNS)
            table.writeheader()
            for item in rounds:
                for number, attempt in enumerate(item.attempts):
                    where = {"seed": item.seed, "round": item.index, "attempt": number}
                    pose = {"T_world_hand": json.dumps(attempt.T_world_hand)}
                    table.writerow(where | asdict(attempt) | pose)
        return summary

    def _file(self, seed: int, index: int) -> Path:
        return self.path / "rounds" / f"{seed}-{index}.json"


def _rate(successes: int, trials: int, by_seed: dict[int, float | None]) -> dict[str, Any]:
    values = [value for value in by_seed.values() if value is not None]
    return {
        "value": successes / trials if trials else None,
        "wilson_95": wilson(successes, trials),
        "mean_over_seeds": fmean(values) if values else None,
        "std_over_seeds": stdev(values) if len(values) > 1 else None,
        "by_seed": {str(seed): value for seed, value in by_seed.items()},
    }


def _without_times(item: Round) -> dict[str, Any]:
    plain = asdict(item)
    for name in ("retries", "waited_seconds"):
        del plain[name]
    for attempt in plain["attempts"]:
        del attempt["planning_seconds"]
    return plain


def _write(path: Path, text: str) -> None:
    # A killed process shall leave the whole file or none.
    unfinished = path.with_suffix(f".{os.getpid()}.tmp")
    unfinished.write_text(text)
    unfinished.replace(path)
