"""Processor time from a depth image to an arm's trajectory, and of reach alone, on one core.

usage: OMP_NUM_THREADS=1 python benchmarks/robot.py [ROBOT ...]

The image is the playground's of seven objects, 640 x 480; the arm stands beside the objects, on
the support, half a metre from their middle. Each row is of 20 seeds.
"""

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from edgegrasp_camera.arrays import Float64
from edgegrasp_camera.depth import Intrinsics, metres, unproject
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.options import parse_options
from edgegrasp_results import Detection
from edgegrasp_robot import Robot, load_robot, plan_picks, with_robot

SAMPLE = "service/edgegrasp_service/playground/samples/seven_depth.png"
FOCAL, SEEDS, FAR = 540.0, 20, 0.5  # pixels; seeds; metres from the arm's base to the objects


def beside(detection: Detection) -> Float64:
    """T_base_cloud (4, 4) of a base on the support; its x points at the objects."""
    support = detection.support
    assert support is not None
    up = support.normal.astype(np.float64)
    middle = np.mean([found.center for found in detection.objects], axis=0)
    middle -= (up @ middle - support.offset) * up
    ahead = np.cross(up, [1.0, 0.0, 0.0])  # the image's x lies level
    ahead /= np.linalg.norm(ahead)
    T_cloud_base = np.eye(4)
    T_cloud_base[:3, :3] = np.stack([-ahead, np.cross(up, -ahead), up], axis=1)
    T_cloud_base[:3, 3] = middle + FAR * ahead
    return np.linalg.inv(T_cloud_base)


def measure(detector: GraspDetector, robot: Robot, cloud: Any, fields: dict[str, Any]) -> str:
    """Median and 95th percentile of 20 seeds, milliseconds, and how many had a pick."""
    seconds, arm, picks = [], [], 0
    for seed in range(-1, SEEDS):  # the first warms up
        options = parse_options({"viewpoint": (0.0, 0.0, 0.0), "seed": max(seed, 0)} | fields)
        start = time.process_time()
        prepared = detector.prepare(cloud, with_robot(options, robot))
        detection = detector.finish(prepared, detector.evaluate(prepared))
        detected = time.process_time()
        found = plan_picks(detection, prepared.scene, cloud, options, robot)
        if seed >= 0:
            seconds.append(1000 * (time.process_time() - start))
            arm.append(1000 * (time.process_time() - detected))
            plan = found.grasps[0].arm if found.grasps else None
            wanted = fields["robot"]["plan"] == "reach" or (plan and plan.trajectory)
            picks += bool(plan and plan.reachable and wanted)
    rows = [f"{np.median(each):.0f} / {np.percentile(each, 95):.0f}" for each in (seconds, arm)]
    return f"{rows[0]} | {rows[1]} | {picks} of {SEEDS}"


def main(names: list[str]) -> None:
    """Print a table."""
    torch.set_num_threads(1)
    detector = ModelCatalogue.load().get()
    depth = metres(np.asarray(Image.open(Path(__file__).parents[1] / SAMPLE)))
    cloud = unproject(depth, Intrinsics(FOCAL, FOCAL, 320, 240)).astype(np.float32)
    options = parse_options({"viewpoint": (0.0, 0.0, 0.0)})
    pose = beside(detector.detect(cloud, options)).ravel().tolist()
    print("robot | plan | top_k | image to answer, ms, median / p95 | of it the arm | with a pick")
    for name in names:
        robot = load_robot(name)
        asked = {"name": name, "T_base_cloud": pose, "joints": robot.home.tolist()}
        for plan, top_k in (("motion", 1), ("reach", 50)):
            row = measure(detector, robot, cloud, {"robot": asked | {"plan": plan}, "top_k": top_k})
            print(f"{name} | {plan} | {top_k} | {row}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or ["fr3", "ur5"])
