"""Measure a GPU on the paper's axes: `python -m benchmarks.gpu --device cuda` writes gpu.json.

Ours and the textbook implementation take turns on the same device. The paper's networks carry
random weights, which cost what trained ones cost; the weights that ship are measured beside them.
Beside the JSON stands gpu.md, the same as tables.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.textbook.edge_grasp import edge_grasp_logits
from benchmarks.textbook.vn_edge_grasp import vn_edge_grasp_logits
from benchmarks.timing import machine

from edgegrasp_model.catalogue import ModelCatalogue
from edgegrasp_model.checkpoint import CheckpointMetadata
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.network import build_network
from edgegrasp_model.network_config import EDGEGRASP, VN_EDGEGRASP, NetworkConfig
from edgegrasp_model.on_device.choice import choose_device
from edgegrasp_model.on_device.detector import DeviceDetector
from edgegrasp_model.on_device.precision import Precision
from edgegrasp_model.on_device.scoring import ScoringNetwork
from edgegrasp_model.options import DetectOptions

RESULTS = Path(__file__).parent / "results"
TEXTBOOK: dict[str, Callable[..., torch.Tensor]] = {
    "edgegrasp": edge_grasp_logits,
    "vn-edgegrasp": vn_edge_grasp_logits,
}
# Milliseconds on an RTX 3090, as the paper prints them: network, approach points, candidates.
PAPER = {
    ("EdgeGraspNet", 16, 2000): 9.6,
    ("EdgeGraspNet", 32, 500): 15.8,
    ("EdgeGraspNet", 32, 1000): 15.7,
    ("EdgeGraspNet", 32, 2000): 15.8,
    ("EdgeGraspNet", 64, 2000): 27.4,
    ("EdgeGraspNet", 64, 4000): 28.0,
    ("VN-EdgeGraspNet", 32, 2000): None,
    ("VN-EdgeGraspNet", 64, 4000): 89.0,
}
HALVES: tuple[Precision, ...] = ("float16", "bfloat16")
USUAL = (32, 2000)  # approach points, candidates
ENOUGH = 0.999  # correlation of scores from which half precision may be used
WARM_UP = 3  # turns that do not count
TINY = {"conv_widths": (8, 8, 8), "global_widths_1": (8, 8, 8), "global_widths_2": (8, 8)}


@dataclass(frozen=True)
class Plan:
    """What to measure."""

    networks: Mapping[str, NetworkConfig]  # with random weights
    shipped: bool  # whether the weights that ship are measured too, at the paper's usual size
    sizes: Sequence[tuple[str, int, int]]  # network, approach points, candidates
    at_once: Sequence[int]  # scenes in one forward pass
    seeds: int  # requests whose scores are compared
    runs: int


FULL = Plan(
    {"EdgeGraspNet": EDGEGRASP, "VN-EdgeGraspNet": VN_EDGEGRASP},
    True,
    tuple(PAPER),
    at_once=(1, 4, 16),
    seeds=5,
    runs=20,
)
QUICK = Plan(
    {
        "EdgeGraspNet": NetworkConfig("edgegrasp", classifier_widths=(8,), **TINY),
        "VN-EdgeGraspNet": NetworkConfig("vn-edgegrasp", classifier_widths=(8,), **TINY),
        "HandNet": NetworkConfig("hand", hand_widths=(8,), classifier_widths=(8,), hand_points=8),
    },
    False,
    [("EdgeGraspNet", 4, 60), ("VN-EdgeGraspNet", 4, 60), ("HandNet", 4, 60)],
    at_once=(1, 2),
    seeds=2,
    runs=2,
)


@dataclass(frozen=True)
class View:
    """A cloud (N, 3) and the camera that saw it, (3,), metres; the table is z = table."""

    cloud: np.ndarray
    camera: np.ndarray
    table: float


def main(words: Sequence[str] | None = None) -> None:
    """Measure everything, write the results and their tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument(
        "--cloud", type=Path, help=".npz with cloud, camera, table; else the simulator makes one"
    )
    parser.add_argument("--save-cloud", type=Path, help="keep the simulator's cloud for elsewhere")
    parser.add_argument("--quick", action="store_true", help="tiny networks, to try this out")
    given = parser.parse_args(words)
    device, plan = choose_device(given.device), QUICK if given.quick else FULL
    view = _loaded(given.cloud) if given.cloud else _simulated()
    if given.save_cloud:
        np.savez(given.save_cloud, cloud=view.cloud, camera=view.camera, table=view.table)
    results = measure(plan, view, device)
    given.output.mkdir(parents=True, exist_ok=True)
    (given.output / "gpu.json").write_text(json.dumps(results, indent=1) + "\n")
    (given.output / "gpu.md").write_text(tables(results))
    print(tables(results))


def measure(plan: Plan, view: View, device: torch.device) -> dict[str, Any]:
    """Everything in the plan."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "the processor"
    detectors = {name: detector(config, device) for name, config in plan.networks.items()}
    shipped = shipped_detectors(device) if plan.shipped else {}
    detectors |= shipped
    sizes = [*plan.sizes, *((name, *USUAL) for name in shipped)]
    usual = [usual_size(name, sizes) for name in detectors]
    return {
        "machine": machine() | {"device": name, "cuda": torch.version.cuda},
        "cloud_points": len(view.cloud),
        "sizes": [size(detectors, view, *each, plan.runs) for each in sizes],
        "throughput": [
            throughput(detectors, view, each, count, plan.runs)
            for each in usual
            for count in plan.at_once
        ],
        "precision": [
            precision(detectors, view, each, half, plan) for each in usual for half in HALVES
        ],
    }


def detector(config: NetworkConfig, device: torch.device) -> DeviceDetector:
    """A detector with random weights."""
    metadata = CheckpointMetadata("random", config, 0.0045, "panda")
    return DeviceDetector(build_network(config), metadata, load_gripper(), device)


def shipped_detectors(device: torch.device) -> dict[str, DeviceDetector]:
    """The weights that ship, but those whose layers are for processors only."""
    loaded = ModelCatalogue.load()
    every = {name: loaded.get(name) for name in loaded.names()}
    return {
        name: DeviceDetector(one.network, one.metadata, one.gripper, device)
        for name, one in every.items()
        if "int8" not in one.metadata.network.architecture
    }


def usual_size(name: str, sizes: Sequence[tuple[str, int, int]]) -> tuple[str, int, int]:
    """Of the sizes of a network the one that is nearest to the paper's usual one."""
    own = [each for each in sizes if each[0] == name]
    return min(own, key=lambda each: (abs(each[1] - USUAL[0]), abs(each[2] - USUAL[1])))


def size(
    detectors: Mapping[str, DeviceDetector],
    view: View,
    name: str,
    approach_points: int,
    candidates: int,
    runs: int,
) -> dict[str, Any]:
    """A network, alone and from the cloud to ranked grasps, beside the textbook's way."""
    ours, options = detectors[name], request(view, approach_points, candidates)
    batch = ours.prepare(view.cloud, options).batch
    assert batch is not None
    scoring = ScoringNetwork(ours.network)
    textbook = TEXTBOOK.get(ours.metadata.network.architecture)
    alone: dict[str, Callable[[], object]] = {"ours": lambda: scoring(batch)}
    whole: dict[str, Callable[[], object]] = {"ours": lambda: ours.detect(view.cloud, options)}
    if textbook is not None:
        alone["textbook"] = lambda: textbook(ours.network, batch)
        if (detect := _textbook_pipeline()) is not None:
            whole["textbook"] = lambda: detect(
                view.cloud,
                view.table,
                lambda given: textbook(ours.network, given.to(ours.device)).cpu(),
                approach_points,
                candidates,
            )
    with torch.inference_mode():
        network_ms = milliseconds(alone, ours.device, runs)
        peak_mb = peak_megabytes(alone["ours"], ours.device)
    return {
        "network": name,
        "approach_points": approach_points,
        "candidates": candidates,
        "scored": len(batch.contact),
        "ball_points": len(batch.points) if textbook is not None else None,
        "network_ms": network_ms,
        "end_to_end_ms": milliseconds(whole, ours.device, runs),
        "paper_ms": PAPER.get((name, approach_points, candidates)),
        "network_peak_mb": peak_mb,
        "end_to_end_peak_mb": peak_megabytes(whole["ours"], ours.device),
    }


def throughput(
    detectors: Mapping[str, DeviceDetector],
    view: View,
    each: tuple[str, int, int],
    count: int,
    runs: int,
) -> dict[str, Any]:
    """Scenes per second where several share a forward pass."""
    name, approach_points, candidates = each
    ours = detectors[name]
    asked = [request(view, approach_points, candidates, seed) for seed in range(count)]
    batches = [ours.prepare(view.cloud, options).batch for options in asked]
    together = type(batches[0]).concatenate(batches)

    def whole() -> None:
        prepared = [ours.prepare(view.cloud, options) for options in asked]
        logits = ours.run(type(batches[0]).concatenate([one.batch for one in prepared]))
        ends = np.cumsum([len(one.batch.contact) for one in prepared])
        for one, part in zip(prepared, np.split(logits, ends[:-1]), strict=True):
            ours.finish(one, part)

    work = {"network": lambda: ours.run(together), "whole": whole}
    took = milliseconds(work, ours.device, runs)
    return {
        "network": name,
        "scenes_at_once": count,
        "network_scenes_per_second": 1000 * count / took["network"],
        "scenes_per_second": 1000 * count / took["whole"],
    }


def precision(
    detectors: Mapping[str, DeviceDetector],
    view: View,
    each: tuple[str, int, int],
    half: Precision,
    plan: Plan,
) -> dict[str, Any]:
    """How well scores in half precision follow those in single precision, and the time of both."""
    name, approach_points, candidates = each
    ours = detectors[name]
    single, halved = ScoringNetwork(ours.network), ScoringNetwork(ours.network, half)
    correlations = []
    for seed in range(plan.seeds):
        batch = ours.prepare(view.cloud, request(view, approach_points, candidates, seed)).batch
        assert batch is not None
        scores = torch.stack((single(batch), halved(batch))).double().sigmoid()
        correlations.append(float(torch.corrcoef(scores)[0, 1]))
    runs = {"float32": lambda: single(batch), half: lambda: halved(batch)}
    return {
        "network": name,
        "precision": half,
        "least_correlation": min(correlations),
        "enough": min(correlations) >= ENOUGH,
        "network_ms": milliseconds(runs, ours.device, plan.runs),
    }


def request(view: View, approach_points: int, candidates: int, seed: int = 0) -> DetectOptions:
    """The table known; hands that collide are scored too, so that there are enough candidates."""
    return DetectOptions(
        num_approach_points=approach_points,
        num_candidates=candidates,
        viewpoint=tuple(view.camera.tolist()),
        support={"normal": (0.0, 0.0, 1.0), "offset": view.table},
        collision="penalise",
        seed=seed,
    )


def milliseconds(
    variants: Mapping[str, Callable[[], object]], device: torch.device, runs: int
) -> dict[str, float]:
    """Medians of variants that take turns, until the device has done all it was told."""
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for number in range(WARM_UP + runs):
        for name, variant in variants.items():
            _wait(device)
            start = time.perf_counter()
            variant()
            _wait(device)
            if number >= WARM_UP:
                seconds[name].append(time.perf_counter() - start)
    return {name: 1000 * statistics.median(times) for name, times in seconds.items()}


def peak_megabytes(work: Callable[[], object], device: torch.device) -> float | None:
    """Memory of the device that was taken at most; None where it is the processor."""
    if device.type != "cuda":
        return None
    torch.cuda.reset_peak_memory_stats(device)
    work()
    _wait(device)
    return torch.cuda.max_memory_allocated(device) / 2**20


def tables(results: Mapping[str, Any]) -> str:
    """The results as Markdown."""
    where = results["machine"]
    lines = [
        f"{where['device']}, PyTorch {where['torch']}, CUDA {where['cuda']}; a cloud of "
        f"{results['cloud_points']:,} points; medians, in milliseconds.",
        "",
        "| | paper, 3090 | network | textbook | end to end | textbook | peak memory |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in results["sizes"]:
        alone, whole = row["network_ms"], row["end_to_end_ms"]
        peak = row["end_to_end_peak_mb"]
        cells = (
            f"{row['network']} {row['approach_points']}-{row['candidates']}",
            _number(row["paper_ms"]),
            _number(alone["ours"]),
            _number(alone.get("textbook")),
            _number(whole["ours"]),
            _number(whole.get("textbook")),
            "" if peak is None else f"{peak:,.0f} MB",
        )
        lines.append(f"| {' | '.join(cells)} |")
    lines += ["", "| scenes per second | at once | network | end to end |", "| --- " * 4 + "|"]
    for row in results["throughput"]:
        rates = f"{row['network_scenes_per_second']:.0f} | {row['scenes_per_second']:.0f}"
        lines.append(f"| {row['network']} | {row['scenes_at_once']} | {rates} |")
    lines += ["", "| half precision | type | correlation | ms | float32, ms |", "| --- " * 5 + "|"]
    for row in results["precision"]:
        times = row["network_ms"]
        half = _number(times[row["precision"]])
        lines.append(
            f"| {row['network']} | {row['precision']} | {row['least_correlation']:.5f} | "
            f"{half} | {_number(times['float32'])} |"
        )
    return "\n".join(lines) + "\n"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _textbook_pipeline() -> Callable[..., object] | None:
    """The textbook's way from a cloud to grasps, where its libraries are installed."""
    try:
        from benchmarks.textbook.pipeline import detect
    except ImportError:
        return None
    return detect


def _loaded(path: Path) -> View:
    kept = np.load(path, allow_pickle=False)
    return View(kept["cloud"], kept["camera"], float(kept["table"]))


def _simulated() -> View:
    """A pile seen from two sides: some 15,000 points."""
    from edgegrasp_sim.objects import SceneKind  # the simulator need not be where the GPU is
    from edgegrasp_sim.simulation import ClutterSimulation

    with ClutterSimulation() as simulation:
        simulation.reset(SceneKind.PILE, np.random.default_rng(1))
        streams = np.random.default_rng(1), np.random.default_rng(2)
        seen = simulation.observe(*streams, num_views=2)
    return View(seen.cloud, seen.camera_position, seen.table_height)


if __name__ == "__main__":
    main()
