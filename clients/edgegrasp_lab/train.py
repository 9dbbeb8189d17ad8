"""Commands to generate training data, to train networks of both kinds, and to import weights."""

import shlex
import sys
import time
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.progress import Progress, track
from typer import Argument, Option

from edgegrasp_cli.flags import takes_flags
from edgegrasp_lab.flags import ClusterFlags
from edgegrasp_sim.engine import choose_engine
from edgegrasp_training.options import GenerationOptions, TrainingOptions


class DataFlags(GenerationOptions, ClusterFlags):
    """The flags of `edgegrasp generate-data`."""

    objects: Path | None = None
    """Folder with packed/train and pile/train; default: the built-in objects"""


@takes_flags()
def generate_data(
    output: Annotated[Path, Argument(help="Folder for the views, one file each.")],
    *,
    flags: DataFlags,
) -> None:
    """Make labelled edge grasps: views of random clutter, grasps tried in simulation.

    Existing views are kept, so that the same command continues where it stopped.
    """
    from edgegrasp_training.generation import generate, missing_scenes

    print(f"engine: {choose_engine(flags.engine)}")
    missing = len(missing_scenes(output, flags))
    tried = held = 0
    made = generate(output, flags.objects, flags, flags.workers, flags.ray)
    for _, grasps, successes in track(made, "scenes", total=missing):
        tried, held = tried + grasps, held + successes
    share = f", {100 * held / tried:.1f} % held" if tried else ""
    print(f"{missing} scenes made, {flags.scenes - missing} kept; {tried} grasps tried{share}.")


class TrainFlags(TrainingOptions, use_attribute_docstrings=True):
    """The flags of `edgegrasp train`."""

    model: str = "edgegrasp-plus"
    """edgegrasp, edgegrasp-small, edgegrasp-plus or vn-edgegrasp"""
    run: Path = Path("runs/edgegrasp-plus")
    """Folder of this run: state, log, weights, card"""
    until: int | None = None
    """Pause at this step; the same command continues"""
    teacher: Path | None = None
    """Weights of a hand network that also teaches a ball network"""
    start_from: Path | None = None
    """Weights of the same model to start from; use a lower --learning-rate"""
    outcomes: Path | None = None
    """Outcomes file of a server: recalibrate --start-from on it, without training"""
    validation_share: float = 0.1
    """Share of the scenes kept for validation"""
    device: str = "cpu"
    """cpu or cuda"""


@takes_flags()
def train(
    data: Annotated[
        list[Path] | None, Argument(help="Folders of views from generate-data.")
    ] = None,
    *,
    flags: TrainFlags,
) -> None:
    """Train weights on labelled views.

    The run folder gets log.csv, the weights with the least validation loss, and a model card when
    training is done. Run the same command again to continue from the last state.
    """
    from edgegrasp_model.detector import choose_device
    from edgegrasp_training.evaluation import recalibrate
    from edgegrasp_training.examples import Teacher
    from edgegrasp_training.recipes import recipe
    from edgegrasp_training.training import Trainer
    from edgegrasp_training.views import find_views, split_by_scene

    if flags.outcomes is not None:
        if flags.start_from is None or data:
            raise ValueError("--outcomes: name the weights with --start-from, and give no data.")
        print(recalibrate(flags.start_from, flags.outcomes, flags.run))
        return
    if not data:
        raise ValueError("data: got nothing. Name folders of views, or --outcomes.")
    if flags.keep and flags.start_from is None:
        raise ValueError("--keep: got no weights. Name them with --start-from.")
    views, validation = split_by_scene(find_views(data), flags.validation_share, flags.seed)
    metadata, teacher = recipe(flags.model), None
    if flags.teacher is not None:
        teacher = Teacher(flags.teacher, metadata.network.crop_radius)
    device = choose_device(flags.device)
    trainer = Trainer(
        metadata, views, validation, flags.run, flags, device, teacher, flags.start_from
    )
    print(f"{len(views)} training and {len(validation)} validation views")
    with Progress() as progress:
        task = progress.add_task("steps", total=flags.steps, completed=trainer.step)
        for step, loss in trainer.run(flags.until):
            progress.update(task, completed=step, description=f"loss {loss:.3f}")
    if trainer.finished:
        provenance = {"data": [folder.name for folder in data], "date": time.strftime("%Y-%m-%d")}
        evaluation = trainer.finish(provenance, shlex.join(["edgegrasp", *sys.argv[1:]]))
        print(f"validation loss {evaluation.loss:.4f}, AUROC {evaluation.auroc:.4f}: {flags.run}")
    else:
        print(f"paused at step {trainer.step}; the same command continues")


def generate_scenes(
    output: Annotated[Path, Argument(help="Folder for the images, 200 in a file.")],
    objects: Annotated[Path, Option(help="Folder with packed/train and pile/train.")],
    files: Annotated[int, Option(min=1, help="Files of 50 scenes with 4 images each.")] = 110,
    seed: Annotated[int, Option(min=0, help="Seed of everything random.")] = 2,
    workers: Annotated[int, Option(min=1, help="Processes.")] = 2,
) -> None:
    """Make labelled depth images of simulated scenes to train the scene network on.

    Existing files are kept, so that the same command continues where it stopped.

    Example: edgegrasp generate-scenes data/scenes --objects OBJECTS --files 110
    """
    from edgegrasp_sim.workers import run_tasks
    from edgegrasp_training.scene_images import FILE, generate

    choose_engine("pybullet")  # it reads the robot arms of the background
    meshes = sorted(objects.glob("*/train/*_visual.obj"))
    if not meshes:
        raise ValueError(f"objects: got {objects}. Give a folder with */train/*_visual.obj.")
    missing = [number for number in range(files) if not (output / FILE.format(number)).exists()]
    # Each worker makes neighbouring files, which draw from the same objects.
    parts = [part.tolist() for part in np.array_split(missing, workers)]
    list(run_tasks(partial(partial, generate, output, meshes, seed), parts, workers=workers))
    print(f"{len(list(output.glob('scenes-????.npz')))} files in {output}.")


def train_scene(
    data: Annotated[Path, Argument(help="Folder from generate-scenes.")],
    run: Annotated[Path, Option(help="Folder for checkpoints and the log.")],
    minutes: Annotated[float, Option(min=0.01, help="How long.")] = 70.0,
    threads: Annotated[int, Option(min=1, help="Threads of the processor.")] = 2,
    seed: Annotated[int, Option(min=0, help="Seed of weights and batches.")] = 0,
    start_from: Annotated[Path | None, Option(help="Weights to continue from.")] = None,
    learning_rate: Annotated[float, Option(min=0.0, help="Highest learning rate.")] = 3e-3,
) -> None:
    """Train the scene network; writes scene.safetensors into the run folder every five minutes.

    Example: edgegrasp train-scene data/scenes --run runs/scene --minutes 70
    """
    from edgegrasp_training import scene_training

    scene_training.train(data, run, 60.0 * minutes, seed, start_from, threads, learning_rate)
    print(f"weights in {run / 'scene.safetensors'}")


def import_checkpoint(
    directory: Annotated[Path, Argument(help="Folder with the authors' *-ckpt-N.pt files.")],
    output: Annotated[
        Path | None, Argument(help="File to write; default: ARCHITECTURE.safetensors here.")
    ] = None,
) -> None:
    """Convert a checkpoint in the authors' layout to one safetensors file."""
    from edgegrasp_model.networks.checkpoint import save_checkpoint
    from edgegrasp_training.import_checkpoint import import_checkpoint as convert

    network, metadata = convert(directory)
    path = output or Path(f"{metadata.name}.safetensors")
    save_checkpoint(path, network, metadata)
    print(f"{path}: {metadata.network.architecture}, use it with --weights {path}")
