"""Measure speed: `python -m benchmarks.speed` writes speed.json.

Most times are processor seconds on one thread, medians of interleaved runs, which are valid on a
busy machine too.
"""

import itertools
import re
import statistics
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from benchmarks.measuring import RESULTS, machine, memory, time_interleaved, write_results
from examples.your_planner import plan

from edgegrasp_client import GraspClient
from edgegrasp_client.connection import local_server
from edgegrasp_lab.real_scenes import load_scenes
from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.options import DetectOptions
from edgegrasp_sim.camera import EVALUATION_VIEWS, Observation
from edgegrasp_sim.engine import ENGINES, installed
from edgegrasp_sim.objects import CLUTTER, SceneKind
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import RoundDriver
from edgegrasp_training import views
from edgegrasp_training.generation import label_view
from edgegrasp_training.options import GenerationOptions

WEIGHTS = ("edgegrasp-plus", "edgegrasp-small", "edgegrasp", "vn-edgegrasp")
LABELS = 240  # grasps tried in each scene
SIMULATED = 4  # scenes and rounds
ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "real_scenes"
IMAGE = 480, 640  # rows and columns
ENLARGED_NOISE = 0.0003  # metres
# The view of the camera in examples/demo.py.
DEMO: dict[str, Any] = {"seeds": [(0, 0, k) for k in range(3)], "num_objects": 6, "table": "auto"}
SECONDS, RATES = ("seconds_1", "seconds_2"), ("labels_per_second", "rounds_per_minute")
BEGIN, END = "<!-- bench:begin -->", "<!-- bench:end -->"  # around the README's table


def main(
    output: Path = RESULTS,
    pages: Annotated[bool, typer.Option(help="Rewrite the tables of README and speed.md.")] = False,
) -> None:
    """Measure everything, write the results and the pages' tables."""
    torch.set_num_threads(1)
    results: dict[str, Any] = {"machine": machine()}
    for part in (camera, shipped, simulator, server):
        name = part.__name__
        results[name] = part()
        print(name, results[name], flush=True)
    write_results(output, "speed", results)
    if pages:
        write_table(ROOT / "README.md", camera_table(results))
        write_table(ROOT / "docs" / "speed.md", table(results))


def shipped() -> list[dict[str, Any]]:
    """Time each network in the whole pipeline on a view of each kind of scene, given the table.

    Processor seconds on one thread, and wall-clock seconds on two.
    """
    scenes, models = {str(kind): observe(kind) for kind in CLUTTER}, ModelCatalogue.load()
    runs, rows = {}, {}
    for name, (scene, seen) in itertools.product(WEIGHTS, scenes.items()):
        key = f"{name}/{scene}"
        runs[key] = partial(models.get(name).detect, seen.cloud, request(seen))
        rows[key] = {"model": name, "scene": scene, "points": len(seen.cloud)}
    for threads, clock in ((1, time.process_time), (2, time.perf_counter)):
        torch.set_num_threads(threads)
        for key, times in time_interleaved(runs, clock=clock).items():
            rows[key][f"seconds_{threads}"] = statistics.median(times)
    torch.set_num_threads(1)
    return list(rows.values())


def camera() -> dict[str, float]:
    """Seconds for camera images with the default weights, given only the camera's position.

    The demo's scene; each image in SHARED, if it exists; and the same enlarged to 1280 x 720.
    """
    ours, seen = ModelCatalogue.load().get(""), observe(SceneKind.PILE, **DEMO)
    sent = {"the demo's scene": (seen.cloud, seen.camera_position)}
    for scene in load_scenes([SHARED]) if SHARED.exists() else []:
        if len(scene.points) == np.prod(IMAGE):
            image = scene.points.reshape(*IMAGE, 3)
            sent[f"640 x 480, {scene.name}"] = image, np.zeros(3)
            # Twice as many rows and columns; a little noise keeps points from coinciding.
            large = image.repeat(2, axis=0).repeat(2, axis=1)[120:840]
            noise = np.random.default_rng(0).normal(0.0, ENLARGED_NOISE, large.shape)
            sent[f"1280 x 720, {scene.name}"] = (large + noise).astype(np.float32), np.zeros(3)
    runs = {
        name: partial(ours.detect, cloud, DetectOptions(viewpoint=tuple(viewpoint.tolist())))
        for name, (cloud, viewpoint) in sent.items()
    }
    return {name: statistics.median(times) for name, times in time_interleaved(runs).items()}


def server() -> dict[str, float]:
    """Wall-clock seconds until a server is ready, and its memory, MiB, then and after requests."""
    start = time.perf_counter()
    with local_server() as running:
        ready = time.perf_counter() - start
        at_rest = memory(running.pid)
        seen = observe(SceneKind.PILE, **DEMO)
        viewpoint = tuple(seen.camera_position.tolist())
        with GraspClient(running.grpc_address) as client:
            for seed in range(10):
                client.detect(seen.cloud, seed=seed, viewpoint=viewpoint)
        return {"ready_seconds": ready, "rest_mb": at_rest, "used_mb": memory(running.pid)}


def simulator() -> list[dict[str, Any]]:
    """Labels per second and rounds per minute of each engine and kind, without the start."""
    protocol, options = load_protocol("edgegrasp"), GenerationOptions(grasps_per_view=LABELS)
    # Number of labels, seconds for them, and seconds of a round.
    runs: dict[tuple[SceneKind, str], list[tuple[float, ...]]] = {
        (kind, engine): [] for kind in CLUTTER for engine in filter(installed, ENGINES)
    }
    for seed, (kind, engine) in itertools.product(range(SIMULATED + 1), runs):
        with ClutterSimulation(engine=engine) as simulation:
            start = time.process_time()
            simulation.reset(kind, np.random.default_rng(seed))
            camera, noise, choice = (np.random.default_rng([seed, k]) for k in range(3))
            observation = simulation.observe_from(EVALUATION_VIEWS.sample(camera), noise)
            query = observation, request(observation)
            view, _ = label_view(simulation, query, options, choice, None)
            labelled = time.process_time()
            RoundDriver(simulation, kind, protocol, seed=seed, index=0).run(plan)
            end = time.process_time()
        if seed:  # the first run loads and compiles
            runs[kind, engine].append((len(view.success), labelled - start, end - labelled))
    rows = []
    for (kind, engine), each in runs.items():
        labels, labelling, rounds = np.sum(each, axis=0).tolist()
        rates = {"labels_per_second": labels / labelling}
        rates["rounds_per_minute"] = 60 * len(each) / rounds
        rows.append({"engine": engine, "scene": kind.value, "labels": labels, **rates})
    return rows


def observe(kind: SceneKind, seeds: Sequence[Any] = (1, 1, 2), **asked: Any) -> Observation:
    """A view of a scene with built-in objects; seeds for the scene, the camera and the noise."""
    scene, camera, noise = map(np.random.default_rng, seeds)
    with ClutterSimulation() as simulation:
        simulation.reset(kind, scene, asked.pop("num_objects", 5))
        return simulation.observe_from(EVALUATION_VIEWS.sample(camera), noise, **asked)


def request(observation: Observation) -> DetectOptions:
    """The options of a request with a known table."""
    return DetectOptions(
        num_approach_points=32,
        num_candidates=2000,
        viewpoint=tuple(observation.camera_position.tolist()),
        support={"normal": (0.0, 0.0, 1.0), "offset": observation.table_height},
    )


def write_table(page: Path, written: str) -> None:
    """Put a table between a page's markers."""
    place = re.compile(f"(?<={BEGIN}\n).*(?=\n{END})", re.DOTALL)
    page.write_text(place.sub(lambda _: written, page.read_text()))


def camera_table(results: dict[str, Any]) -> str:
    """The times of camera images."""
    rows = []
    for size in ("the demo's scene", "640 x 480", "1280 x 720"):
        of = [1000 * time for name, time in results["camera"].items() if name.startswith(size)]
        if of:
            spread = f", {min(of):.0f} to {max(of):.0f} in {len(of)} real scenes"
            rows.append((size, f"{statistics.median(of):.0f} ms{spread if len(of) > 1 else ''}"))
    head = "`edgegrasp-plus`, from image to ranked grasps", "one thread"
    return "\n".join(views.table(head, rows))


def table(results: dict[str, Any]) -> str:
    """The table of all other times, and the machine."""
    rows = [
        (f"`{row['model']}`", row["scene"], *(f"{1000 * row[key]:.0f} ms" for key in SECONDS))
        for row in results["shipped"]
    ]
    head = "from cloud to ranked grasps, support plane given", "scene", "one thread", "two threads"
    lines = views.table(head, rows)
    machine, server = results["machine"], results["server"]
    rows = [
        (row["engine"], row["scene"], *(f"{row[rate]:.0f}" for rate in RATES))
        for row in results["simulator"]
    ]
    head = "simulator", "scene", "labels per second and core", "rounds per minute and core"
    text = (
        f"{machine['processor']} with {machine['capability']}, {machine['gflops']:.0f} GFLOP/s in "
        f"float32; the server is ready after {server['ready_seconds']:.1f} s and takes "
        f"{server['rest_mb']:.0f} MB at rest, {server['used_mb']:.0f} MB after ten requests."
    )
    return "\n".join([*lines, "", *views.table(head, rows), "", text])


if __name__ == "__main__":
    typer.run(main)
