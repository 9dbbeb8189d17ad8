"""The picture of a load measurement."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot  # after the choice of what draws

COLORS = {"grpc": "tab:blue", "rest": "tab:orange"}
LINES = {"p50": "-", "p99": "--"}


def draw(results: dict[str, Any], path: Path) -> None:
    """Draw the closed loop, the open loop, and the overhead side by side."""
    figure, axes = pyplot.subplots(1, 4, figsize=(18, 4.2), constrained_layout=True)
    _closed(axes[0], results["closed"])
    _open(axes[1], axes[2], results["open"])
    _overhead(axes[3], results["overhead"])
    figure.savefig(path, dpi=80)
    pyplot.close(figure)


def _closed(axis: Any, rows: list[dict[str, Any]]) -> None:
    for transport, color in COLORS.items():
        of = [row for row in rows if row["transport"] == transport]
        rates = [row["accepted_per_second"] for row in of]
        for name, line in LINES.items():
            latencies = [row["accepted_ms"][name] for row in of]
            axis.plot(rates, latencies, line, marker="o", color=color, label=f"{transport} {name}")
    axis.set(title="closed loop, 1 to 8 at a time", xlabel="answers a second", ylabel="ms")
    axis.legend()


def _open(latency: Any, shares: Any, rows: list[dict[str, Any]]) -> None:
    for transport, color in COLORS.items():
        of = [row for row in rows if row["transport"] == transport]
        load = [row["share"] for row in of]
        for name, line in LINES.items():
            values = [(row["accepted_ms"] or {}).get(name) for row in of]
            label = f"{transport} accepted {name}"
            latency.plot(load, values, line, marker="o", color=color, label=label)
        refused = [(row["refused_ms"] or {}).get("p99", float("nan")) for row in of]
        latency.plot(load, refused, ":", marker="x", color=color, label=f"{transport} refused p99")
        answered = [row["codes"].get("OK", 0) / row["requests"] for row in of]
        shares.plot(load, answered, marker="o", color=color, label=f"{transport} answered")
        turned = [row["codes"].get("RESOURCE_EXHAUSTED", 0) / row["requests"] for row in of]
        shares.plot(load, turned, ":", marker="x", color=color, label=f"{transport} refused")
    latency.set(title="open loop", xlabel="times the sustainable rate", ylabel="ms", yscale="log")
    shares.set(title="open loop", xlabel="times the sustainable rate", ylabel="share of requests")
    latency.legend(fontsize=7)
    shares.legend(fontsize=8)


def _overhead(axis: Any, kinds: dict[str, Any]) -> None:
    names, values, colors = [], [], []
    for kind, both in kinds.items():
        for transport, row in both.items():
            names.append(f"{transport}\n{kind.replace(' of ', chr(10))}")
            values.append(row["overhead_p50_ms"])
            colors.append(COLORS[transport])
    axis.bar(names, values, color=colors)
    axis.set(title="server beyond the detector, p50", ylabel="ms")
