"""The whole task from end to end; `make demo` runs it.

Makes a cluttered scene in simulation, observes it with a depth camera, starts a server, sends the
cloud over gRPC and over REST, executes the best grasp in the simulator, and writes a picture and
the cloud.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import trimesh

from edgegrasp_camera.picture import Camera, Picture
from edgegrasp_client import Detection, DetectOptions, GraspClient, GraspClientError
from edgegrasp_client.connection import local_server
from edgegrasp_sim.camera import EVALUATION_VIEWS, Observation, crop
from edgegrasp_sim.engine import ENGINES, choose_engine
from edgegrasp_sim.simulation import ClutterSimulation

OUTPUT = Path(__file__).resolve().parents[1] / "demo_output"
FEWEST_GRASPS = 10
LISTED = 12
TIMEOUT = 120.0  # seconds, enough for a slow machine


def main(seed: int, output: Path, engine: str | None = None) -> None:
    """Run the demo; exits with a message if the server does not start or finds too little."""
    chosen = choose_engine(engine)
    print(f"engine: {chosen}")
    scene, camera, noise = (np.random.default_rng([seed, 0, stream]) for stream in range(3))
    with ClutterSimulation(engine=chosen) as simulation:
        placed = simulation.reset("pile", scene, num_objects=6)
        pose = EVALUATION_VIEWS.sample(camera)[0]
        seen = simulation.observe_from([pose], noise, table="auto")
        colors = simulation.color_image(pose).reshape(-1, 3)[seen.pixels]
        print(f"Scene: {placed} objects on a table; the camera sees {len(seen.cloud):,} points.")

        over_grpc, over_rest = detect_over_both(seen, seed)
        report("gRPC", over_grpc)
        report("REST", over_rest)
        scores_and_poses = [
            [(grasp.score, grasp.T_cloud_hand.tolist()) for grasp in found.grasps]
            for found in (over_grpc, over_rest)
        ]
        if scores_and_poses[0] != scores_and_poses[1]:
            sys.exit("error: gRPC and REST gave different grasps.")
        print("gRPC and REST gave the same grasps, to the last bit.\n")
        if len(over_grpc.grasps) < FEWEST_GRASPS:
            sys.exit(f"error: {len(over_grpc.grasps)} grasps; the counts say where they went.")

        best = over_grpc.grasps[0]
        result = simulation.execute_grasp(best.T_cloud_hand)  # the cloud is in the world frame
        verdict = "it held" if result.success else "it did not hold"
        print(f"Executed the best one in the simulator: {verdict}.")

    output.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(seen.cloud, vertex_colors=colors, process=False).export(output / "scene.ply")
    drawn = over_grpc.grasps[:LISTED]
    title = f"The {len(drawn)} best grasps among {placed} objects. Executed the best: {verdict}."
    view = Camera.facing(crop(seen.cloud, seen.workspace, 0.05), seen.camera_position)
    picture = Picture(view, seen.cloud, colors, title=title)
    picture.grasps(drawn)
    picture.save(output / "grasps.png")
    print(f"In {output.name}/: grasps.png, the picture, and scene.ply, the cloud.")


def detect_over_both(seen: Observation, seed: int) -> tuple[Detection, Detection]:
    """Grasps of one cloud over gRPC and over REST, from a local server.

    The cloud contains the table: the server finds it, and the objects on it.
    """
    options: DetectOptions = {
        "seed": seed,
        "viewpoint": seen.camera_position.tolist(),
        "top_k": 20,
        "suppression": {"translation": 0.02, "rotation": 3.2},  # one grasp every 2 cm
    }
    print("Starting a server, which loads its weights …", flush=True)
    with local_server() as addresses:
        print(f"Server: {addresses.http_url} and gRPC {addresses.grpc_address}\n")
        with GraspClient(addresses.grpc_address, timeout=TIMEOUT) as client:
            over_grpc = client.detect(seen.cloud, **options)
        with GraspClient(addresses.http_url, timeout=TIMEOUT) as client:
            over_rest = client.detect(seen.cloud, **options)
    return over_grpc, over_rest


def report(transport: str, detection: Detection) -> None:
    """Print the best grasps of a detection, and its counts."""
    number, name, seconds = len(detection.grasps), detection.model, detection.seconds["total"]
    print(f"{number} grasps over {transport} from {name}, {seconds:.2f} s:")
    print("rank  score  width (mm)   TCP x, y, z (m)        approach direction")
    for rank, grasp in enumerate(detection.grasps[:LISTED], start=1):
        x, y, z, u, v, w = *grasp.T_cloud_tcp[:3, 3], *grasp.approach_direction
        print(
            f"{rank:4}  {grasp.score:.3f}  {1000 * grasp.width:10.1f}   "
            f"{x:.3f}, {y:.3f}, {z:.3f}    {u:+.2f}, {v:+.2f}, {w:+.2f}"
        )
    print("counts:", ", ".join(f"{name} {count}" for name, count in detection.counts.items()), "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="A scene, its grasps, one executed, a picture.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder to write to")
    parser.add_argument("--engine", choices=ENGINES, help="default: the first installed")
    arguments = parser.parse_args()
    try:
        main(arguments.seed, arguments.output, arguments.engine)
    except GraspClientError as error:
        sys.exit(f"error: {error}")
