"""Show a detection: as a table for people, as JSON for programs."""

from typing import Any

import numpy as np


def as_json(detection: Any) -> dict[str, Any]:
    """The same document as the HTTP API's.

    Args:
        detection: From the detector or from the client; their fields have the same names.
    """
    grasps = [_plain(vars(grasp)) for grasp in detection.grasps]
    debug = None if detection.debug is None else _plain(vars(detection.debug))
    return dict(vars(detection)) | {"grasps": grasps, "debug": debug}


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    """Arrays as lists, floats as float32, NaN as None."""
    return {name: _value(value) for name, value in fields.items()}


def _value(value: Any) -> Any:
    if isinstance(value, float):
        return float(np.float32(value))
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.kind in "iu":
        return value.tolist()
    floats = value.astype(np.float32)
    if np.isnan(floats).any():  # of scores, which are flat
        return [None if np.isnan(number) else number for number in floats.tolist()]
    return floats.tolist()


def print_table(detection: Any) -> None:
    """Print the ranked grasps, then counts and warnings."""
    from rich.console import Console
    from rich.table import Table

    table = Table(
        "#", "score", "TCP x y z (m)", "approach direction", "width (m)", "clearance (m)", "free"
    )
    for rank, grasp in enumerate(detection.grasps, start=1):
        table.add_row(
            str(rank),
            f"{grasp.score:.3f}",
            _numbers(grasp.T_cloud_tcp[:3, 3]),
            _numbers(grasp.approach_direction),
            f"{grasp.width:.3f}",
            f"{grasp.clearance:+.3f}",
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
