"""Experiments: many benchmarks that differ in one thing each, and what comes of them together."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, TypeAlias

from edgegrasp_sim.families import FAMILIES, write_family
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import Protocol, load_protocol

if TYPE_CHECKING:
    from pathlib import Path

NOISE_MILLIMETRES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
VOXEL_MILLIMETRES = (3.0, 4.0, 5.0, 6.0, 8.0)
POLAR_DEGREES = (15.0, 30.0, 45.0, 60.0, 75.0)
FLIPPED_PERCENT = (0.0, 5.0, 10.0, 25.0, 50.0)
# Approach points and candidates, named as in the paper's table.
SAMPLES = {"16-1k": (16, 1000), "32-2k": (32, 2000), "64-4k": (64, 4000)}
BASELINES = ("edge-sample", "oracle", "oracle-own")


@dataclass(frozen=True, slots=True)
class Case:
    """One benchmark of an experiment.

    Attributes:
        group: what is varied.
        value: to what; a number, or a name.
        scene: kind of the scenes.
        protocol: the constants, the changed one among them.
        planner: fields of the planner that are changed.
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


def _views(protocol: Protocol) -> list[Protocol]:
    """A protocol, the same with the camera of `giga`, and `giga` with its noise."""
    giga = load_protocol("giga")
    return [
        protocol,
        replace(protocol, name=f"{protocol.name}, giga's camera", camera=giga.camera),
        giga,
    ]


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
    """Success against the labels that weights learned from: what the folder of each file says.

    Raises:
        ValueError: a model is no file in a folder that is named by a number.
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
    """Success on thin, flat and large objects, which are written into the experiment's folder."""
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
    """What random candidates are worth, and the best that could be made of them."""
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
