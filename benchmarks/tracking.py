"""How still a followed grasp stays: repeated images of recorded scenes, each with new noise.

usage: python benchmarks/tracking.py --scenes FOLDER [--images 60] [--plot docs/tracking.svg]

The noise is that of a depth camera, beside what the recording has. Times are the processor's.
"""

import argparse
import time
from pathlib import Path

import matplotlib.pyplot as pyplot
import numpy as np
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Floats
from edgegrasp_camera.clouds import CloudInput
from edgegrasp_cli.real_scenes import RealScene, load_scenes
from edgegrasp_client import GraspTracker
from edgegrasp_client.requests import plain_options
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.options import parse_options

NOISE = 0.0003, 0.0015  # metres, and for each square metre of depth
MISSING = 0.005  # share of the pixels


def image(scene: RealScene, number: int) -> Floats:
    """The points (R, 3) of a scene with the noise of an image, where they are seen."""
    rng, points = np.random.default_rng([7, number]), scene.points
    depth = points[:, 2]
    apart = (NOISE[0] + NOISE[1] * depth**2) * rng.standard_normal(len(depth)) / depth
    noisy = (points * (1.0 + apart[:, None])).astype(np.float32)
    return noisy[np.isfinite(noisy[:, 0]) & (rng.random(len(depth)) > MISSING)]


def follow(scene: RealScene, detector: GraspDetector, images: int) -> tuple[Floats, Floats, int]:
    """Millimetres and degrees (N, 2) from the first answer, seconds (N,), and switches."""
    tracker = GraspTracker(viewpoint=(0.0, 0.0, 0.0), top_k=10)
    poses, ids, seconds = [], [], []
    for number in range(images):
        options = parse_options(plain_options(tracker.options()))
        cloud = CloudInput(image(scene, number))
        start = time.process_time()
        found = detector.detect(cloud, options)
        seconds.append(time.process_time() - start)
        tracker.take(found)  # type: ignore[arg-type]  # as the client's, with the same fields
        if found.grasps:
            poses.append(found.grasps[0].T_cloud_tcp)
            ids.append(found.grasps[0].id)
    away = np.array(poses)
    turn = Rotation.from_matrix(away[0, :3, :3].T @ away[:, :3, :3]).magnitude()
    shift = np.linalg.norm(away[:, :3, 3] - away[0, :3, 3], axis=1)
    switches = int(np.count_nonzero(np.diff(ids)))
    return np.stack([1000 * shift, np.degrees(turn)], axis=1), np.array(seconds), switches


def plot(path: Path, drawn: dict[str, Floats]) -> None:
    """Millimetres over images, a line for each scene."""
    figure, axes = pyplot.subplots(figsize=(7, 2.8), layout="constrained")
    for name, apart in drawn.items():
        axes.plot(apart[:, 0], label=name, linewidth=1)
    axes.set(xlabel="images", ylabel="mm from the first answer", ylim=(0, 3))
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(path)


def main() -> None:
    """Print a row for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", type=Path, action="append", required=True)
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    detector, drawn = ModelCatalogue.load().get(""), {}
    print(
        "scene  switches  mm and degrees off the first (95 %)  ms first, following (median, 95 %)"
    )
    for scene in load_scenes(given.scenes):
        apart, seconds, switches = follow(scene, detector, given.images)
        drawn[scene.name] = apart
        far, ms = np.percentile(apart, 95, axis=0), 1000 * seconds
        print(
            f"{scene.name}  {switches}  {far[0]:.1f} mm {far[1]:.1f}°  "
            f"{ms[0]:.0f}, {np.median(ms[1:]):.0f} {np.percentile(ms[1:], 95):.0f}",
            flush=True,
        )
    if given.plot is not None:
        plot(given.plot, drawn)


if __name__ == "__main__":
    main()
