"""What is worth keeping of results, small enough to be committed."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edgegrasp_sim.results import ResultFolder


def record_of(folder: ResultFolder) -> dict[str, Any]:
    """What is worth keeping of a finished benchmark: its conditions and figures, ready for JSON."""
    manifest = folder.manifest()
    summary = json.loads((folder.path / "summary.json").read_text())
    run = manifest["run"]
    times = summary["planning_seconds"]
    return {
        "scene": run["scene"],
        "protocol": {name: run["protocol"][name] for name in ("name", "version")},
        "planner": run["planner"],
        "objects": {name: run["objects"][name] for name in ("name", "models", "digest")},
        "rounds": manifest["rounds"],
        "seeds": manifest["seeds"],
        "attempts": summary["attempts"],
        "successes": summary["successes"],
        "objects_present": summary["objects"],
        "grasp_success_rate": summary["grasp_success_rate"],
        "declutter_rate": summary["declutter_rate"],
        "failures": summary["failures"],
        "planning_seconds_median": times["median"] if times else None,
        "attempts_digest": summary["attempts_digest"],
    }
