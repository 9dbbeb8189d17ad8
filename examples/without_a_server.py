"""Grasps of an array in this process: the pipeline as a library, no server.

usage: python examples/without_a_server.py

Needs the extra `service`. The cloud is a made-up box of 5 x 8 x 6 cm on a table at z = 0.
"""

import numpy as np

from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.options import DetectOptions, SupportPlane


def box_cloud(rng: np.random.Generator) -> np.ndarray:
    """Points on the surface of the box, except its bottom.  # (6000, 3) float32 metres."""
    size = np.array([0.05, 0.08, 0.06])
    points = rng.uniform(0.0, size, (6000, 3))
    face = rng.integers(5, size=len(points))
    axis, far = face % 3, face // 3 == 0
    rows = np.arange(len(points))
    points[rows, axis] = np.where(far, size[axis], 0.0)
    return points.astype(np.float32)


def main() -> None:
    """Print the five best grasps of the box."""
    detector = ModelCatalogue.load().get("")
    options = DetectOptions(
        viewpoint=(0.3, 0.4, 0.5),
        support=SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.0),
        top_k=5,
    )
    detection = detector.detect(box_cloud(np.random.default_rng(0)), options)
    for grasp in detection.grasps:
        print(f"score {grasp.score:.3f}, approach {np.round(grasp.approach_direction, 2)}")
    print("counts:", detection.counts)


if __name__ == "__main__":
    main()
