"""Experiments: benchmarks that differ in one thing each, and their table and figure."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any, TypeAlias

import numpy as np
from matplotlib.figure import Figure

from edgegrasp_sim.objects import FAMILIES, SceneKind, write_family
from edgegrasp_sim.protocol import Protocol, load_protocol
from edgegrasp_sim.results import planner_title

NOISE_MILLIMETRES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
VOXEL_MILLIMETRES = (3.0, 4.0, 5.0, 6.0, 8.0)
POLAR_DEGREES = (15.0, 30.0, 45.0, 60.0, 75.0)
FLIPPED_PERCENT = (0.0, 5.0, 10.0, 25.0, 50.0)
# Approach points and candidates, named as in the paper's table.
SAMPLES = {"16-1k": (16, 1000), "32-2k": (32, 2000), "64-4k": (64, 4000)}
BASELINES = ("edge-sample", "oracle", "oracle-own")
RATES = (("grasp_success_rate", "GSR"), ("declutter_rate", "DR"))
COLOURS = {"packed": "#2f6db3", "pile": "#e08a1e"}
STYLES = ("-", "--", ":", "-.")  # of the models


@dataclass(frozen=True, slots=True)
class Case:
    """One benchmark of an experiment.

    Attributes:
        group: what varies.
        value: its value here, a number or a name.
        scene: kind of the scenes.
        protocol: the constants, with the one that varies.
        planner: fields of the planner that vary.
        objects: folder of the objects; None: the experiment's.
    """

    group: str
    value: float | str
    scene: SceneKind
    protocol: Protocol
    planner: dict[str, Any] = field(default_factory=dict)
    objects: Path | None = None

    @property
    def name(self) -> str:
        """A name for its folder."""
        value = self.value if isinstance(self.value, str) else f"{self.value:g}"
        model = self.planner.get("model", "")
        parts = (self.scene.value, self.group, value, re.sub(r".*/", "", model))
        return re.sub(r"[^\w.]+", "-", "-".join(part for part in parts if part))


# From a protocol, the scenes, the models and the experiment's folder to its cases.
Plan: TypeAlias = Callable[[Protocol, Sequence[SceneKind], Sequence[str], "Path"], list[Case]]


def robustness(
    protocol: Protocol, scenes: Sequence[SceneKind], models: Sequence[str], folder: Path
) -> list[Case]:
    """Success against noise, voxel size, height of the camera, flipped normals, and view."""
    del folder
    cases = []
    for scene in scenes:
        for model in models:
            named = {"model": model}
            for value in NOISE_MILLIMETRES:
                noise = replace(protocol.noise, point_std=value / 1000)
                changed = replace(protocol, name=f"{protocol.name}, noise", noise=noise)
                cases.append(Case("noise (mm)", value, scene, changed, named))
            for value in VOXEL_MILLIMETRES:
                planner = named | {"voxel_size": value / 1000}
                cases.append(Case("voxel size (mm)", value, scene, protocol, planner))
            for value in POLAR_DEGREES:
                camera = replace(protocol.camera, polar_degrees=(value, value))
                changed = replace(protocol, name=f"{protocol.name}, polar angle", camera=camera)
                cases.append(Case("camera's polar angle (degrees)", value, scene, changed, named))
            for value in FLIPPED_PERCENT:
                planner = named | {"flipped_normals": value / 100}
                cases.append(Case("normals flipped (%)", value, scene, protocol, planner))
            cases += [Case("view", v.name, scene, v, named) for v in _views(protocol)]
    return cases


def samples(
    protocol: Protocol, scenes: Sequence[SceneKind], models: Sequence[str], folder: Path
) -> list[Case]:
    """Success against the number of approach points and candidates (the paper's table)."""
    del folder
    return [
        Case(
            "samples",
            name,
            scene,
            protocol,
            {"model": model, "num_approach_points": points, "num_candidates": candidates},
        )
        for scene in scenes
        for model in models
        for name, (points, candidates) in SAMPLES.items()
    ]


def labels(
    protocol: Protocol, scenes: Sequence[SceneKind], models: Sequence[str], folder: Path
) -> list[Case]:
    """Success against the number of training labels, which names the folder of each weights file.

    Raises:
        ValueError: a model is not a file in a folder named by a number.
    """
    del folder
    numbers = {model: PurePath(model).parent.name for model in models}
    for model, number in numbers.items():
        if not number.isdecimal():
            raise ValueError(
                f"model is {model!r}; name files in folders named by their number of labels, "
                "such as runs/3000/edgegrasp-plus.safetensors"
            )
    return [
        Case("labels", float(number), scene, protocol, {"model": model})
        for scene in scenes
        for model, number in numbers.items()
    ]


def families(
    protocol: Protocol, scenes: Sequence[SceneKind], models: Sequence[str], folder: Path
) -> list[Case]:
    """Success on thin, flat and large objects, written into the experiment's folder."""
    whole = replace(protocol.scene, packed_scale=(1.0, 1.0), pile_scale=(1.0, 1.0))
    changed = replace(protocol, name=f"{protocol.name}, families", scene=whole)
    folders = {name: write_family(name, folder / "objects" / name) for name in FAMILIES}
    return [
        Case("family", name, scene, changed, {"model": model}, folders[name])
        for scene in scenes
        for model in models
        for name in FAMILIES
    ]


def baselines(
    protocol: Protocol, scenes: Sequence[SceneKind], models: Sequence[str], folder: Path
) -> list[Case]:
    """Success of random candidates, and of the best choice among them."""
    del models, folder
    numbers = {
        "num_approach_points": protocol.planning.num_approach_points,
        "num_candidates": protocol.planning.num_candidates,
    }
    return [
        Case("planner", name, scene, protocol, {"name": name} | numbers)
        for scene in scenes
        for name in BASELINES
    ]


EXPERIMENTS: dict[str, Plan] = {
    "robustness": robustness,
    "samples": samples,
    "labels": labels,
    "families": families,
    "baselines": baselines,
}


def experiment_table(results: dict[str, Any]) -> str:
    """Markdown tables of an experiment, one for each group; per cent with 95 % intervals.

    Args:
        results: as in `experiment.json`.
    """
    parts = []
    for group in _unique(case["group"] for case in results["cases"]):
        cases = [case for case in results["cases"] if case["group"] == group]
        columns = _unique((c["scene"], planner_title(c["planner"])) for c in cases)
        if group == "planner":  # the rows name the planner
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
                    and model in ("", planner_title(case["planner"]))
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


def percent(rate: dict[str, Any]) -> str:
    """A rate with its 95 % interval, in per cent."""
    if rate["value"] is None:
        return "none"
    low, high = rate["wilson_95"]
    return f"{100 * rate['value']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def value_text(value: float | str) -> str:
    """A case's value as text."""
    return value if isinstance(value, str) else f"{value:g}"


def _views(protocol: Protocol) -> list[Protocol]:
    """A protocol, the same with the camera of `giga`, and `giga` with its noise."""
    giga = load_protocol("giga")
    return [
        protocol,
        replace(protocol, name=f"{protocol.name}, giga's camera", camera=giga.camera),
        giga,
    ]


def _draw(axes: Any, cases: list[dict[str, Any]], name: str) -> None:
    values = _unique(case["value"] for case in cases)
    numbers = all(not isinstance(value, str) for value in values)
    baselines = cases[0]["group"] == "planner"
    lines = _unique((c["scene"], "" if baselines else planner_title(c["planner"])) for c in cases)
    models = _unique(model for _, model in lines)
    for number, (scene, model) in enumerate(lines):
        told = [
            case
            for case in cases
            if case["scene"] == scene
            and model in ("", planner_title(case["planner"]))
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
