"""Experiments: benchmarks that differ in one thing each, and their table and figure."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any, TypeAlias

import numpy as np
from matplotlib.figure import Figure

from edgegrasp_sim.objects import FAMILIES, SceneKind, write_family
from edgegrasp_sim.protocol import Protocol, load_protocol
from edgegrasp_sim.results import RATE_LABELS, percent, planner_title

NOISE_MILLIMETRES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
VOXEL_MILLIMETRES = (3.0, 4.0, 5.0, 6.0, 8.0)
POLAR_DEGREES = (15.0, 30.0, 45.0, 60.0, 75.0)
FLIPPED_PERCENT = (0.0, 5.0, 10.0, 25.0, 50.0)
# Approach points and candidates, named as in the paper's table.
SAMPLES = {"16-1k": (16, 1000), "32-2k": (32, 2000), "64-4k": (64, 4000)}
BASELINES = ("edge-sample", "oracle", "oracle-own")
COLOURS = {"packed": "#2f6db3", "pile": "#e08a1e", "bin": "#3a9d5d", "table": "#8a4fb0"}
STYLES = ("-", "--", ":", "-.")  # of the models


@dataclass(frozen=True, slots=True)
class Case:
    """One benchmark of an experiment."""

    group: str  # what varies
    value: float | str  # its value here
    scene: SceneKind
    protocol: Protocol  # the constants, with the one that varies
    planner: dict[str, Any] = field(default_factory=dict)  # fields of the planner that vary
    objects: Path | None = None  # folder; None: the experiment's

    @property
    def name(self) -> str:
        """A name for its folder."""
        value = self.value if isinstance(self.value, str) else f"{self.value:g}"
        model = self.planner.get("model", "")
        parts = (self.scene.value, self.group, value, re.sub(r".*/", "", model))
        return re.sub(r"[^\w.]+", "-", "-".join(part for part in parts if part))


# What varies: group, value, protocol, fields of the planner, folder of the objects.
Variant: TypeAlias = tuple[str, float | str, Protocol, dict[str, Any], Path | None]


def cases_of(
    name: str,
    protocol: Protocol,
    scenes: Sequence[SceneKind],
    models: Sequence[str],
    folder: Path,
) -> list[Case]:
    """The benchmarks of an experiment.

    Objects that it makes go into the folder.

    Raises:
        ValueError: no such experiment, or `labels` with a model that is not a file in a folder
            named by a number.
    """
    if name not in EXPERIMENTS:
        raise ValueError(f"name is {name!r}; choose one of {', '.join(EXPERIMENTS)}")
    cases = []
    for scene in scenes:
        for model in [None] if name == "baselines" else models:
            named = {} if model is None else {"model": model}
            for variant in EXPERIMENTS[name](protocol, model or "", folder):
                group, value, rules, planner, objects = variant
                cases.append(Case(group, value, scene, rules, named | planner, objects))
    return cases


def robustness(protocol: Protocol, model: str, folder: Path) -> Iterator[Variant]:
    """Success against noise, voxel size, height of the camera, flipped normals, and view."""
    for value in NOISE_MILLIMETRES:
        noise = replace(protocol.noise, point_std=value / 1000)
        changed = replace(protocol, name=f"{protocol.name}, noise", noise=noise)
        yield "noise (mm)", value, changed, {}, None
    for value in VOXEL_MILLIMETRES:
        yield "voxel size (mm)", value, protocol, {"voxel_size": value / 1000}, None
    for value in POLAR_DEGREES:
        camera = replace(protocol.camera, polar_degrees=(value, value))
        changed = replace(protocol, name=f"{protocol.name}, polar angle", camera=camera)
        yield "camera's polar angle (degrees)", value, changed, {}, None
    for value in FLIPPED_PERCENT:
        yield "normals flipped (%)", value, protocol, {"flipped_normals": value / 100}, None
    giga = load_protocol("giga")
    moved = replace(protocol, name=f"{protocol.name}, giga's camera", camera=giga.camera)
    for view in (protocol, moved, giga):
        yield "view", view.name, view, {}, None


def samples(protocol: Protocol, model: str, folder: Path) -> Iterator[Variant]:
    """Success against the number of approach points and candidates (the paper's table)."""
    for name, (points, candidates) in SAMPLES.items():
        numbers = {"num_approach_points": points, "num_candidates": candidates}
        yield "samples", name, protocol, numbers, None


def labels(protocol: Protocol, model: str, folder: Path) -> Iterator[Variant]:
    """Success against the number of training labels, which names the folder of a weights file."""
    number = PurePath(model).parent.name
    if not number.isdecimal():
        raise ValueError(
            f"model is {model!r}; name files in folders named by their number of labels, "
            "such as runs/3000/edgegrasp-plus.safetensors"
        )
    yield "labels", float(number), protocol, {}, None


def families(protocol: Protocol, model: str, folder: Path) -> Iterator[Variant]:
    """Success on thin, flat and large objects, written into the experiment's folder."""
    whole = replace(protocol.scene, packed_scale=(1.0, 1.0), pile_scale=(1.0, 1.0))
    changed = replace(protocol, name=f"{protocol.name}, families", scene=whole)
    for name in FAMILIES:
        yield "family", name, changed, {}, write_family(name, folder / "objects" / name)


def baselines(protocol: Protocol, model: str, folder: Path) -> Iterator[Variant]:
    """Success of random candidates, and of the best choice among them; models do not matter."""
    rules = protocol.planning
    numbers = {
        "num_approach_points": rules.num_approach_points,
        "num_candidates": rules.num_candidates,
    }
    for name in BASELINES:
        yield "planner", name, protocol, {"name": name} | numbers, None


EXPERIMENTS: dict[str, Callable[[Protocol, str, Path], Iterator[Variant]]] = {
    "robustness": robustness,
    "samples": samples,
    "labels": labels,
    "families": families,
    "baselines": baselines,
}


def experiment_table(results: dict[str, Any]) -> str:
    """Markdown tables of an experiment, one for each group; per cent with 95 % intervals."""
    parts = []
    for group, cases in _by(_group, results["cases"]).items():
        columns = _by(_line, cases)
        lines = [
            f"| {group} | " + " | ".join(f"{head}: GSR | DR" for head in columns) + " |",
            "| --- |" + " --- | --- |" * len(columns),
        ]
        for value, row in _by(lambda case: case["value"], cases).items():
            found = {_line(case): case for case in row}
            cells = [
                percent(found[head][name]) if head in found else ""
                for head in columns
                for name in RATE_LABELS
            ]
            text = value if isinstance(value, str) else f"{value:g}"
            lines.append(f"| {text} | " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def experiment_figure(results: dict[str, Any]) -> Figure:
    """GSR and DR of an experiment with 95 % intervals: a row of axes for each group."""
    groups = _by(_group, results["cases"])
    figure = Figure(figsize=(9.6, 3.0 * len(groups)), dpi=90, layout="constrained")
    axes: Any = figure.subplots(len(groups), len(RATE_LABELS), squeeze=False, sharey=True)
    for row, (group, cases) in zip(axes, groups.items(), strict=True):
        for place, (name, label) in zip(row, RATE_LABELS.items(), strict=True):
            _draw(place, cases, name)
            place.set(xlabel=group, ylabel=f"{label} (%)", ylim=(0, 102))
            place.grid(alpha=0.25)
            if group == "labels":
                place.set_xscale("log")
            place.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(fontsize=8, loc="best")
    return figure


def _draw(axes: Any, cases: list[dict[str, Any]], name: str) -> None:
    """One rate against the values, a line for each scene and model; side by side if named."""
    values = list(_by(lambda case: case["value"], cases))
    numbers = all(not isinstance(value, str) for value in values)
    lines = _by(_line, cases)
    models = list(_by(lambda case: planner_title(case["planner"]), cases))
    for number, (label, line) in enumerate(lines.items()):
        known = [case for case in line if case[name]["value"] is not None]
        if not known:
            continue
        at = [case["value"] if numbers else values.index(case["value"]) for case in known]
        aside = 0.0 if numbers else 0.12 * (number - (len(lines) - 1) / 2)
        rates = [[case[name]["value"], *case[name]["wilson_95"]] for case in known]
        middle, low, high = 100 * np.array(rates).T
        spread = np.maximum(np.stack((middle - low, high - middle)), 0.0)
        style = STYLES[models.index(planner_title(known[0]["planner"])) % len(STYLES)]
        axes.errorbar(
            np.array(at, float) + aside, middle, spread, capsize=3, marker="o", markersize=4,
            color=COLOURS[known[0]["scene"]], linestyle=style if numbers else "none", label=label,
        )  # fmt: skip
    if not numbers:
        axes.set_xticks(range(len(values)), values)
        axes.set_xlim(-0.5, len(values) - 0.5)


def _group(case: dict[str, Any]) -> str:
    return str(case["group"])


def _line(case: dict[str, Any]) -> str:
    """Scene and model of a case; the scene alone where planners are what varies."""
    named = "" if case["group"] == "planner" else f", {planner_title(case['planner'])}"
    return f"{case['scene']}{named}"


def _by(
    key: Callable[[dict[str, Any]], Any], cases: Iterable[dict[str, Any]]
) -> dict[Any, list[dict[str, Any]]]:
    """Cases by a key, in the order of their first."""
    found: dict[Any, list[dict[str, Any]]] = {}
    for case in cases:
        found.setdefault(key(case), []).append(case)
    return found
