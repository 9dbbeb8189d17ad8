"""The report of a benchmark: one HTML file with tables, plots and pictures."""

import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from edgegrasp_sim.page import Row, image, page, table
from edgegrasp_sim.picture import draw_grasps
from edgegrasp_sim.replay import Replay
from edgegrasp_sim.results import (
    BINS,
    RATE_LABELS,
    ResultFolder,
    bins_of,
    over_seeds,
    percent,
    planner_title,
)
from edgegrasp_sim.trial import Attempt, Round

PICTURES = 6
PUBLISHED = Path(__file__).parent / "published.toml"
BLUE, GREY = "#2f6db3", "#9aa3ad"
LABEL_WIDTH = 13  # letters
MIN_IN_BIN = 5  # attempts; fewer say nothing about a score


def write_report(folder: ResultFolder, objects: Path | None = None) -> Path:
    """Write `report.html` into a result folder.

    `objects` is where its object folder is now; None: where it was.

    Raises:
        FileNotFoundError: the folder holds no benchmark, or its objects are not there.
    """
    rounds = folder.rounds()
    facts = folder.manifest()
    summary = folder.finish(rounds)
    reported = published(facts["run"]["protocol"]["name"], summary["scene"])
    plots = BytesIO()
    attempts = [attempt for item in rounds for attempt in item.attempts]
    plots_figure(summary, attempts, reported).savefig(plots, format="png")
    with Replay(folder, objects) as replay:
        pictures = list(_failure_pictures(replay, rounds))
    title = f"{planner_title(facts['run']['planner'])} on {summary['scene']} scenes"
    parts = [
        table(_key_figures(summary)),
        "<h2>Beside published figures</h2>",
        table(_published_rows(summary, reported)),
        image("png", plots.getvalue(), "plots"),
        "<h2>Failures</h2>",
        table([("cause", "times"), *summary["failures"].items()]),
        *pictures,
        "<h2>Objects</h2>",
        table(_object_rows(summary)),
        "<h2>Conditions</h2><details><summary>every constant, version and digest</summary>",
        table([("name", "value"), *_flat("", facts)]),
        "</details>",
    ]
    path = folder.path / "report.html"
    path.write_text(page(title, parts))
    return path


def attempt_title(done: Round, number: int) -> str:
    """One line about an attempt and its outcome."""
    attempt = done.attempts[number]
    outcome = f"{attempt.object} removed" if attempt.success else str(attempt.cause)
    target = attempt.target or "nothing between the fingers"
    return (
        f"seed {done.seed}, round {done.index}, attempt {number}: {outcome} "
        f"(aimed at {target}; score {attempt.score:.2f})"
    )


def published(protocol: str, scene: str) -> list[dict[str, Any]]:
    """The published results of a protocol and scene, in the file's order; rates in per cent.

    Args:
        protocol: its name; a variant, named `<protocol>-<variant>`, includes those of `<protocol>`.
        scene: kind of the scenes.
    """
    rows: list[dict[str, Any]] = tomllib.loads(PUBLISHED.read_text())["result"]
    return [
        row
        for row in rows
        if f"{protocol}-".startswith(f"{row['protocol']}-") and row["scene"] == scene
    ]


def published_rates(row: dict[str, Any]) -> list[str]:
    """Published GSR and DR as text: mean, and standard deviation where it is known."""
    return [" ± ".join(f"{number:.1f}" for number in row.get(name, ())) for name in RATE_LABELS]


def plots_figure(
    summary: dict[str, Any], attempts: Sequence[Attempt], reported: Sequence[dict[str, Any]]
) -> Figure:
    """GSR and DR beside published figures; and where scores differ, success against score."""
    scores = np.array([attempt.score for attempt in attempts])
    panels = 2 if len(set(scores.tolist())) > 1 else 1
    figure = Figure(figsize=(6.4 * panels, 3.4), dpi=110, layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    _draw_rates(axes[0], summary, reported)
    if panels == 2:
        _draw_calibration(axes[1], scores, np.array([attempt.success for attempt in attempts]))
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.set_axisbelow(True)
        each.grid(alpha=0.25)
        each.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3, fontsize=8, frameon=False)
    return figure


def _draw_rates(axes: Any, summary: dict[str, Any], reported: Sequence[dict[str, Any]]) -> None:
    """GSR and DR with Wilson intervals, each seed as a dot, published GSR beside them."""
    labels = list(RATE_LABELS.values())
    for place, name in enumerate(RATE_LABELS):
        rate = summary[name]
        if rate["value"] is None:
            continue
        value, (low, high) = 100 * rate["value"], 100 * np.array(rate["wilson_95"])
        axes.bar(place, value, 0.5, color=BLUE, label="this run" * (not place))
        spread = [[max(0.0, value - low)], [max(0.0, high - value)]]
        interval = "95 % interval" * (not place)
        axes.errorbar(place, value, spread, color="black", capsize=5, label=interval)
        seeds = [100 * v for v in rate["by_seed"].values() if v is not None]
        label = "each seed" * (not place)
        axes.plot([place + 0.15] * len(seeds), seeds, "o", ms=4, mfc="white", mec="k", label=label)
    for row in reported:
        mean, *deviation = row["grasp_success_rate"]
        axes.bar(len(labels), mean, 0.5, yerr=deviation or None, capsize=5, color=GREY)
        labels.append(fill(f"{row['method']}, published", LABEL_WIDTH))
    axes.set(ylim=(0, 100), ylabel="%")
    axes.set_xticks(range(len(labels)), labels, fontsize=7.5)


def _draw_calibration(axes: Any, scores: Any, held: Any) -> None:
    """Success against score, and the distribution of scores."""
    edges = np.linspace(min(0.0, scores.min()), max(1.0, scores.max()), BINS + 1)
    bins = bins_of(scores, edges)
    middles = 0.5 * (edges[1:] + edges[:-1])
    counts = np.bincount(bins, minlength=BINS)
    rates = np.bincount(bins, held, BINS) / np.maximum(counts, 1)
    shares, width = 100 * counts / counts.sum(), edges[1] - edges[0]
    axes.bar(middles, shares, width, color=GREY, ec="white", label="share of the grasps")
    enough = counts >= MIN_IN_BIN
    axes.plot(middles[enough], 100 * rates[enough], "o-", color=BLUE, label="that held")
    axes.plot([0, 1], [0, 100], "--", color="black", linewidth=0.8, label="as a probability")
    axes.set(xlabel="score", ylabel="%", ylim=(0, 103))


def _key_figures(summary: dict[str, Any]) -> list[Row]:
    times, ends = summary["planning_seconds"], summary["round_ends"]
    names = ["GSR % [95 % interval]", "DR % [95 % interval]"]
    for seed in summary["grasp_success_rate"]["by_seed"]:
        names.append(f"seed {seed}: GSR, DR")
    names.append("mean ± standard deviation over seeds: GSR, DR")
    rates = [summary[name] for name in RATE_LABELS]
    by_seed = zip(*(rate["by_seed"].values() for rate in rates), strict=True)
    values = [*map(percent, rates), *(", ".join(map(_share, both)) for both in by_seed)]
    values.append(", ".join(map(over_seeds, rates)))
    return [
        ("", ""),
        *zip(names, values, strict=True),
        ("protocol", f"{summary['protocol']}, version {summary['protocol_version']}"),
        ("rounds", ", ".join(f"{count} ended: {end}" for end, count in ends.items())),
        ("grasps held", f"{summary['successes']} of {summary['attempts']}"),
        ("of those another object than the one aimed at", summary["wrong_object_successes"]),
        ("objects", summary["objects"]),
        ("planning, median", f"{times['median']:.2f} s" if times else "-"),
        ("planner asked again", f"{summary['planner_retries']} times"),
    ]


def _published_rows(summary: dict[str, Any], reported: Sequence[dict[str, Any]]) -> Iterator[Row]:
    yield "", "source", "GSR %", "DR %"
    yield "this run", "", *(percent(summary[name]) for name in RATE_LABELS)
    for row in reported:
        yield row["method"], row["source"], *published_rates(row)


def _object_rows(summary: dict[str, Any]) -> Iterator[Row]:
    """Each object, the one removed least often first."""
    yield "object", "present", "removed", "DR %", "aimed at", "held", "GSR %"
    objects = summary["objects_by_name"].items()
    for name, row in sorted(objects, key=lambda item: item[1]["removed"] / item[1]["present"]):
        present, removed, aimed, held = row.values()
        rates = _share(removed / present), _share(held / aimed if aimed else None)
        yield name, present, removed, rates[0], aimed, held, rates[1]


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _flat(prefix: str, value: Any) -> Iterator[Row]:
    """Dotted names and values of nested tables."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _flat(f"{prefix}.{name}".strip("."), part)
    else:
        yield prefix, value


def _failure_pictures(replay: Replay, rounds: Sequence[Round]) -> Iterator[str]:
    """Pictures of failed attempts: one for each cause, then more, `PICTURES` in all."""
    before: Counter[str] = Counter()  # failures with the same cause
    failed = []
    for done in rounds:
        for number, attempt in enumerate(done.attempts):
            if not attempt.success:
                before[str(attempt.cause)] += 1
                failed.append((before[str(attempt.cause)], done, number))
    for _, done, number in sorted(failed, key=lambda each: each[0])[:PICTURES]:
        _, seen = replay.repeat(done.seed, done.index, number)
        title = attempt_title(done, number)
        with tempfile.TemporaryDirectory() as folder:
            file, grasps = Path(folder) / "failure.jpg", [done.attempts[number]]
            draw_grasps(file, seen.cloud, grasps, camera_position=seen.camera_position, title=title)
            yield image("jpeg", file.read_bytes(), title)
