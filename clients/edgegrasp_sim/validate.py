"""Compare grasp outcomes with those of the reference simulator.

python -m edgegrasp_sim.validate --shared ../shared
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from edgegrasp_sim.engine import ENGINES
from edgegrasp_sim.hand import T_HANDCOM_HAND
from edgegrasp_sim.objects import CLUTTER, SceneKind
from edgegrasp_sim.simulation import ClutterSimulation, ObjectPlacement


def measure_agreement(
    shared: Path,
    kind: SceneKind,
    *,
    most: int | None = None,
    to_the_end: bool = False,
    engine: str | None = None,
) -> list[tuple[int, int]]:
    """Repeat the grasps of `<shared>/reference/grasp_outcomes/<kind>.json`.

    `most`: only the first so many of each scene.

    Returns:
        For each scene how many grasps succeeded or failed as in the reference, and were tried.

    Raises:
        FileNotFoundError: the outcomes or an object are missing.
    """
    path = shared / "reference" / "grasp_outcomes" / f"{kind}.json"
    counts = []
    with ClutterSimulation(engine=engine) as simulation:
        for scene in json.loads(path.read_text())["scenes"]:
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
            poses = np.asarray(scene["T_world_handcom"])[:most] @ T_HANDCOM_HAND
            held = [simulation.try_grasp(pose, to_the_end=to_the_end).success for pose in poses]
            agreed = np.array(held) == np.array(scene["success"][:most], bool)
            counts.append((int(agreed.sum()), len(agreed)))
    return counts


def main() -> None:
    """Print the agreement for packed and pile scenes."""
    parser = argparse.ArgumentParser(prog="python -m edgegrasp_sim.validate")
    parser.add_argument("--shared", type=Path, required=True, help="folder with the shared data")
    parser.add_argument(
        "--to-the-end",
        action="store_true",
        help="simulate every step of every grasp, even once its outcome is clear",
    )
    parser.add_argument("--engine", choices=ENGINES, help="by default the first there is")
    given = parser.parse_args()
    for kind in CLUTTER:
        started = time.process_time()
        counts = measure_agreement(
            given.shared, kind, to_the_end=given.to_the_end, engine=given.engine
        )
        seconds = time.process_time() - started
        agreed, tried = np.sum(counts, axis=0)
        scenes = ", ".join(f"{same}/{all_}" for same, all_ in counts)
        sys.stdout.write(
            f"{kind}: {agreed / tried:.1%} of {tried} grasps agree ({scenes}); "
            f"{tried / seconds:.0f} grasps per processor second\n"
        )


if __name__ == "__main__":
    main()
