"""Show a detection: as a table for people, as JSON for programs."""

from typing import Any

import numpy as np


def as_json(detection: Any) -> dict[str, Any]:
    """The same document as the HTTP API's.

    Args:
        detection: From the detector or from the client; their fields have the same names.
    """
    return dict(vars(detection)) | {"grasps": [_plain(vars(grasp)) for grasp in detection.grasps]}


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    floats = {
        name: np.asarray(value, dtype=np.float32).tolist()
        for name, value in fields.items()
        if not isinstance(value, bool)
    }
    return fields | floats


def print_table(detection: Any) -> None:
    """Print the ranked grasps, then counts and warnings."""
    from rich.console import Console
    from rich.table import Table

    table = Table("#", "score", "TCP x y z (m)", "approach direction", "width (m)", "free")
    for rank, grasp in enumerate(detection.grasps, start=1):
        table.add_row(
            str(rank),
            f"{grasp.score:.3f}",
            _numbers(grasp.T_cloud_tcp[:3, 3]),
            _numbers(grasp.approach_direction),
            f"{grasp.width:.3f}",
            "yes" if grasp.collision_free else "no",
        )
    console = Console()
    console.print(table)
    console.print(", ".join(f"{count} {name}" for name, count in detection.counts.items()))
    console.print(f"{detection.model}: {detection.seconds.get('total', 0.0):.2f} s")
    for warning in detection.warnings:
        console.print(f"Warning: {warning}")


def _numbers(vector: Any) -> str:
    return " ".join(f"{value:+.3f}" for value in vector)
