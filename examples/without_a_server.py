"""Grasps in an array of points: the pipeline as a library, without a server.

usage: python examples/without_a_server.py

Needs the extra `service`. The array contains the points of the playground's sample, camera frame.
In several processes, use `spawn`: PyTorch hangs in a child that is forked after a detection.
"""

from pathlib import Path

import numpy as np

from edgegrasp_camera.depth import Intrinsics, metres, unproject
from edgegrasp_camera.files import pixels
from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.options import DetectOptions

SAMPLE = Path(__file__).with_name("sample") / "depth.png"
CAMERA = Intrinsics(fx=540.0, fy=540.0, cx=320.0, cy=239.0)  # pixels

points = unproject(metres(pixels(SAMPLE)), CAMERA)  # (480, 640, 3) metres, NaN for holes
options = DetectOptions(viewpoint=(0.0, 0.0, 0.0), top_k=5)
detection = ModelCatalogue.load().get("").detect(points, options)
for grasp in detection.grasps:
    print(f"score {grasp.score:.3f}, approach {np.round(grasp.approach_direction, 2)}")
print("counts:", detection.counts)
