"""Measure speed beside the textbook: `python -m benchmarks.speed` writes speed.json.

Most times are processor seconds on one thread, medians of interleaved runs: they hold on a busy
machine too. Networks carry random weights, which cost what trained ones cost.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.readme import write_table
from benchmarks.scenes import detector, observe, request
from benchmarks.served import served
from benchmarks.textbook.edge_grasp import edge_grasp_logits
from benchmarks.textbook.pipeline import detect
from benchmarks.textbook.vn_edge_grasp import vn_edge_grasp_logits
from benchmarks.timing import interleaved, machine, summary
from edgegrasp_model.int8_network import INT8, quantise

from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.config import EDGEGRASP, EDGEGRASP_SMALL, VN_EDGEGRASP, NetworkConfig
from edgegrasp_model.networks.edgegrasp import EdgeGraspNet
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.observation import Observation
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_training.recipes import recipe

RESULTS = Path(__file__).parent / "results"
TEXTBOOK: dict[str, Callable[..., torch.Tensor]] = {
    "edgegrasp": edge_grasp_logits,
    "vn-edgegrasp": vn_edge_grasp_logits,
}
PAPER = {"EdgeGraspNet": EDGEGRASP, "VN-EdgeGraspNet": VN_EDGEGRASP}
SHIPPED = ("edgegrasp-plus", "edgegrasp-small")
LABELLED_GRASPS = 60


def main() -> None:
    """Measure everything, write the results and the README's table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--readme", type=Path, help="file whose table to rewrite")
    given = parser.parse_args()
    torch.set_num_threads(1)
    start = time.perf_counter()
    observation = observe()
    results: dict[str, Any] = {"machine": machine(), "cloud_points": len(observation.cloud)}
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "shipped": shipped,
        "paper": lambda: {
            name: beside_textbook(config, observation) for name, config in PAPER.items()
        },
        "simulator": lambda: {str(kind): simulator(kind) for kind in SceneKind},
        "server": server_footprint,
    }
    for name, part in parts.items():
        results[name] = part()
        print(name, results[name], flush=True)
    results["minutes"] = (time.perf_counter() - start) / 60
    given.output.mkdir(parents=True, exist_ok=True)
    (given.output / "speed.json").write_text(json.dumps(results, indent=1) + "\n")
    if given.readme is not None:
        write_table(given.readme, results)


def beside_textbook(config: NetworkConfig, observation: Observation) -> dict[str, Any]:
    """One of the paper's networks, alone and end to end, beside the textbook's way."""
    ours, options = detector(config), request(observation)
    textbook, network = TEXTBOOK[config.architecture], ours.network
    batch = ours.prepare(observation.cloud, options).batch
    assert batch is not None
    variants = {"ours": ours}
    if isinstance(network, EdgeGraspNet):
        assert isinstance(batch, BallBatch)
        said = replace(ours.metadata, network=replace(config, architecture=INT8))
        variants["int8"] = GraspDetector(quantise(network, [batch]), said, ours.gripper)
    with torch.inference_mode():
        alone = interleaved(
            {name: partial(variant.network, batch) for name, variant in variants.items()}
            | {"textbook": lambda: textbook(network, batch)}
        )
    whole = interleaved(
        {
            name: partial(variant.detect, observation.cloud, options)
            for name, variant in variants.items()
        }
        | {
            "textbook": lambda: detect(
                observation.cloud, observation.table_height, lambda b: textbook(network, b)
            ),
        }
    )
    return {
        "ball_points": len(batch.points),
        "candidates": len(batch.contact),
        "variants": {
            name: {
                "network": summary(alone, name, "textbook"),
                "end_to_end": summary(whole, name, "textbook"),
            }
            for name in variants
        },
    }


def shipped() -> dict[str, Any]:
    """The networks for processors in the whole pipeline, a view of each kind of scene.

    Processor seconds on one thread, and seconds of the clock on two.
    """
    scenes = {str(kind): observe(kind, views=1) for kind in SceneKind}
    detectors = {name: detector(recipe(name).network) for name in SHIPPED}
    runs = {
        (name, scene): partial(ours.detect, seen.cloud, request(seen))
        for name, ours in detectors.items()
        for scene, seen in scenes.items()
    }
    results: dict[str, Any] = {name: {} for name in SHIPPED}
    for threads, clock in ((1, time.process_time), (2, time.perf_counter)):
        torch.set_num_threads(threads)
        times = interleaved({"/".join(key): run for key, run in runs.items()}, clock=clock)
        for name, scene in runs:
            seen = results[name].setdefault(scene, {"points": len(scenes[scene].cloud)})
            seen[f"seconds_{threads}"] = statistics.median(times[f"{name}/{scene}"])
            seen[f"stages_{threads}"] = runs[name, scene]().seconds
    torch.set_num_threads(1)
    return results


def server_footprint() -> dict[str, float]:
    """Seconds of the clock until the server answers, and its memory before and after requests."""
    from edgegrasp_client import GraspClient

    start = time.perf_counter()
    with served() as server:
        ready = time.perf_counter() - start
        at_rest = server.memory()
        cloud = observe().cloud
        with GraspClient(server.grpc_address) as client:
            for seed in range(10):
                client.detect(cloud, seed=seed, num_approach_points=32, num_candidates=2000)
        return {"ready_seconds": ready, "rest_mb": at_rest, "peak_mb": server.peak_memory()}


def simulator(kind: SceneKind) -> dict[str, float]:
    """Labels a second and scenes a minute, and how often stopping early changes an outcome."""
    scene_seconds, early, whole, agreed = [], 0.0, 0.0, 0
    tried = 0
    with ClutterSimulation() as simulation:
        for seed in range(4):
            start = time.process_time()
            simulation.reset(kind, np.random.default_rng(seed))
            scene_seconds.append(time.process_time() - start)
            poses = _tried_poses(simulation, seed)
            for pose in poses:
                start = time.process_time()
                quick = simulation.try_grasp(pose).success
                middle = time.process_time()
                slow = simulation.try_grasp(pose, to_the_end=True).success
                early += middle - start
                whole += time.process_time() - middle
                agreed += quick == slow
            tried += len(poses)
    return {
        "labels_per_second": tried / early,
        "labels_per_second_to_the_end": tried / whole,
        "agreement": agreed / tried,
        "grasps": tried,
        "scene_seconds": statistics.median(scene_seconds),
    }


def _tried_poses(simulation: ClutterSimulation, seed: int) -> np.ndarray:
    streams = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
    observation = simulation.observe(*streams)
    options = request(observation, num_candidates=LABELLED_GRASPS)
    prepared = detector(EDGEGRASP_SMALL).prepare(observation.cloud, options)
    assert prepared.sample is not None
    assert prepared.scene is not None
    return prepared.scene.frame.poses_in_cloud(prepared.sample.candidates.T_cloud_hand)


if __name__ == "__main__":
    main()
