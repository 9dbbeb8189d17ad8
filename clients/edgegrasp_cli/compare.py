"""`edgegrasp compare`."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer


def compare(
    first: Annotated[Path, typer.Argument(help="Folder that `benchmark --output` wrote.")],
    second: Annotated[Path, typer.Argument(help="Another, of the same scenes.")],
    output: Annotated[Path | None, typer.Option(help="JSON file for the figures as well.")] = None,
) -> None:
    """Compare two benchmarks scene by scene, with 95 % confidence intervals."""
    from rich.console import Console
    from rich.table import Table

    from edgegrasp_sim.results import ResultFolder
    from edgegrasp_sim.results import compare as figures_of

    try:
        figures = figures_of(ResultFolder(first), ResultFolder(second))
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"edgegrasp compare: {error}")
    if output is not None:
        output.write_text(json.dumps(figures, indent=1) + "\n")
    table = Table("", str(first), str(second), "difference, paired")
    for name, label in (("grasp_success_rate", "GSR %"), ("declutter_rate", "DR %")):
        row = figures[name]
        table.add_row(
            label,
            _interval(row["first"]["value"], row["first"]["wilson_95"]),
            _interval(row["second"]["value"], row["second"]["wilson_95"]),
            _interval(row["difference"], row["difference_95"], sign="+"),
        )
    console = Console()
    console.print(table)
    better, worse = figures["second_better"], figures["second_worse"]
    console.print(
        f"{figures['scenes']} scenes: the second removed more objects in {better}, fewer in "
        f"{worse}, as many in {figures['scenes'] - better - worse}.",
        soft_wrap=True,
    )


def _interval(value: float | None, interval: Any, sign: str = "") -> str:
    if value is None:
        return "undefined"
    low, high = interval
    return f"{100 * value:{sign}.1f} ({100 * low:{sign}.1f} to {100 * high:{sign}.1f})"
