"""Measure speed beside the textbook: `python -m benchmarks.speed` writes speed.json.

All times are processor seconds on one thread, medians of interleaved runs: they hold on a busy
machine too. Networks carry random weights, which cost what trained ones cost.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.curves import draw, measure_curves
from benchmarks.readme import write_table
from benchmarks.served import served
from benchmarks.textbook.edge_grasp import edge_grasp_logits
from benchmarks.textbook.pipeline import detect
from benchmarks.textbook.vn_edge_grasp import vn_edge_grasp_logits
from benchmarks.timing import interleaved, machine, summary

from edgegrasp_model.checkpoint import CheckpointMetadata
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.network import build_network
from edgegrasp_model.network_config import (
    EDGEGRASP,
    EDGEGRASP_SMALL,
    VN_EDGEGRASP,
    NetworkConfig,
)
from edgegrasp_model.options import DetectOptions
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.simulation import ClutterSimulation, Observation

RESULTS = Path(__file__).parent / "results"
TEXTBOOK: dict[str, Callable[..., torch.Tensor]] = {
    "edgegrasp": edge_grasp_logits,
    "vn-edgegrasp": vn_edge_grasp_logits,
}
PAPER = {"EdgeGraspNet": EDGEGRASP, "VN-EdgeGraspNet": VN_EDGEGRASP}
LABELLED_GRASPS = 60


def main() -> None:
    """Measure everything, write the results and the README's table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--without-curves", action="store_true")
    parser.add_argument("--readme", type=Path, help="file whose table to rewrite")
    given = parser.parse_args()
    torch.set_num_threads(1)
    observation = observe()
    results: dict[str, Any] = {"machine": machine(), "cloud_points": len(observation.cloud)}
    results["simulator"] = {str(kind): simulator(kind) for kind in SceneKind}
    print("simulator", results["simulator"], flush=True)
    results["server"] = server_footprint()
    print("server", results["server"], flush=True)
    results["small"] = small_beside_full(observation)
    print("small", results["small"], flush=True)
    results["paper"] = {}
    for name, config in PAPER.items():
        results["paper"][name] = beside_textbook(config, observation)
        print(name, results["paper"][name], flush=True)
    given.output.mkdir(parents=True, exist_ok=True)
    path = given.output / "speed.json"
    path.write_text(json.dumps(results, indent=1) + "\n")
    if given.readme is not None:
        write_table(given.readme, results)
    if not given.without_curves:
        results["curves"] = measure_curves(detector(EDGEGRASP_SMALL), observation)
        draw(results["curves"], given.output / "scaling.png")
        path.write_text(json.dumps(results, indent=1) + "\n")


def observe() -> Observation:
    """A pile seen from two sides: some 15,000 points."""
    with ClutterSimulation() as simulation:
        simulation.reset(SceneKind.PILE, np.random.default_rng(1))
        streams = np.random.default_rng(1), np.random.default_rng(2)
        return simulation.observe(*streams, num_views=2)


def detector(config: NetworkConfig) -> GraspDetector:
    """A detector with random weights."""
    metadata = CheckpointMetadata("random", config, 0.0045, "panda")
    return GraspDetector(build_network(config), metadata, load_gripper())


def request(observation: Observation) -> DetectOptions:
    """32 approach points, 2,000 candidates, the table known."""
    return DetectOptions(
        num_approach_points=32,
        num_candidates=2000,
        viewpoint=tuple(observation.camera_position.tolist()),
        support={"normal": (0.0, 0.0, 1.0), "offset": observation.table_height},
    )


def beside_textbook(config: NetworkConfig, observation: Observation) -> dict[str, Any]:
    """One of the paper's networks, alone and end to end, beside the textbook's way."""
    ours, options = detector(config), request(observation)
    textbook, network = TEXTBOOK[config.architecture], ours.network
    batch = ours.prepare(observation.cloud, options).batch
    assert batch is not None
    with torch.inference_mode():
        alone = interleaved(
            {"ours": lambda: network(batch), "textbook": lambda: textbook(network, batch)}
        )
    whole = interleaved(
        {
            "ours": lambda: ours.detect(observation.cloud, options),
            "textbook": lambda: detect(
                observation.cloud, observation.table_height, lambda b: textbook(network, b)
            ),
        }
    )
    return {
        "ball_points": len(batch.points),
        "candidates": len(batch.contact),
        "network": summary(alone, "ours", "textbook"),
        "end_to_end": summary(whole, "ours", "textbook"),
    }


def small_beside_full(observation: Observation) -> dict[str, Any]:
    """The small network beside the paper's, in the same pipeline."""
    small, full, options = detector(EDGEGRASP_SMALL), detector(EDGEGRASP), request(observation)
    batch = full.prepare(observation.cloud, options).batch
    assert batch is not None
    with torch.inference_mode():
        alone = interleaved(
            {"small": lambda: small.network(batch), "full": lambda: full.network(batch)}
        )
    whole = interleaved(
        {
            "small": lambda: small.detect(observation.cloud, options),
            "full": lambda: full.detect(observation.cloud, options),
        }
    )
    return {
        "network": summary(alone, "small", "full"),
        "end_to_end": summary(whole, "small", "full"),
    }


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
    options = request(observation).model_copy(update={"num_candidates": LABELLED_GRASPS})
    with_any = replace(detector(EDGEGRASP_SMALL).metadata, name="any")
    prepared = GraspDetector(build_network(EDGEGRASP_SMALL), with_any, load_gripper()).prepare(
        observation.cloud, options
    )
    assert prepared.sample is not None
    assert prepared.scene is not None
    return prepared.scene.frame.poses_in_cloud(prepared.sample.candidates.T_cloud_hand)


if __name__ == "__main__":
    main()
