"""The regression gate: a result must not fall below a committed one by more than its interval."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

RATES = {"grasp_success_rate": "GSR", "declutter_rate": "DR"}
SAME = ("scene", "protocol", "protocol_version")


def below_gate(summary: dict[str, Any], gate: Path) -> list[str]:
    """What of a result is below a committed one, in words; empty if nothing is.

    Args:
        summary: of the result, as in `summary.json`.
        gate: `summary.json` of the committed one; each rate may be as low as the lower end of
            its interval.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no summary, or one of another scene or protocol.
    """
    try:
        committed = json.loads(gate.read_text())
        limits = {name: committed[name]["wilson_95"] for name in RATES}
        differing = [name for name in SAME if committed[name] != summary[name]]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{gate} is no summary.json of a benchmark: {error!r}") from error
    if differing:
        raise ValueError(
            f"{gate} is of another benchmark: "
            + ", ".join(f"{name} {committed[name]!r}, not {summary[name]!r}" for name in differing)
        )
    found = []
    for name, label in RATES.items():
        value, limit = summary[name]["value"], limits[name]
        if limit is not None and (value is None or value < limit[0]):
            shown = "undefined" if value is None else f"{100 * value:.1f} %"
            found.append(
                f"{label} {shown} is below {100 * limit[0]:.1f} %, the lower end of the "
                f"committed {100 * committed[name]['value']:.1f} %"
            )
    return found
