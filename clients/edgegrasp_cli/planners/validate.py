"""Compare random candidates and clouds with those of the reference system.

python -m edgegrasp_cli.planners.validate --shared ../shared

Edge-Sample's success depends on three things: which candidates there are, whether the simulator is
as hard, and what the camera shows of the objects. `bootstrap_dataset` says how random candidates
fare in the reference simulator, on train objects; `golden` has the reference's dense clouds.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from edgegrasp_cli.planners.baselines import PaperCandidates, estimate_normals
from edgegrasp_sim.camera import TRAINING_VIEWS
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.simulation import ClutterSimulation

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from edgegrasp_sim.camera import Observation

# How the labelled views were made: see the data's own description.
MORE_OBJECTS = 4.0  # than one, on average; Poisson
NOISE_STD = 0.0008  # metres
LABELLED = PaperCandidates(num_approach_points=32, num_candidates=1500, voxel_size=0.0045)
BEST_SHARE = 0.25  # of the candidates, by the teacher, which half of the labels are from
FUSED_VOXEL = 0.30 / 180  # metres

TRIES = 15  # random candidates in each of our own views
MIN_POINTS = 100
DISC = 0.005  # metres around a point in which neighbours are counted
COSINES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of the angle between line of sight and normal
CROWDED = 80  # percentile: points near a border have fewer neighbours


@dataclass(frozen=True, slots=True)
class Share:
    """A mean over views, 0 to 1, with its standard error."""

    mean: float
    error: float
    views: int

    @classmethod
    def of(cls, views: Sequence[float]) -> Share:
        """The mean of what was found in each view."""
        error = float(np.std(views, ddof=1) / np.sqrt(len(views)))
        return cls(float(np.mean(views)), error, len(views))

    def __str__(self) -> str:
        return f"{100 * self.mean:.1f} ± {100 * self.error:.1f} % ({self.views} views)"


def reference_successes(shared: Path, kind: SceneKind) -> Share:
    """How many random candidates hold in the reference simulator, in first views.

    Half of the labels are of candidates from the teacher's best quarter; they are weighted so that
    every candidate counts alike.

    Raises:
        FileNotFoundError: there are no labelled views.
    """
    files = sorted((shared / "bootstrap_dataset").glob(f"{kind.value}_*.npz"))
    if not files:
        raise FileNotFoundError(f"{shared} has no bootstrap_dataset/{kind.value}_*.npz")
    views = []
    for file in files:
        with np.load(file, allow_pickle=False) as view:
            success, logit = view["success"], view["teacher_logit"].astype(np.float64)
        best = logit >= np.quantile(logit, 1 - BEST_SHARE)
        tried = success >= 0
        if (tried & best).any() and (tried & ~best).any():
            shares = success[tried & best].mean(), success[tried & ~best].mean()
            views.append(BEST_SHARE * shares[0] + (1 - BEST_SHARE) * shares[1])
    return Share.of(views)


def own_successes(
    objects: ObjectSet, kind: SceneKind, scenes: int, *, surface_voxel: float = 0.0
) -> Share:
    """The same here, in scenes made and seen as the labelled ones."""
    views = []
    with ClutterSimulation({kind: objects}) as simulation:
        for index in range(scenes):
            rng = np.random.default_rng([7, index])
            simulation.reset(kind, rng, num_objects=1 + int(rng.poisson(MORE_OBJECTS)))
            seen = simulation.observe(
                rng, rng, views=TRAINING_VIEWS, noise_std=NOISE_STD, surface_voxel=surface_voxel
            )
            if len(seen.cloud) < MIN_POINTS:
                continue
            poses = LABELLED(seen, rng)[:TRIES]
            held = [simulation.try_grasp(pose).success for pose in poses]
            if held:
                views.append(float(np.mean(held)))
    return Share.of(views)


def densities(clouds: Iterable[tuple[NDArray[Any], NDArray[Any]]]) -> list[float]:
    """Points per square millimetre of a surface, by the angle it is seen at (`COSINES`).

    Args:
        clouds: (N, 3) points and (3,) camera of each, metres.
    """
    cosines, counts = [], []
    for cloud, camera in clouds:
        points = cloud.astype(np.float64)
        sight = camera - points
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        cosines.append(np.abs(np.einsum("nd,nd->n", estimate_normals(points), sight)))
        counts.append(cKDTree(points).query_ball_point(points, DISC, return_length=True))
    cosine, count = np.concatenate(cosines), np.concatenate(counts)
    disc = np.pi * (1000 * DISC) ** 2
    return [
        float(np.percentile(count[(cosine >= low) & (cosine < high)], CROWDED) / disc)
        for low, high in pairwise(COSINES)
    ]


def _own_clouds(
    objects: ObjectSet, kind: SceneKind, scenes: int, surface_voxel: float
) -> Iterable[tuple[NDArray[Any], NDArray[Any]]]:
    with ClutterSimulation({kind: objects}) as simulation:
        for index in range(scenes):
            rng = np.random.default_rng([8, index])
            simulation.reset(kind, rng)
            seen: Observation = simulation.observe(
                rng, rng, noise_std=NOISE_STD, surface_voxel=surface_voxel
            )
            yield seen.cloud, seen.camera_position


def _golden_clouds(shared: Path) -> Iterable[tuple[NDArray[Any], NDArray[Any]]]:
    for file in sorted((shared / "reference" / "golden").glob("*.npz")):
        with np.load(file, allow_pickle=False) as scene:
            yield scene["dense_cloud"], scene["camera_position"]


def main() -> None:
    """Print both comparisons."""
    parser = argparse.ArgumentParser(prog="python -m edgegrasp_cli.planners.validate")
    parser.add_argument("--shared", type=Path, required=True, help="folder with the shared data")
    parser.add_argument("--scenes", type=int, default=80, help="of our own, of each kind")
    arguments = parser.parse_args()
    write = sys.stdout.write
    write(f"points per square millimetre, cosine of line of sight and normal {COSINES}:\n")
    packed = ObjectSet.from_folder(arguments.shared / "objects", SceneKind.PACKED, "train")
    for name, clouds in (
        ("reference", _golden_clouds(arguments.shared)),
        ("pixels", _own_clouds(packed, SceneKind.PACKED, 5, 0.0)),
        ("resampled", _own_clouds(packed, SceneKind.PACKED, 5, FUSED_VOXEL)),
    ):
        write(f"  {name}: {', '.join(f'{density:.2f}' for density in densities(clouds))}\n")
    for kind in SceneKind:
        objects = ObjectSet.from_folder(arguments.shared / "objects", kind, "train")
        write(f"random candidates that hold, {kind.value} scenes of train objects:\n")
        write(f"  reference: {reference_successes(arguments.shared, kind)}\n")
        for name, voxel in (("pixels", 0.0), ("resampled", FUSED_VOXEL)):
            share = own_successes(objects, kind, arguments.scenes, surface_voxel=voxel)
            write(f"  here, {name}: {share}\n")


if __name__ == "__main__":
    main()
