"""Writes the tables of settings.md and results.md: `python docs/make_tables.py [RESULTS_DIR]`.

What stands between `<!-- begin: NAME -->` and `<!-- end -->` is written anew. Results found below
RESULTS_DIR (folders of `edgegrasp benchmark`, `experiment` and `train`) are first summarised in
docs/results/, where they replace earlier results of the same name; the tables are written from that
folder alone.
"""

import csv
import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from edgegrasp_service.settings import Settings
from edgegrasp_sim.experiments import experiment_table
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.report import published, published_rates
from edgegrasp_sim.results import ResultFolder, percent, planner_title, record_of

Curves = dict[str, list[dict[str, float]]]  # by run: its log's rows, numbers by column

DOCS = Path(__file__).parent
GRIPPERS = DOCS.parent / "examples" / "grippers"
BLOCK = re.compile(r"(<!-- begin: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
KEPT_CURVE_POINTS = 40
SCENES = ("packed", "pile")
CAMERA_SCENES = ("bin", "table")  # by protocols of the same name
# Experiment: methods whose published figures stand beside it.
EXPERIMENTS: dict[str, tuple[str, ...]] = {
    "baselines": ("Edge-Sample",),
    "samples": ("EdgeGraspNet", "VN-EdgeGraspNet", "Edge Grasp Network, 32-2k"),
    "labels": (),
    "robustness": (),
    "families": (),
}
NOT_YET = "Not measured yet.\n"


def collect(results: Path, kept: Path) -> None:
    """Summarise every result below a folder in another.

    Raises:
        FileNotFoundError: there is nothing of the kind.
    """
    kept.mkdir(exist_ok=True)
    experiments = sorted(path.parent for path in results.rglob("experiment.json"))
    inside = {path / "cases" for path in experiments}
    benchmarks = [
        path.parent
        for path in sorted(results.rglob("summary.json"))
        if not inside & set(path.parents)
    ]
    curves = sorted(results.rglob("log.csv"))
    if not (experiments or benchmarks or curves):
        raise FileNotFoundError(f"{results} holds no results of benchmark, experiment or train")
    for folder in experiments:
        found = json.loads((folder / "experiment.json").read_text())
        _write(kept / f"{found['experiment']}.json", found)
        shutil.copyfile(folder / "picture.png", kept / f"{found['experiment']}.png")
    _merge(kept / "benchmarks.json", {f.name: record_of(ResultFolder(f)) for f in benchmarks})
    _merge(kept / "curves.json", {file.parent.name: _curve(file) for file in curves})
    if hands := _hands(_read(kept / "benchmarks.json").values()):
        hands_figure(hands).savefig(kept / "hands.png")
    if drawn := _read(kept / "curves.json"):
        curves_figure(drawn).savefig(kept / "curves.png")


def pages() -> dict[Path, str]:
    """The text of every page that has such tables.

    Raises:
        ValueError: a page lacks the place of a table, or has one for another.
    """
    settings = {"settings": table(("setting", "default", "range", "meaning"), _settings())}
    return {
        DOCS / "settings.md": _filled(DOCS / "settings.md", settings),
        DOCS / "results.md": _filled(DOCS / "results.md", blocks(DOCS / "results")),
    }


def _filled(page: Path, blocks: Mapping[str, str]) -> str:
    text = page.read_text()
    places = [match[2] for match in BLOCK.finditer(text)]
    if sorted(places) != sorted(blocks):
        raise ValueError(f"{page.name} has places for {places}, and there are {list(blocks)}")
    return BLOCK.sub(lambda match: f"{match[1]}\n{blocks[match[2]]}\n{match[3]}", text)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _settings() -> Iterator[list[str]]:
    for name, field in Settings.model_json_schema()["properties"].items():
        default = field.get("default")
        shown = "none" if default in (None, [], "") else f"`{json.dumps(default)}`"
        yield [f"`{name}`", shown, _range(field), field["description"]]


def _range(field: Mapping[str, Any]) -> str:
    if "enum" in field:
        return ", ".join(f"`{word}`" for word in field["enum"])
    low = field.get("minimum", field.get("exclusiveMinimum"))
    high = field.get("maximum")
    above = "above " if "exclusiveMinimum" in field else ""
    if low is None:
        return ""
    return f"{above}{low:g} and more" if high is None else f"{above}{low} to {high}"


def blocks(kept: Path) -> dict[str, str]:
    """What results.md gets, from the folder of what is kept, by the name of its place."""
    records = _read(kept / "benchmarks.json").values()
    others = [r for r in records if "/" not in r["objects"]["name"]]
    with_panda = [r for r in records if r not in others and r["hand"] == "panda"]
    written = {
        scene: _benchmark_table([r for r in with_panda if r["scene"] == scene])
        for scene in SCENES + CAMERA_SCENES
    }
    written["published"] = _papers_table()
    written["commands"] = _commands(with_panda)
    written["adversarial"] = _scores_table(others) + "\n" + _commands(others)
    written["hands"] = _scores_table(_hands(records)) + "\n![Hands](results/hands.png)\n"
    for name, methods in EXPERIMENTS.items():
        found = _read(kept / f"{name}.json")
        measured = _experiment(name, found) if found else [NOT_YET]
        written[name] = "\n".join([*_published_table(methods), *measured])
    written["training"] = _training(_read(kept / "curves.json"))
    return written


def _experiment(name: str, found: dict[str, Any]) -> Iterator[str]:
    first = found["cases"][0]
    version = first["protocol"]["version"]
    under = "" if version == load_protocol("edgegrasp").version else f", version {version}"
    seeds = ", ".join(map(str, first["seeds"]))
    yield _console([found["command"]])
    yield f"{first['rounds']} rounds for each of the seeds {seeds}{under}.\n"
    yield experiment_table(found)
    yield f"![{name.capitalize()}](results/{name}.png)\n"


def command_of(record: dict[str, Any]) -> str:
    """The command that gives a benchmark's figures again."""
    planner, options = record["planner"], record["planner"].get("options", {})
    words = ["edgegrasp", "benchmark", "--scene", record["scene"]]
    words += ["--protocol", record["protocol"]["name"], "--planner", planner["name"]]
    if record["engine"] != "pybullet":
        words += ["--engine", record["engine"]]
    if (hand := record["hand"]) != "panda":
        own = GRIPPERS / f"{hand}.toml"
        words += ["--gripper", f"examples/grippers/{own.name}" if own.is_file() else hand]
    if "model" in planner:
        words += ["--model", planner["model"]]
    words += ["--rounds", str(record["rounds"])]
    words += [word for seed in record["seeds"] for word in ("--seed", str(seed))]
    objects = record["objects"]["name"]
    if not objects.startswith("builtin/"):
        words += ["--objects", "OBJECTS" if "/" in objects else objects]
    for name in ("num_approach_points", "num_candidates", "collision", "min_score"):
        if name in planner or name in options:
            words += ["--" + name.replace("_", "-"), str(planner.get(name, options.get(name)))]
    return shlex.join(words)


def _benchmark_table(records: Sequence[dict[str, Any]]) -> str:
    head = ("weights or planner", "protocol", "samples", "rounds", "GSR", "DR", "planning")
    lines: list[tuple[str, ...]] = []
    for record in records:
        options = record["planner"] | record["planner"].get("options", {})
        numbers = [str(options.get(n, "")) for n in ("num_approach_points", "num_candidates")]
        seconds = record["planning_seconds_median"]
        least = f", scores from {options['min_score']:g}" if "min_score" in options else ""
        lines.append(
            (
                planner_title(record["planner"]) + least,
                _version(record),
                "-".join(filter(None, numbers)) or "the protocol's",
                f"{record['rounds']} for each of {', '.join(map(str, record['seeds']))}",
                percent(record["grasp_success_rate"]),
                percent(record["declutter_rate"]),
                f"{seconds:.2f} s" if seconds is not None else "",
            )
        )
    return table(head, lines)


def _scores_table(records: Sequence[dict[str, Any]]) -> str:
    """Rates, those without what no grasp can hold, and how far scores are probabilities."""
    head = ("hand", "scene", "objects", "GSR", "DR", "too wide", "GSR of others", "DR of others")
    lines = []
    for record in records:
        wide, scores = record["too_wide"], record["reliability"]
        lines.append(
            (
                record["hand"],
                record["scene"] + _engine(record),
                str(record["objects_present"]),
                *(percent(record[f"{name}_rate"]) for name in ("grasp_success", "declutter")),
                str(wide["objects"]),
                *(percent(wide[f"{n}_rate_of_others"]) for n in ("grasp_success", "declutter")),
                f"{scores['mean_score']:.3f}",
                f"{record['successes'] / record['attempts']:.3f}",
                f"{scores['brier']:.3f}",
            )
        )
    return table((*head, "mean score", "held", "Brier"), lines)


def _hands(records: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those of every hand under the same protocol, the Panda's first."""
    paper = [
        r
        for r in records
        if (r["protocol"]["name"], r["engine"]) == ("edgegrasp", "pybullet")
        and r["planner"].get("model") == "edgegrasp-plus"
        and "/" in r["objects"]["name"]
    ]
    return sorted(paper, key=lambda r: (r["hand"] != "panda", r["hand"], r["scene"]))


def hands_figure(records: Sequence[dict[str, Any]]) -> Figure:
    """The share that held against the score, a line for each hand and scene."""
    figure = Figure(figsize=(9.6, 3.8), dpi=90, layout="constrained")
    for axes, scene in zip(figure.subplots(1, 2, sharey=True), SCENES, strict=True):
        for record in (r for r in records if r["scene"] == scene):
            tenths = record["reliability"]["tenths"]
            places = [[each[name] for each in tenths] for name in ("score", "held")]
            axes.plot(*places, "o-", ms=3, label=record["hand"])
        axes.plot([0, 1], [0, 1], "--", color="black", linewidth=0.8)
        axes.set(xlabel="score", ylabel="share that held", title=scene)
        axes.grid(alpha=0.25)
    lines = figure.axes[0].get_lines()[:-1]
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), fontsize=8)
    return figure


def _commands(records: Sequence[dict[str, Any]]) -> str:
    return _console(sorted({command_of(record) for record in records}))


def _version(record: dict[str, Any]) -> str:
    """A protocol's name, its version where it is not the present one, and another engine."""
    name, version = record["protocol"]["name"], record["protocol"]["version"]
    now = load_protocol(name).version
    return name + (f", version {version}" if version != now else "") + _engine(record)


def _engine(record: dict[str, Any]) -> str:
    return "" if record["engine"] == "pybullet" else f", {record['engine']}"


def _training(curves: Curves) -> str:
    if not curves:
        return NOT_YET
    columns = ("step", "validation_loss", "accuracy", "auroc")
    last = [(name, *(f"{rows[-1][c]:g}" for c in columns)) for name, rows in curves.items()]
    head = ("run", "steps", "validation loss", "accuracy", "AUROC")
    return table(head, last) + "\n![Loss curves](results/curves.png)\n"


def curves_figure(curves: Curves) -> Figure:
    """Validation loss and AUROC against steps, a line for each run."""
    figure = Figure(figsize=(9.6, 3.4), dpi=90, layout="constrained")
    for axes, column, label in zip(
        figure.subplots(1, 2),
        ("validation_loss", "auroc"),
        ("validation loss", "validation AUROC"),
        strict=True,
    ):
        for name, rows in curves.items():
            axes.plot([r["step"] for r in rows], [r[column] for r in rows], label=name)
        axes.set(xlabel="step", ylabel=label)
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8)
    return figure


def _papers_table() -> str:
    """Every published figure with its paper, scenes side by side."""
    lines = []
    for protocol, view in (("edgegrasp", "random"), ("giga", "fixed, from the side")):
        scenes = [{row["method"]: row for row in published(protocol, scene)} for scene in SCENES]
        for method, row in scenes[0].items():
            rates = [cell for scene in scenes for cell in published_rates(scene[method])]
            lines.append((f"[{method}]({row['paper']})", view, row["source"], *rates))
    head = ("method", "view", "source or cost", "packed: GSR", "DR", "pile: GSR", "DR")
    return table(head, lines)


def _published_table(methods: Sequence[str]) -> Iterator[str]:
    """The published figures of some methods, scenes side by side."""
    lines = []
    for method in methods:
        cells: list[str] = []
        for scene in SCENES:
            (row,) = [r for r in published("edgegrasp", scene) if r["method"] == method]
            cells += published_rates(row)
        lines.append((f"*{method}*", row.get("samples", ""), *cells))
    if lines:
        head = ("published", "samples", "packed: GSR", "DR", "pile: GSR", "DR")
        yield table(head, lines)


def _curve(file: Path) -> list[dict[str, float]]:
    """Some rows of a training log, the last among them: numbers by column."""
    with file.open(newline="") as opened:
        rows = [
            {name: round(float(value), 5) for name, value in row.items() if value}
            for row in csv.DictReader(opened)
        ]
    step = -(-len(rows) // KEPT_CURVE_POINTS)
    return rows[::-1][:: max(1, step)][::-1]


def _console(commands: Sequence[str]) -> str:
    return "```console\n" + "".join(f"$ {command}\n" for command in commands) + "```\n"


def _read(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    return found


def _merge(file: Path, found: dict[str, Any]) -> None:
    if found:
        _write(file, dict(sorted((_read(file) | found).items())))


def _write(file: Path, content: dict[str, Any]) -> None:
    file.write_text(json.dumps(content, indent=1) + "\n")


def main(arguments: Sequence[str]) -> None:
    """Collect results where a folder is named, then write the tables."""
    for folder in arguments:
        collect(Path(folder), DOCS / "results")
    for page, text in pages().items():
        page.write_text(text)


if __name__ == "__main__":
    main(sys.argv[1:])
