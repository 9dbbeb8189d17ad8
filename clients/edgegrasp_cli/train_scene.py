"""`edgegrasp generate-scenes` and `train-scene`: the network that recognises objects."""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Annotated

import typer

from edgegrasp_cli.benchmark import interruptible

Option = typer.Option


def generate_scenes(
    output: Annotated[Path, typer.Argument(help="Folder for the images, 200 in a file.")],
    objects: Annotated[Path, Option(help="Folder with packed/train and pile/train.")],
    files: Annotated[int, Option(min=1, help="Files of 50 scenes with 4 images each.")] = 110,
    seed: Annotated[int, Option(min=0, help="Seed of everything random.")] = 2,
    workers: Annotated[int, Option(min=1, help="Processes.")] = 2,
) -> None:
    """Make labelled depth images of simulated scenes to train the scene network on.

    Files that are there already are kept, so that the same command goes on where it stopped.

    Example: edgegrasp generate-scenes data/scenes --objects OBJECTS --files 110
    """
    from edgegrasp_training.scene_images import generate

    meshes = sorted(objects.glob("*/train/*_visual.obj"))
    if not meshes:
        raise ValueError(f"objects: got {objects}. Give a folder with */train/*_visual.obj.")
    with (
        interruptible("generate-scenes", resumes=True),
        ProcessPoolExecutor(workers) as pool,
    ):
        parts = [
            pool.submit(generate, output, meshes, files, seed, part, workers)
            for part in range(workers)
        ]
        for part in parts:
            part.result()
    print(f"{len(list(output.glob('scenes-????.npz')))} files in {output}.")


def train_scene(
    data: Annotated[Path, typer.Argument(help="Folder from generate-scenes.")],
    run: Annotated[Path, Option(help="Folder for checkpoints and the log.")],
    minutes: Annotated[float, Option(min=0.0, help="How long.")] = 70.0,
    threads: Annotated[int, Option(min=1, help="Threads of the processor.")] = 2,
    seed: Annotated[int, Option(min=0, help="Seed of weights and batches.")] = 0,
    start_from: Annotated[Path | None, Option(help="Weights to continue from.")] = None,
    learning_rate: Annotated[float, Option(min=0.0, help="Highest learning rate.")] = 3e-3,
) -> None:
    """Train the scene network; writes scene.safetensors into the run folder every five minutes.

    Example: edgegrasp train-scene data/scenes --run runs/scene --minutes 70
    """
    from edgegrasp_training.scene_training import train

    with interruptible("train-scene", resumes=False):
        train(data, run, 60.0 * minutes, seed, start_from, threads, learning_rate)
    print(f"weights in {run / 'scene.safetensors'}")
