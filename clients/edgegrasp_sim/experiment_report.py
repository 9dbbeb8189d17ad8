"""Tables and plots of an experiment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.figure import Figure

RATES = (("grasp_success_rate", "GSR"), ("declutter_rate", "DR"))
COLOURS = {"packed": "#2f6db3", "pile": "#e08a1e"}
STYLES = ("-", "--", ":", "-.")  # of the models


def title_of(planner: dict[str, Any]) -> str:
    """A planner's weights, or its name where it has none."""
    return str(planner.get("model") or planner["name"])


def percent(rate: dict[str, Any]) -> str:
    """A rate with its 95 % interval, in per cent."""
    if rate["value"] is None:
        return "none"
    low, high = rate["wilson_95"]
    return f"{100 * rate['value']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def value_text(value: float | str) -> str:
    """A case's value as a person writes it."""
    return value if isinstance(value, str) else f"{value:g}"


def experiment_table(results: dict[str, Any]) -> str:
    """An experiment as Markdown tables, one for what each group varies; per cent, 95 % intervals.

    Args:
        results: as in `experiment.json`.
    """
    parts = []
    for group in _unique(case["group"] for case in results["cases"]):
        cases = [case for case in results["cases"] if case["group"] == group]
        columns = _unique((c["scene"], title_of(c["planner"])) for c in cases)
        if group == "planner":  # the planner is what the rows name
            columns = _unique((c["scene"], "") for c in cases)
        heads = [f"{scene}, {model}" if model else scene for scene, model in columns]
        lines = [
            f"| {group} | " + " | ".join(f"{head}: GSR | DR" for head in heads) + " |",
            "| --- |" + " --- | --- |" * len(columns),
        ]
        for value in _unique(case["value"] for case in cases):
            cells = []
            for scene, model in columns:
                found = [
                    case
                    for case in cases
                    if (case["value"], case["scene"]) == (value, scene)
                    and model in ("", title_of(case["planner"]))
                ]
                cells += [percent(found[0][name]) if found else "" for name, _ in RATES]
            lines.append(f"| {value_text(value)} | " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def experiment_figure(results: dict[str, Any]) -> Figure:
    """GSR and DR of an experiment with 95 % intervals: a row of axes for each group."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    groups = _unique(case["group"] for case in results["cases"])
    figure = Figure(figsize=(9.6, 3.0 * len(groups)), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(len(groups), len(RATES), squeeze=False, sharey=True)
    for row, group in zip(axes, groups, strict=True):
        cases = [case for case in results["cases"] if case["group"] == group]
        for place, (name, label) in zip(row, RATES, strict=True):
            _draw(place, cases, name)
            place.set(xlabel=group, ylabel=f"{label} (%)", ylim=(0, 102))
            place.grid(alpha=0.25)
            if group == "labels":
                place.set_xscale("log")
            place.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(fontsize=8, loc="best")
    return figure


def _draw(axes: Any, cases: list[dict[str, Any]], name: str) -> None:
    values = _unique(case["value"] for case in cases)
    numbers = all(not isinstance(value, str) for value in values)
    baselines = cases[0]["group"] == "planner"
    lines = _unique((c["scene"], "" if baselines else title_of(c["planner"])) for c in cases)
    models = _unique(model for _, model in lines)
    for number, (scene, model) in enumerate(lines):
        told = [
            case
            for case in cases
            if case["scene"] == scene
            and model in ("", title_of(case["planner"]))
            and case[name]["value"] is not None
        ]
        rates = np.array([[case[name]["value"], *case[name]["wilson_95"]] for case in told])
        if len(rates) == 0:
            continue
        at = np.array(
            [case["value"] if numbers else values.index(case["value"]) for case in told], float
        )
        if not numbers:
            at += 0.12 * (number - (len(lines) - 1) / 2)  # side by side
        middle, low, high = 100 * rates.T
        spread = np.maximum(np.stack((middle - low, high - middle)), 0.0)
        axes.errorbar(
            at, middle, spread, capsize=3, marker="o", markersize=4, color=COLOURS[scene],
            linestyle=STYLES[models.index(model) % len(STYLES)] if numbers else "none",
            label=f"{scene}, {model}" if model else scene,
        )  # fmt: skip
    if not numbers:
        axes.set_xticks(range(len(values)), values)
        axes.set_xlim(-0.5, len(values) - 0.5)


def _unique(items: Iterable[Any]) -> list[Any]:
    return list(dict.fromkeys(items))
