"""`edgegrasp generate-data`, `train` and `import-checkpoint`: from simulation to weights."""

import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from edgegrasp_cli.benchmark import Engine, Ray, Workers, interruptible

Option = typer.Option


def generate_data(
    output: Annotated[Path, typer.Argument(help="Folder for the views, one file each.")],
    objects: Annotated[
        Path | None, Option(help="Folder packed/train, pile/train; else the built-in objects.")
    ] = None,
    scenes: Annotated[int, Option(min=1, help="Scenes.")] = 100,
    scene: Annotated[
        Literal["packed", "pile", "bin", "table"] | None,
        Option(help="Kind of the scenes; else a mixture of them all."),
    ] = None,
    views_per_scene: Annotated[int, Option(min=1, help="Cameras in each scene.")] = 2,
    grasps_per_view: Annotated[int, Option(min=1, help="Grasps tried in each view.")] = 100,
    seed: Annotated[int, Option(min=0, help="Seed of everything random.")] = 1,
    weights: Annotated[
        Path | None,
        Option(help="Network that chooses half of the grasps: its best, and its least certain."),
    ] = None,
    engine: Engine = None,
    gripper: Annotated[
        str,
        Option(help="Hand that tries them: a gripper's name or .toml file; random: one a scene."),
    ] = "panda",
    household: Annotated[
        float,
        Option(min=0.0, max=1.0, help="Share of the scenes made of random household objects."),
    ] = 0.0,
    workers: Workers = None,
    ray: Ray = None,
) -> None:
    """Make labelled edge grasps: views of random clutter, grasps tried in simulation.

    Views that are there already are kept, so that the same command goes on where it stopped.
    """
    from rich.progress import track

    from edgegrasp_sim.engine import choose_engine
    from edgegrasp_sim.objects import SceneKind
    from edgegrasp_training.generation import GenerationOptions, generate, missing_scenes
    from edgegrasp_training.views import find_views, write_data_card

    kind = None if scene is None else SceneKind(scene)
    chosen = choose_engine(engine)
    print(chosen)
    # Paths as other machines have them.
    weights, objects = weights and weights.resolve(), objects and objects.resolve()
    amounts = scenes, views_per_scene, grasps_per_view, seed
    options = GenerationOptions(*amounts, weights, kind, chosen.name, gripper, household)
    missing = len(missing_scenes(output, options))
    tried = held = 0
    with interruptible("generate-data", resumes=True):
        made = generate(output, objects, options, workers, ray)
        for _, grasps, successes in track(made, "scenes", total=missing):
            tried, held = tried + grasps, held + successes
    write_data_card(output, find_views([output]), _command())
    share = f", {100 * held / tried:.1f} % held" if tried else ""
    print(f"{missing} scenes made, {scenes - missing} kept; {tried} grasps tried{share}.")


def train(
    data: Annotated[
        list[Path] | None, typer.Argument(help="Folders of views from generate-data.")
    ] = None,
    model: Annotated[
        str, Option(help="edgegrasp, edgegrasp-small, edgegrasp-plus or vn-edgegrasp.")
    ] = "edgegrasp-plus",
    run: Annotated[Path, Option(help="Folder of this run: state, log, weights, card.")] = Path(
        "runs/edgegrasp-plus"
    ),
    steps: Annotated[int, Option(min=1, help="Steps at most.")] = 20_000,
    until: Annotated[
        int | None, Option(help="Pause at this step; the same command goes on.")
    ] = None,
    views_per_step: Annotated[int, Option(min=1, help="Views in a step.")] = 4,
    balls_per_view: Annotated[int, Option(min=1, help="Balls of each view in a step.")] = 8,
    learning_rate: Annotated[float, Option(help="At the start.")] = 1e-3,
    schedule: Annotated[
        Literal["plateau", "cosine"],
        Option(help="Halve the rate on a plateau, or let it fall to 0 at the last step."),
    ] = "plateau",
    rotations: Annotated[
        Literal["any", "upright", "none"],
        Option(
            help="Random rotations of training balls: any, about up only, none; edgegrasp networks."
        ),
    ] = "any",
    teacher: Annotated[
        Path | None,
        Option(help="Weights of a hand network whose scores a network of balls learns from too."),
    ] = None,
    start_from: Annotated[
        Path | None,
        Option(help="Weights to start from, of the same model; use a lower --learning-rate."),
    ] = None,
    outcomes: Annotated[
        Path | None,
        Option(help="File of a server's /v1/outcomes: recalibrate --start-from on it, no more."),
    ] = None,
    keep: Annotated[
        float, Option(help="Share of the weights of --start-from in the result.", min=0.0, max=1.0)
    ] = 0.0,
    crop_radius: Annotated[
        float | None,
        Option(
            min=0.01,
            max=0.99,
            help="Radius of the balls, metres; else the recipe's. 0.5: the paper's NoBall.",
        ),
    ] = None,
    evaluate_every: Annotated[int, Option(min=1, help="Steps between evaluations.")] = 250,
    validation_share: Annotated[float, Option(help="Share of the scenes kept apart.")] = 0.1,
    training_share: Annotated[
        float, Option(min=0.0, max=1.0, help="Share of the other scenes to learn from.")
    ] = 1.0,
    seed: Annotated[int, Option(min=0, help="Seed of weights, split and batches.")] = 0,
    device: Annotated[str, Option(help="cpu or cuda.")] = "cpu",
    mixed_precision: Annotated[
        bool, Option("--mixed-precision", help="Products in bfloat16: for a GPU.")
    ] = False,
) -> None:
    """Train weights on labelled views.

    The run folder gets log.csv, the weights with the least validation loss, and when training is
    done a model card. Running the same command again goes on from the last state. The scores of a
    teacher are kept beside the run folder, in `taught`.
    """
    from rich.progress import Progress

    from edgegrasp_training.outcomes import recalibrate
    from edgegrasp_training.recipes import recipe
    from edgegrasp_training.teacher import Teacher
    from edgegrasp_training.training import Trainer, TrainingOptions
    from edgegrasp_training.views import find_views, part_of, split_by_scene

    if outcomes is not None:
        if start_from is None or data:
            raise ValueError("--outcomes: name the weights that scored by --start-from, no data.")
        print(recalibrate(start_from, outcomes, run))
        return
    if not data:
        raise ValueError("data: got nothing. Name folders of views, or --outcomes.")
    options = TrainingOptions(
        steps=steps,
        views_per_step=views_per_step,
        balls_per_view=balls_per_view,
        learning_rate=learning_rate,
        keep=keep,
        schedule=schedule,
        rotations=rotations,
        evaluate_every=evaluate_every,
        mixed_precision=mixed_precision,
        seed=seed,
    )
    training_views, validation_views = split_by_scene(find_views(data), validation_share, seed)
    training_views = part_of(training_views, training_share, seed)
    metadata = recipe(model)
    taught = run.parent / "taught"
    guide = None if teacher is None else Teacher(teacher, metadata.network.crop_radius, taught)
    if crop_radius is not None:
        metadata = replace(metadata, network=replace(metadata.network, crop_radius=crop_radius))
    trainer = Trainer(
        metadata, training_views, validation_views, run, options, device, guide, start_from
    )
    print(f"{len(training_views)} training and {len(validation_views)} validation views")
    with Progress() as progress:
        task = progress.add_task("steps", total=steps, completed=trainer.step)

        def on_step(step: int, loss: float) -> None:
            progress.update(task, completed=step, description=f"loss {loss:.3f}")

        trainer.run(on_step, until)
    if trainer.finished:
        provenance = {"data": [folder.name for folder in data], "date": time.strftime("%Y-%m-%d")}
        evaluation = trainer.finish(provenance, _command())
        print(f"validation loss {evaluation.loss:.4f}, AUROC {evaluation.auroc:.4f}: {run}")
    else:
        print(f"paused at step {trainer.step}; the same command goes on")


def import_checkpoint(
    directory: Annotated[Path, typer.Argument(help="Holds the authors' *-ckpt-N.pt files.")],
    output: Annotated[
        Path | None, typer.Argument(help="File to write; else ARCHITECTURE.safetensors here.")
    ] = None,
    voxel_size: Annotated[float, Option(help="Of the clouds it was trained on, m.")] = 0.0045,
    crop_radius: Annotated[float, Option(help="Ball radius, m.")] = 0.05,
    gripper: Annotated[str, Option(help="Gripper it was trained for.")] = "panda",
) -> None:
    """Convert a checkpoint in the authors' layout to one safetensors file."""
    from edgegrasp_model.gripper import load_gripper
    from edgegrasp_model.networks.checkpoint import save_checkpoint
    from edgegrasp_model.networks.import_checkpoint import import_checkpoint as convert

    load_gripper(gripper)
    network, metadata = convert(
        directory, voxel_size=voxel_size, crop_radius=crop_radius, gripper=gripper
    )
    path = output or Path(f"{metadata.name}.safetensors")
    save_checkpoint(path, network, metadata)
    print(f"{path}: {metadata.network.architecture}, use it with --weights {path}")


def _command() -> str:
    """The command as it was typed, for cards of data and of models."""
    return shlex.join(["edgegrasp", *sys.argv[1:]])
