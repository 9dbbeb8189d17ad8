"""`edgegrasp replay`: make an attempt of a benchmark again, or a request that a server recorded."""

import sys
from pathlib import Path
from typing import Annotated

import typer

Option = typer.Option

replay = typer.Typer(
    help="Make what was recorded again: an attempt of a benchmark, or a request.",
    no_args_is_help=True,
    add_completion=False,
)


@replay.command()
def attempt(
    results: Annotated[Path, typer.Argument(help="Folder that `benchmark --output` wrote.")],
    round: Annotated[int, Option(help="Number of the round, from 0.")] = 0,  # noqa: A002
    number: Annotated[int, Option("--attempt", help="Number of the attempt in it, from 0.")] = 0,
    seed: Annotated[
        int | None, Option(help="Seed of the round; else the benchmark's first.")
    ] = None,
    objects: Annotated[
        Path | None, Option(help="Object folder, if it is elsewhere by now.")
    ] = None,
    picture: Annotated[
        Path | None, Option(help="PNG to write: the cloud seen, and the gripper.")
    ] = None,
    gui: Annotated[bool, Option(help="Show the simulator's window.")] = False,
) -> None:
    """Make one recorded attempt again, in the scene and view it was made in."""
    from edgegrasp_sim.picture import draw_grasps
    from edgegrasp_sim.replay import Replay
    from edgegrasp_sim.report import DrawnAttempt, attempt_title
    from edgegrasp_sim.results import ResultFolder

    try:
        folder = ResultFolder(results)
        first = folder.manifest()["seeds"][0]
        with Replay(folder, objects, gui=gui) as repeated:
            done = repeated.find(first if seed is None else seed, round, number)
            now, seen = repeated.repeat(done.seed, round, number)
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"edgegrasp replay: {error}")
    before, title = done.attempts[number], attempt_title(done, number)
    if picture is not None:
        drawn = [DrawnAttempt.of(before)]
        draw_grasps(picture, seen.cloud, drawn, camera_position=seen.camera_position, title=title)
    print(title)
    if any(
        getattr(now, name) != getattr(before, name)
        for name in ("outcome", "cause", "object", "opening")
    ):
        sys.exit(f"edgegrasp replay: the result differs: {now.cause or now.outcome}")
    print("the result is the same")


@replay.command()
def request(
    file: Annotated[Path, typer.Argument(help="File that a server with --record-folder wrote.")],
) -> None:
    """Answer a recorded request again, in this process, and compare with the recorded answer."""
    from edgegrasp_service.recording import replay as answer_again

    from edgegrasp_model.errors import EdgeGraspError

    try:
        print(answer_again(file))
    except (EdgeGraspError, ValueError, OSError) as error:
        sys.exit(f"edgegrasp replay: {error}")
