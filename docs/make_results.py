"""Writes docs/results.md: `python docs/make_results.py [RESULTS_DIR]`.

Results found below RESULTS_DIR (folders of `edgegrasp benchmark`, `edgegrasp experiment` and
`edgegrasp train`) are first boiled down to docs/results/, where what is found again replaces what
was there; the page is written from that folder alone.
"""

import csv
import json
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_sim.experiment_report import experiment_table, percent, title_of
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.published import published
from edgegrasp_sim.record import record_of
from edgegrasp_sim.results import ResultFolder
from edgegrasp_training.recipes import RECIPES

Curves = dict[str, list[dict[str, float]]]  # by run: its log's rows, numbers by column

DOCS = Path(__file__).parent
KEPT_CURVE_POINTS = 40
SCENES = ("packed", "pile")
INTRODUCTION = """\
# Results

Grasp success rate (GSR) and declutter rate (DR) of simulated clutter removal, in per cent with
Wilson 95 % intervals; [benchmark.md](benchmark.md) says what a round is. `OBJECTS` are the
reference system's test objects, which no weights were trained on. Published figures stand as their
papers give them, mean ± standard deviation over seeds where they say so.

Protocols are in version 2 (`giga` in 3). In version 1 the simulator's table was 12 mm thick: of
1,000 objects dropped on heaps 100 were gone before the first view, where 43 are now, and others
stuck in it, where no hand could lift them. Now it is 200 mm thick. The grasps that the reference
simulator judged come out as before ([benchmark.md](benchmark.md#how-hard-the-simulator-is)).

This page is written by `python docs/make_results.py RESULTS_DIR` from the folders that the
commands below leave; what it keeps of them is in `docs/results/`.
"""
# Experiment: heading, command, and what is asked of it.
EXPERIMENTS = {
    "baselines": (
        "Random candidates, and the best that could be made of them",
        "edgegrasp experiment baselines --rounds 100 --objects OBJECTS --output DIR",
        "Edge-Sample takes any of the paper's candidates, the oracle one that holds when tried in "
        "a copy of the scene; `oracle-own` has the pipeline's own candidates to choose from.",
    ),
    "samples": (
        "Approach points and candidates",
        "edgegrasp experiment samples --rounds 100 --objects OBJECTS --output DIR",
        "The paper's table: 16, 32 or 64 approach points with 1,000, 2,000 or 4,000 candidates.",
    ),
    "labels": (
        "Labels",
        "edgegrasp experiment labels --model runs/labels/NUMBER/edgegrasp-plus.safetensors "
        "--rounds 100 --objects OBJECTS --output DIR",
        "`edgegrasp-plus` trained alike on parts of the data (shares 0.01, 0.06, 0.3 and 1), by "
        "`edgegrasp train DATA --training-share SHARE --steps 800 --schedule cosine "
        "--views-per-step 24 --balls-per-view 4 --run runs/labels/NUMBER`; weights that ship had "
        "4,500 steps.",
    ),
    "robustness": (
        "Robustness",
        "edgegrasp experiment robustness --rounds 100 --objects OBJECTS --output DIR",
        "One thing is changed at a time; the protocol has 1 mm noise, a polar angle of 45 to 60 "
        "degrees, the weights have a voxel size of their own. `giga` is a fixed side view with "
        "noise that also moves a whole image by some 3 % of its depth (19 mm), which the table in "
        "the view betrays: `support.max_depth_error`. Its camera alone has the protocol's noise.",
    ),
    "families": (
        "Objects of other families",
        "edgegrasp experiment families --rounds 100 --output DIR",
        "Prisms: regular (30 to 80 mm), thin (at most 14 mm across), flat (8 to 14 mm high) and "
        "large (60 to 70 mm across, in a hand that opens 80 mm).",
    ),
}
# Methods whose published figures stand beside an experiment's.
PUBLISHED = {
    "baselines": ("Edge-Sample",),
    "samples": ("EdgeGraspNet", "VN-EdgeGraspNet", "Edge Grasp Network, 32-2k"),
}
BENCHMARK = (
    "edgegrasp benchmark --scene packed --rounds 100 --seed 0 --seed 1 --objects OBJECTS "
    "--num-approach-points 32 --num-candidates 2000 --output DIR"
)
# Counted in the authors' checkpoint files.
AUTHORS_PARAMETERS = {"edgegrasp": 3_048_993, "vn-edgegrasp": 1_702_268}
NOT_YET = "Not measured yet."
DIFFERENCES = """\
- `edgegrasp` at 32-2k and, in 40 rounds, at 64-4k: the paper's figures lie within its intervals.
- `vn-edgegrasp` is 3 to 4 points of GSR below the paper, in DR 2 below it (packed) and 1 above it
  (piles). It saw 11,200 balls in half an hour of one processor core.
- Random rotations: the paper's network needs them. Here they hold training back: detectors turn
  every cloud upright and toward its camera before a network sees it, so that few rotations are
  left to be learned.
- NoBall: after as many steps, whole scenes do no worse than balls here. What stands around a ball
  tells what a hand would hit. So short a run of one seed does not say which ends up better.
- Edge-Sample depends on how dense clouds are: with the reference's fused clouds it does as in the
  paper, with one point for each pixel it finds fewer contacts aslant
  ([benchmark.md](benchmark.md)).
- Labels: the first hundred thousand bring 1 to 3 points of GSR over 7,699, further ones hardly
  anything: what the candidates offer and what one view hides sets the limit.
- `edgegrasp-plus` has what the paper's networks have not: level grasps on low things, centred hands
  on wide ones, and scores of hands where they are. What it fails on is about as wide as the hand
  opens, or a ring, which the simulator takes for solid.
"""


def collect(results: Path, kept: Path) -> None:
    """Boil down every result below a folder into another.

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
    if drawn := _read(kept / "curves.json"):
        curves_figure(drawn).savefig(kept / "curves.png")


def page(kept: Path) -> str:
    """The whole page, from the folder of what is kept."""
    return "\n".join([INTRODUCTION, *_sections(kept)])


def _sections(kept: Path) -> Iterator[str]:
    yield "## Shipped weights and ablations\n"
    records = _read(kept / "benchmarks.json")
    for scene in SCENES:
        yield f"### {scene.capitalize()} scenes\n"
        yield _benchmark_table([r for r in records.values() if r["scene"] == scene], scene)
    yield "Each row by its command:\n"
    commands = sorted({command_of(record) for record in records.values()}) or [BENCHMARK]
    yield _console(commands)
    for name, (heading, command, text) in EXPERIMENTS.items():
        yield f"## {heading}\n"
        yield text + "\n"
        yield from _published_table(PUBLISHED.get(name, ()))
        found = _read(kept / f"{name}.json")
        yield _console([found.get("command", command)])
        if not found:
            yield NOT_YET + "\n"
            continue
        rounds, seeds = found["cases"][0]["rounds"], found["cases"][0]["seeds"]
        version = found["cases"][0]["protocol"]["version"]
        under = "" if version == load_protocol("edgegrasp").version else f", version {version}"
        yield f"{rounds} rounds for each of the seeds {', '.join(map(str, seeds))}{under}.\n"
        yield experiment_table(found)
        yield f"![{heading}](results/{name}.png)\n"
    yield "## Parameters\n"
    yield _parameters_table()
    yield "## Training\n"
    yield from _training(_read(kept / "curves.json"))
    yield "## Where these differ from the paper\n"
    yield DIFFERENCES


def command_of(record: dict[str, Any]) -> str:
    """The command that gives a benchmark's figures again."""
    planner, options = record["planner"], record["planner"].get("options", {})
    words = ["edgegrasp", "benchmark", "--scene", record["scene"]]
    words += ["--protocol", record["protocol"]["name"], "--planner", planner["name"]]
    if "model" in planner:
        words += ["--model", planner["model"]]
    words += ["--rounds", str(record["rounds"])]
    words += [word for seed in record["seeds"] for word in ("--seed", str(seed))]
    if not record["objects"]["name"].startswith("builtin/"):
        words += ["--objects", "OBJECTS"]
    for name in ("num_approach_points", "num_candidates", "collision", "min_score"):
        if name in planner or name in options:
            words += ["--" + name.replace("_", "-"), str(planner.get(name, options.get(name)))]
    return shlex.join(words)


def _benchmark_table(records: Sequence[dict[str, Any]], scene: str) -> str:
    head = ("weights or planner", "protocol", "samples", "rounds", "GSR", "DR", "planning")
    lines = [head, ("---",) * len(head)]
    for record in records:
        options = record["planner"] | record["planner"].get("options", {})
        numbers = [str(options.get(n, "")) for n in ("num_approach_points", "num_candidates")]
        seconds = record["planning_seconds_median"]
        least = f", scores from {options['min_score']:g}" if "min_score" in options else ""
        lines.append(
            (
                title_of(record["planner"]) + least,
                _version(record["protocol"]),
                "-".join(filter(None, numbers)) or "the protocol's",
                f"{record['rounds']} for each of {', '.join(map(str, record['seeds']))}",
                percent(record["grasp_success_rate"]),
                percent(record["declutter_rate"]),
                f"{seconds:.2f} s" if seconds is not None else "",
            )
        )
    for row in published("edgegrasp", scene):
        title = f"*{row['method']}* ({row['source']})"
        lines.append((title, "edgegrasp", row.get("samples", ""), "", *_rates(row), ""))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _version(protocol: dict[str, Any]) -> str:
    """A protocol's name, and its version where it is not the present one."""
    name, version = protocol["name"], protocol["version"]
    return name if version == load_protocol(name).version else f"{name}, version {version}"


def _parameters_table() -> str:
    """How many numbers each network learns, beside the checkpoints of the paper's authors."""
    lines = ["| weights | parameters | in the authors' checkpoint |", "| --- | --- | --- |"]
    for name, config in RECIPES.items():
        network = build_network(config, torch.Generator().manual_seed(0))
        count = sum(parameter.numel() for parameter in network.parameters())
        theirs = AUTHORS_PARAMETERS.get(name)
        lines.append(f"| {name} | {count:,} | {'' if theirs is None else f'{theirs:,}'} |")
    return "\n".join(lines) + "\n"


def _training(curves: Curves) -> Iterator[str]:
    yield (
        "How the loss on held-out scenes falls: with rotations, without, vector neurons, whole "
        "clouds in place of balls. Each folder is one `edgegrasp train`.\n"
    )
    if not curves:
        yield NOT_YET + "\n"
        return
    lines: list[tuple[str, ...]] = [
        ("run", "steps", "validation loss", "accuracy", "AUROC"),
        ("---",) * 5,
    ]
    for name, rows in curves.items():
        last = rows[-1]
        lines.append(
            (name, *(f"{last[c]:g}" for c in ("step", "validation_loss", "accuracy", "auroc")))
        )
    yield "".join(f"| {' | '.join(line)} |\n" for line in lines)
    yield "![Loss curves](results/curves.png)\n"


def curves_figure(curves: Curves) -> Figure:
    """Validation loss and AUROC against steps, a line for each run."""
    figure = Figure(figsize=(9.6, 3.4), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
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


def _published_table(methods: Sequence[str]) -> Iterator[str]:
    """The published figures of some methods, scenes side by side."""
    lines = []
    for method in methods:
        cells: list[str] = []
        for scene in SCENES:
            (row,) = [r for r in published("edgegrasp", scene) if r["method"] == method]
            cells += _rates(row)
        lines.append((f"*{method}*", row.get("samples", ""), *cells))
    if lines:
        head = ("published", "samples", "packed: GSR", "DR", "pile: GSR", "DR")
        table = [head, ("---",) * len(head), *lines]
        yield "".join(f"| {' | '.join(line)} |\n" for line in table)


def _rates(row: dict[str, Any]) -> tuple[str, str]:
    """Published GSR and DR: mean, and standard deviation where it is known."""
    gsr, dr = (
        " ± ".join(f"{number:.1f}" for number in row.get(name, ()))
        for name in ("grasp_success_rate", "declutter_rate")
    )
    return gsr, dr


def _curve(file: Path) -> list[dict[str, float]]:
    """A training log, thinned: numbers by column, the last among them."""
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
    """Collect results where a folder is named, then write the page."""
    for folder in arguments:
        collect(Path(folder), DOCS / "results")
    (DOCS / "results.md").write_text(page(DOCS / "results"))


if __name__ == "__main__":
    main(sys.argv[1:])
