"""Processor time from a depth image to an arm's trajectory, or to reach only, on one core.

usage: OMP_NUM_THREADS=1 python benchmarks/robot.py [ROBOT ...]

The image is the playground's image of seven objects, 640 x 480; the arm stands next to the objects,
on the support, half a metre from their middle. Each row has 20 seeds.
"""

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from edgegrasp_camera.depth import Intrinsics, metres, unproject
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.options import parse_options
from edgegrasp_robot import Robot, load_robot, options_for_robot, plan_picks

SAMPLE = "service/edgegrasp_service/playground/samples/seven_depth.png"
FOCAL, SEEDS = 540.0, 20  # pixels; seeds
# (4, 4) row by row; the base's x points at the objects, its z is the support's normal.
T_BASE_CLOUD = (
    *(0.0, 0.53633, -0.84401, 1.1002),
    *(1.0, 0.0, 0.0, 0.0344),
    *(0.0, -0.84401, -0.53633, 0.5889),
    *(0.0, 0.0, 0.0, 1.0),
)


def measure(detector: GraspDetector, robot: Robot, cloud: Any, fields: dict[str, Any]) -> str:
    """Median and 95th percentile of 20 seeds, milliseconds, and how many had a pick."""
    seconds, arm, picks = [], [], 0
    for seed in range(-1, SEEDS):  # the first warms up
        options = parse_options({"viewpoint": (0.0, 0.0, 0.0), "seed": max(seed, 0)} | fields)
        start = time.process_time()
        prepared = detector.prepare(cloud, options_for_robot(options, robot))
        detection = detector.finish(prepared, detector.evaluate(prepared))
        detected = time.process_time()
        found = plan_picks(detection, prepared.scene, options, robot)
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
    cloud = unproject(depth, Intrinsics(FOCAL, FOCAL, 320, 240))
    print("robot | plan | top_k | image to answer, ms, median / p95 | of it the arm | with a pick")
    for name in names:
        robot = load_robot(name)
        asked = {"name": name, "T_base_cloud": T_BASE_CLOUD, "joints": robot.home.tolist()}
        for plan, top_k in (("motion", 1), ("reach", 50)):
            row = measure(detector, robot, cloud, {"robot": asked | {"plan": plan}, "top_k": top_k})
            print(f"{name} | {plan} | {top_k} | {row}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or ["fr3", "ur5"])
