"""`edgegrasp train`."""

import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

Option = typer.Option


def train(
    data: Annotated[list[Path], typer.Argument(help="Folders of views from generate-data.")],
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
        Option(help="Turn training balls: any way, about up, or not; edgegrasp and its kin only."),
    ] = "any",
    teacher: Annotated[
        Path | None,
        Option(help="Weights of a hand network whose scores a network of balls learns from too."),
    ] = None,
    crop_radius: Annotated[
        float | None,
        Option(
            min=0.01,
            max=0.99,
            help="Of the balls, metres, in place of the recipe's; 0.5: the paper's NoBall.",
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
    done a model card. Running the same command again goes on from the last state. What a teacher
    says is kept beside the run folder, in `taught`.
    """
    from edgegrasp_model.errors import InvalidCheckpoint
    from edgegrasp_training.recipes import recipe
    from edgegrasp_training.teacher import Teacher
    from edgegrasp_training.training import Trainer, TrainingOptions
    from edgegrasp_training.views import find_views, part_of, split_by_scene

    options = TrainingOptions(
        steps=steps,
        views_per_step=views_per_step,
        balls_per_view=balls_per_view,
        learning_rate=learning_rate,
        schedule=schedule,
        rotations=rotations,
        evaluate_every=evaluate_every,
        mixed_precision=mixed_precision,
        seed=seed,
    )
    try:
        training_views, validation_views = split_by_scene(find_views(data), validation_share, seed)
        training_views = part_of(training_views, training_share, seed)
        metadata = recipe(model)
        taught = run.parent / "taught"
        guide = None if teacher is None else Teacher(teacher, metadata.network.crop_radius, taught)
        if crop_radius is not None:
            metadata = replace(metadata, network=replace(metadata.network, crop_radius=crop_radius))
        trainer = Trainer(metadata, training_views, validation_views, run, options, device, guide)
    except (ValueError, FileNotFoundError, InvalidCheckpoint) as error:
        sys.exit(f"edgegrasp train: {error}")
    print(f"{len(training_views)} training and {len(validation_views)} validation views")
    _run(trainer, until)
    if trainer.finished:
        evaluation = trainer.finish(_provenance(data), shlex.join(["edgegrasp", *sys.argv[1:]]))
        print(f"validation loss {evaluation.loss:.4f}, AUROC {evaluation.auroc:.4f}: {run}")
    else:
        print(f"paused at step {trainer.step}; the same command goes on")


def _run(trainer: Any, until: int | None) -> None:
    from rich.progress import Progress

    with Progress() as progress:
        task = progress.add_task("steps", total=trainer.options.steps, completed=trainer.step)

        def on_step(step: int, loss: float) -> None:
            progress.update(task, completed=step, description=f"loss {loss:.3f}")

        trainer.run(on_step, until)


def _provenance(data: list[Path]) -> dict[str, Any]:
    return {"data": [folder.name for folder in data], "date": time.strftime("%Y-%m-%d")}
