"""Plots of a benchmark's figures, as matplotlib figures."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from edgegrasp_sim.trials import Attempt

BLUE, ORANGE, GREY, RED = "#2f6db3", "#e08a1e", "#9aa3ad", "#b3372f"
BINS = 10
LABEL_WIDTH = 13  # letters
MIN_IN_BIN = 5  # attempts; fewer say nothing about a score


def rates_plot(summary: dict[str, Any], published: Sequence[dict[str, Any]]) -> Figure:
    """GSR and DR with Wilson intervals, each seed as a dot, published figures beside them."""
    figure, axes = _figure(6.4, 3.4)
    names = (("grasp_success_rate", "GSR"), ("declutter_rate", "DR"))
    labels = []
    for place, (name, label) in enumerate(names):
        rate = summary[name]
        labels.append(label)
        if rate["value"] is None:
            continue
        low, high = rate["wilson_95"]
        value = rate["value"]
        axes.bar(place, 100 * value, 0.5, color=BLUE, alpha=0.85, label="this run" * (not place))
        axes.errorbar(
            place, 100 * value, [[max(0.0, 100 * (value - low))], [max(0.0, 100 * (high - value))]],
            color="black", capsize=5, label="95 % interval" * (not place),
        )  # fmt: skip
        seeds = [100 * v for v in rate["by_seed"].values() if v is not None]
        axes.scatter(
            np.full(len(seeds), place + 0.15), seeds, s=16, color="white", edgecolor="black",
            zorder=3, label="each seed" * (not place),
        )  # fmt: skip
    for row in published:
        mean, *deviation = row["grasp_success_rate"]
        place = len(labels)
        labels.append(fill(f"{row['method']}, published", LABEL_WIDTH))
        axes.bar(place, mean, 0.5, color=GREY)
        if deviation:
            axes.errorbar(place, mean, deviation, color="black", capsize=5)
    axes.set(ylim=(0, 100), ylabel="%", xticks=range(len(labels)))
    axes.set_xticklabels(labels, fontsize=7.5)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8, frameon=False)
    return figure


def failures_plot(summary: dict[str, Any]) -> Figure:
    """How often each cause of failure occurred."""
    figure, axes = _figure(6.4, 3.0)
    causes = list(reversed(summary["failures"].items()))
    bars = axes.barh([cause for cause, _ in causes], [count for _, count in causes], color=RED)
    axes.bar_label(bars, padding=3)
    axes.margins(x=0.12)
    axes.set_xlabel("grasps (no candidate: views)")
    return figure


def scores_plot(attempts: Sequence[Attempt]) -> Figure:
    """Whether scores mean what they say: success against score, and how scores are spread."""
    figure, axes = _figure(6.4, 3.4)
    scores = np.array([attempt.score for attempt in attempts])
    held = np.array([attempt.success for attempt in attempts])
    edges = np.linspace(min(0.0, scores.min()), max(1.0, scores.max()), BINS + 1)
    bins = np.clip(np.digitize(scores, edges) - 1, 0, BINS - 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    counts = np.bincount(bins, minlength=BINS)
    rates = np.bincount(bins, held, BINS) / np.maximum(counts, 1)
    width = edges[1] - edges[0]
    axes.bar(
        middles, 100 * counts / counts.sum(), width, color=GREY, alpha=0.5,
        label="share of the grasps", edgecolor="white",
    )  # fmt: skip
    told = counts >= MIN_IN_BIN
    axes.plot(middles[told], 100 * rates[told], "o-", color=BLUE, label="that held")
    axes.plot([0, 1], [0, 100], "--", color="black", linewidth=0.8, label="as a probability")
    axes.set(xlabel="score", ylabel="%", ylim=(0, 103))
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8, frameon=False)
    return figure


def times_plot(attempts: Sequence[Attempt]) -> Figure:
    """How long planning took."""
    figure, axes = _figure(6.4, 3.0)
    seconds = [attempt.planning_seconds for attempt in attempts]
    longest = float(np.percentile(seconds, 99))
    axes.hist(seconds, bins=30, range=(0.0, longest), color=ORANGE)
    axes.axvline(float(np.median(seconds)), color="black", linestyle="--", label="median")
    axes.set(xlabel="planning time (s), without the longest 1 %", ylabel="grasps")
    axes.legend(fontsize=8)
    return figure


def _figure(width: float, height: float) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, axis="both")
    axes.set_axisbelow(True)
    return figure, axes
