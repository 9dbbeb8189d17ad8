"""The report of a benchmark: one HTML file with tables, plots and pictures."""

import base64
import tempfile
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from textwrap import fill
from typing import Any, Self

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edgegrasp_sim.hand import FailureCause
from edgegrasp_sim.picture import draw_grasps
from edgegrasp_sim.replay import Replay
from edgegrasp_sim.results import ResultFolder, planner_title
from edgegrasp_sim.trial import Attempt, Round

PICTURES = 6
PICTURE_WIDTH = 1250  # pixels
PUBLISHED = Path(__file__).parent / "published.toml"
BLUE, ORANGE, GREY, RED = "#2f6db3", "#e08a1e", "#9aa3ad", "#b3372f"
BINS = 10
LABEL_WIDTH = 13  # letters
MIN_IN_BIN = 5  # attempts; fewer say nothing about a score
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2430; max-width: 1120px;
       margin: 2em auto; padding: 0 1.2em; }
h1 { font-size: 1.7em; margin-bottom: .1em; } h2 { font-size: 1.2em; margin-top: 2em;
     border-bottom: 1px solid #d5dae0; padding-bottom: .2em; }
p.about { color: #56606d; margin-top: 0; }
table { border-collapse: collapse; margin: .8em 0; }
th, td { padding: .28em .9em .28em 0; text-align: left; border-bottom: 1px solid #e6e9ed;
         vertical-align: top; }
th { font-weight: 600; } td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
.plots { display: grid; grid-template-columns: 1fr 1fr; gap: 1.2em; }
.plots img, figure img { max-width: 100%; } figure { margin: 1.2em 0; }
figcaption { color: #56606d; font-size: .93em; } code { overflow-wrap: anywhere; }
.key { display: grid; grid-template-columns: repeat(4, 1fr); gap: 1em; margin: 1em 0; }
.key div { background: #f3f5f8; border-radius: 8px; padding: .7em 1em; }
.key b { display: block; font-size: 1.6em; } .key span { color: #56606d; font-size: .88em; }
"""


def write_report(folder: ResultFolder, objects: Path | None = None) -> Path:
    """Write `report.html` into a result folder.

    Args:
        folder: of a benchmark.
        objects: where its object folder is now; by default where it was.

    Raises:
        FileNotFoundError: the folder holds no benchmark, or its objects are not there.
    """
    rounds = folder.rounds()
    facts = folder.manifest()
    summary = folder.finish(rounds)
    attempts = [attempt for item in rounds for attempt in item.attempts]
    reported = published(facts["run"]["protocol"]["name"], summary["scene"])
    with Replay(folder, objects) as replay:
        pictures = list(_failure_pictures(replay, rounds))
    plots = [rates_plot(summary, reported), failures_plot(summary)]
    if attempts:
        plots.append(times_plot(attempts))
    if len({attempt.score for attempt in attempts}) > 1:
        plots.append(scores_plot(attempts))
    title = f"{planner_title(facts['run']['planner'])} on {summary['scene']} scenes"
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p class=about>Protocol {escape(summary['protocol'])}, version "
        f"{summary['protocol_version']}; {summary['rounds']} rounds with "
        f"{_seeds(facts['seeds'])}; objects: {escape(facts['run']['objects']['name'])}.</p>",
        _key_figures(summary),
        "<h2>Beside published figures</h2>",
        _published_table(summary, reported),
        "<h2>Plots</h2><div class=plots>",
        *(f"<img src='{_plot_source(plot)}' alt='plot'>" for plot in plots),
        "</div>",
        "<h2>Seeds</h2>",
        _seed_table(summary),
        "<h2>Failures</h2>",
        _failure_table(summary),
        *pictures,
        "<h2>Objects</h2>",
        _object_table(summary),
        "<h2>Conditions</h2>",
        _conditions_table(facts),
    ]
    page = (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>"
        + "\n".join(parts)
        + "</body></html>\n"
    )
    path = folder.path / "report.html"
    path.write_text(page)
    return path


@dataclass(frozen=True, slots=True)
class DrawnAttempt:
    """An attempt's grasp as `draw_grasps` takes it."""

    score: float
    T_cloud_hand: NDArray[np.float32]  # (4, 4), the cloud being in the world's frame
    width: float

    @classmethod
    def of(cls, attempt: Attempt) -> Self:
        """The grasp of an attempt."""
        return cls(attempt.score, np.asarray(attempt.T_world_hand, np.float32), attempt.width)


def attempt_title(done: Round, number: int) -> str:
    """One line about an attempt and its outcome."""
    attempt = done.attempts[number]
    outcome = f"{attempt.object} removed" if attempt.success else str(attempt.cause)
    target = attempt.target or "nothing between the fingers"
    return (
        f"seed {done.seed}, round {done.index}, attempt {number}: {outcome} "
        f"(aimed at {target}; score {attempt.score:.2f})"
    )


def published(protocol: str, scene: str, samples: str | None = None) -> list[dict[str, Any]]:
    """The published results of a protocol and scene, in the file's order; rates in per cent.

    Args:
        protocol: its name; a variant, named `<protocol>-<variant>`, includes those of `<protocol>`.
        scene: kind of the scenes.
        samples: only those at these approach points and candidates, such as `32-2k`.
    """
    rows: list[dict[str, Any]] = tomllib.loads(PUBLISHED.read_text())["result"]
    return [
        row
        for row in rows
        if f"{protocol}-".startswith(f"{row['protocol']}-")
        and row["scene"] == scene
        and samples in (None, row.get("samples"))
    ]


def _seeds(seeds: Sequence[int]) -> str:
    return ("seed " if len(seeds) == 1 else "seeds ") + ", ".join(map(str, seeds))


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _interval(rate: dict[str, Any]) -> str:
    if rate["value"] is None:
        return "-"
    low, high = rate["wilson_95"]
    return f"{100 * low:.1f} to {100 * high:.1f}"


def _spread(rate: dict[str, Any]) -> str:
    if rate["mean_over_seeds"] is None:
        return "-"
    mean, std = rate["mean_over_seeds"], rate["std_over_seeds"]
    return f"{100 * mean:.1f}" + (f" ± {100 * std:.1f}" if std is not None else "")


def _table(head: Sequence[str], rows: Iterable[Sequence[object]], numbers: int) -> str:
    """A table whose last `numbers` columns are numbers."""
    first = len(head) - numbers
    kinds = ["" if place < first else " class=n" for place in range(len(head))]
    cells = "".join(f"<th{k}>{escape(h)}</th>" for k, h in zip(kinds, head, strict=True))
    lines = [f"<tr>{cells}</tr>"]
    for row in rows:
        cells = "".join(f"<td{k}>{escape(str(v))}</td>" for k, v in zip(kinds, row, strict=True))
        lines.append(f"<tr>{cells}</tr>")
    return "<table>" + "\n".join(lines) + "</table>"


def _key_figures(summary: dict[str, Any]) -> str:
    gsr, dr = summary["grasp_success_rate"]["value"], summary["declutter_rate"]["value"]
    held, times = summary["successes"], summary["planning_seconds"]
    waited = summary["planner_waited_seconds"]
    boxes = [
        (f"{_percent(gsr)} %", f"GSR: {held} of {summary['attempts']} grasps held"),
        (f"{_percent(dr)} %", f"DR: {held} of {summary['objects']} objects removed"),
        (f"{times['median']:.2f} s" if times else "-", "planning, median"),
        (str(summary["planner_retries"]), f"times asked again; {waited:.1f} s waited"),
    ]
    inner = "".join(f"<div><b>{escape(b)}</b><span>{escape(t)}</span></div>" for b, t in boxes)
    return f"<div class=key>{inner}</div>"


def _published_table(summary: dict[str, Any], published: Sequence[dict[str, Any]]) -> str:
    gsr, dr = summary["grasp_success_rate"], summary["declutter_rate"]
    rows: list[Sequence[object]] = [
        ("this run", "", _spread(gsr), _interval(gsr), _spread(dr), _interval(dr))
    ]
    for row in published:
        rates = (row["grasp_success_rate"], row.get("declutter_rate", []))
        values = [" ± ".join(f"{number:.1f}" for number in rate) for rate in rates]
        rows.append((row["method"], row["source"], values[0], "", values[1], ""))
    head = ("", "source", "GSR %", "95 % interval", "DR %", "95 % interval")
    note = "" if published else "<p>No published figures are known for this scene and protocol.</p>"
    return _table(head, rows, 4) + note


def _seed_table(summary: dict[str, Any]) -> str:
    gsr, dr = summary["grasp_success_rate"], summary["declutter_rate"]
    rows = [
        (seed, _percent(gsr["by_seed"][seed]), _percent(dr["by_seed"][seed]))
        for seed in gsr["by_seed"]
    ]
    rows.append(("mean ± standard deviation", _spread(gsr), _spread(dr)))
    return _table(("seed", "GSR %", "DR %"), rows, 2)


def _failure_table(summary: dict[str, Any]) -> str:
    failed = summary["attempts"] - summary["successes"]
    rows = [
        (cause, count, f"{100 * count / failed:.0f}" if failed and cause != "no candidate" else "")
        for cause, count in summary["failures"].items()
    ]
    ends = ", ".join(f"{end} {count}" for end, count in summary["round_ends"].items())
    return (
        _table(("cause", "times", "% of failures"), rows, 2)
        + f"<p>Rounds ended: {escape(ends)}. Successes that removed another object than the one "
        f"aimed at: {summary['wrong_object_successes']}.</p>"
    )


def _object_table(summary: dict[str, Any]) -> str:
    def worst_first(item: tuple[str, dict[str, int]]) -> tuple[float, str]:
        name, row = item
        return row["removed"] / row["present"], name

    rows = [
        (
            name,
            row["present"],
            row["removed"],
            _percent(row["removed"] / row["present"]),
            row["attempts"],
            row["successes"],
            _percent(row["successes"] / row["attempts"] if row["attempts"] else None),
        )
        for name, row in sorted(summary["objects_by_name"].items(), key=worst_first)
    ]
    head = ("object", "present", "removed", "DR %", "aimed at", "held", "GSR %")
    return _table(head, rows, 6)


def _conditions_table(facts: dict[str, Any]) -> str:
    def flat(prefix: str, value: Any) -> Iterable[tuple[str, str]]:
        if isinstance(value, dict):
            for name, part in value.items():
                yield from flat(f"{prefix}.{name}" if prefix else name, part)
        elif isinstance(value, list):
            yield prefix, ", ".join(map(str, value))
        else:
            yield prefix, str(value)

    rows = [f"<tr><td>{escape(n)}</td><td><code>{escape(v)}</code></td></tr>" for n, v in
            flat("", facts)]  # fmt: skip
    return (
        "<details><summary>every constant, version and digest</summary><table>"
        + "".join(rows)
        + "</table></details>"
    )


def _failure_pictures(replay: Replay, rounds: Sequence[Round]) -> Iterable[str]:
    """Pictures of failed attempts: one for each cause, then more, `PICTURES` in all."""
    failed = [
        (done, number)
        for done in rounds
        for number, attempt in enumerate(done.attempts)
        if not attempt.success
    ]
    by_cause = [
        [(d, n) for d, n in failed if d.attempts[n].cause is cause] for cause in FailureCause
    ]
    depth = max((len(same) for same in by_cause), default=0)
    ordered = [same[k] for k in range(depth) for same in by_cause if k < len(same)]
    for done, number in ordered[:PICTURES]:
        _, seen = replay.repeat(done.seed, done.index, number)
        title = attempt_title(done, number)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "failure.png"
            grasp = DrawnAttempt.of(done.attempts[number])
            draw_grasps(
                file, seen.cloud, [grasp], camera_position=seen.camera_position, title=title
            )
            source = _small_picture(file)
        yield f"<figure><img src='{source}' alt='{escape(title, quote=True)}'></figure>"


def _small_picture(file: Path) -> str:
    from PIL import Image

    with Image.open(file) as image:
        size = (PICTURE_WIDTH, round(image.height * PICTURE_WIDTH / image.width))
        small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    stream = BytesIO()
    small.save(stream, "JPEG", quality=85)
    return _source("jpeg", stream.getvalue())


def _plot_source(figure: Figure) -> str:
    stream = BytesIO()
    figure.savefig(stream, format="png")
    return _source("png", stream.getvalue())


def _source(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


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
    """Calibration: success against score, and the distribution of scores."""
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
    """The distribution of planning times."""
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
