"""Compare grasp outcomes with those of the reference simulator.

python -m edgegrasp_sim.validate --shared ../shared
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgegrasp_sim.hand import T_HANDCOM_HAND
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.simulation import ClutterSimulation, ObjectPlacement


@dataclass(frozen=True, slots=True)
class Agreement:
    """How many grasps came out as in the reference.

    Attributes:
        kind: of the scenes.
        agreed: for each scene, how many grasps had the reference's success or failure.
        tried: for each scene, how many grasps there were.
        seconds: processor time of the grasps.
    """

    kind: SceneKind
    agreed: tuple[int, ...]
    tried: tuple[int, ...]
    seconds: float

    @property
    def share(self) -> float:
        """Agreement over all scenes, 0 to 1."""
        return sum(self.agreed) / sum(self.tried)


def measure_agreement(
    shared: Path,
    kind: SceneKind,
    *,
    grasps_per_scene: int | None = None,
    to_the_end: bool = False,
) -> Agreement:
    """Repeat the grasps of `<shared>/reference/grasp_outcomes/<kind>.json`.

    Args:
        shared: folder with `objects` and `reference`.
        kind: of the scenes.
        grasps_per_scene: only the first so many; all by default.
        to_the_end: see `ClutterSimulation.try_grasp`.

    Raises:
        FileNotFoundError: the outcomes or an object are missing.
    """
    path = shared / "reference" / "grasp_outcomes" / f"{kind}.json"
    scenes = json.loads(path.read_text())["scenes"]
    agreed, tried = [], []
    started = time.process_time()
    with ClutterSimulation() as simulation:
        for scene in scenes:
            simulation.reset_from_poses(
                [
                    ObjectPlacement(
                        shared / "objects" / item["urdf"],
                        item["scale"],
                        item["position"],
                        item["quaternion_xyzw"],
                    )
                    for item in scene["objects"]
                ]
            )
            poses = np.asarray(scene["T_world_handcom"])[:grasps_per_scene]
            results = [
                simulation.try_grasp(pose @ T_HANDCOM_HAND, to_the_end=to_the_end) for pose in poses
            ]
            agreed.append(
                sum(
                    result.success == bool(success)
                    for result, success in zip(results, scene["success"], strict=False)
                )
            )
            tried.append(len(results))
    seconds = time.process_time() - started
    return Agreement(kind, tuple(agreed), tuple(tried), seconds)


def main() -> None:
    """Print the agreement for packed and pile scenes."""
    parser = argparse.ArgumentParser(prog="python -m edgegrasp_sim.validate")
    parser.add_argument("--shared", type=Path, required=True, help="folder with the shared data")
    parser.add_argument(
        "--to-the-end",
        action="store_true",
        help="simulate every step of every grasp, even once its outcome is clear",
    )
    arguments = parser.parse_args()
    for kind in SceneKind:
        agreement = measure_agreement(
            arguments.shared,
            kind,
            to_the_end=arguments.to_the_end,
        )
        scenes = ", ".join(
            f"{agreed}/{tried}"
            for agreed, tried in zip(agreement.agreed, agreement.tried, strict=True)
        )
        grasps = sum(agreement.tried)
        sys.stdout.write(
            f"{kind}: {agreement.share:.1%} of {grasps} grasps agree ({scenes}); "
            f"{grasps / agreement.seconds:.0f} grasps per processor second\n"
        )


if __name__ == "__main__":
    main()
