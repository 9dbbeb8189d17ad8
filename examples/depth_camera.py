"""Images of a simulated depth camera: depth.png (16 bits, millimetres) and color.png of a table.

usage: python examples/depth_camera.py FOLDER [--sensor stereo] [--seed 0]
       edgegrasp detect --depth FOLDER/depth.png --intrinsics 540,540,320,239 --picture grasps.png
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from edgegrasp_sim.camera import CAMERA, look_at
from edgegrasp_sim.sensor import SENSORS
from edgegrasp_sim.simulation import ClutterSimulation

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path)
parser.add_argument("--sensor", choices=list(SENSORS), default="structured-light")
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()
scene, noise = (np.random.default_rng([arguments.seed, stream]) for stream in range(2))
T_world_camera = look_at(np.array([0.15, -0.30, 0.52]), np.array([0.15, 0.14, 0.06]))
with ClutterSimulation() as simulation:
    simulation.reset("table", scene, num_objects=7)
    depth = simulation.world.render_depth(T_world_camera, CAMERA)
    colors = simulation.color_image(T_world_camera)
seen = SENSORS[arguments.sensor].apply(depth, CAMERA, noise)
millimetres = np.nan_to_num(1000 * seen).round().astype(np.uint16)  # 0: no reading
arguments.folder.mkdir(parents=True, exist_ok=True)
Image.fromarray(millimetres).save(arguments.folder / "depth.png", optimize=True)
Image.fromarray(colors).save(arguments.folder / "color.png", optimize=True)
