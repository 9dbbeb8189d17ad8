"""`edgegrasp generate-data`."""

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

Option = typer.Option


def generate_data(
    output: Annotated[Path, typer.Argument(help="Folder for the views, one file each.")],
    objects: Annotated[
        Path | None, Option(help="Folder packed/train, pile/train; else the built-in objects.")
    ] = None,
    scenes: Annotated[int, Option(min=1, help="Scenes.")] = 100,
    scene: Annotated[
        Literal["packed", "pile"] | None, Option(help="Of one kind; else half packed, half piles.")
    ] = None,
    views_per_scene: Annotated[int, Option(min=1, help="Cameras in each scene.")] = 2,
    grasps_per_view: Annotated[int, Option(min=1, help="Grasps tried in each view.")] = 100,
    seed: Annotated[int, Option(min=0, help="Seed of everything random.")] = 1,
    weights: Annotated[
        Path | None, Option(help="Network that chooses half of the grasps: its best, its unsure.")
    ] = None,
    workers: Annotated[int, Option(min=1, help="Processes; the data stay the same.")] = 1,
) -> None:
    """Make labelled edge grasps: views of random clutter, grasps tried in simulation.

    Views that are there already are kept, so that the same command goes on where it stopped.
    """
    from rich.progress import track

    from edgegrasp_sim.objects import SceneKind
    from edgegrasp_training.generation import GenerationOptions, generate, missing_scenes
    from edgegrasp_training.views import find_views, write_data_card

    kind = None if scene is None else SceneKind(scene)
    options = GenerationOptions(
        scenes, views_per_scene, grasps_per_view, seed=seed, weights=weights, kind=kind
    )
    missing = len(missing_scenes(output, options))
    tried = held = 0
    try:
        finished = generate(output, objects, options, workers)
        for _, grasps, successes in track(finished, "scenes", total=missing):
            tried, held = tried + grasps, held + successes
    except FileNotFoundError as error:
        sys.exit(f"edgegrasp generate-data: {error}")
    command = shlex.join(["edgegrasp", *sys.argv[1:]])
    write_data_card(output, find_views([output]), command)
    share = f", {100 * held / tried:.1f} % held" if tried else ""
    print(f"{missing} scenes made, {scenes - missing} kept; {tried} grasps tried{share}.")
